"""From the name of a world or a scene file to an environment."""

from collections.abc import Callable
from pathlib import Path

from jaxnav.env.objectnav import ObjectNav, build
from jaxnav.env.types import EnvParams
from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.scenes.compile import Bank, compile_bank
from jaxnav.scenes.detector import Detector
from jaxnav.scenes.io import read_scenes
from jaxnav.scenes.rooms import generate_rooms
from jaxnav.scenes.scene import SPLITS, Scene

#: The generated worlds by name; each makes scenes from (num_train, num_val, num_test, seed).
WORLDS: dict[str, Callable[..., list[Scene]]] = {"rooms": generate_rooms}


def load_scenes(
    source: str | Path, num_train: int = 80, num_val: int = 20, num_test: int = 20, seed: int = 0
) -> list[Scene]:
    """All scenes of a generated world, or of a scene file.

    Args:
      source: a world's name or the path of a scene file.
      num_train, num_val, num_test: generated scenes of each split; a file has its own.
      seed: of the generator.

    Raises:
      InputError: neither a world nor a readable scene file.
    """
    if str(source) in WORLDS:
        return WORLDS[str(source)](num_train, num_val, num_test, seed)
    if not str(source).endswith(".gz"):
        raise InputError(f"{source}: neither a world ({', '.join(WORLDS)}) nor the name of a scene file (*.jsonl.gz)")
    return read_scenes(source)


def in_split(scenes: list[Scene], split: str, source: str | Path) -> list[Scene]:
    """The scenes of one split.

    Raises:
      InputError: unknown split, or it holds no scene.
    """
    if split not in SPLITS:
        raise InputError(f"split {split!r}: choose one of {', '.join(SPLITS)}")
    chosen = [scene for scene in scenes if scene.split == split]
    if not chosen:
        held = sorted({scene.split for scene in scenes})
        raise InputError(f"{source}: holds no scene of split {split!r}; it holds {', '.join(held)}")
    return chosen


def make(
    source: str | Path = "rooms",
    split: str = "train",
    categories: tuple[str, ...] = ITHOR_CATEGORIES,
    detector: Detector | None = None,
) -> tuple[ObjectNav, EnvParams]:
    """An environment and its parameters.

    The step limits are the paper's: 30 in the training split, else 100 and in living rooms 200.

    Args:
      source: a world's name (`rooms`) or the path of a scene file.
      split: `train`, `val` or `test`.
      categories: [K] what can be sought.
      detector: error rates; None for the defaults.

    Raises:
      InputError: bad source or split, or no scene with a reachable goal.
    """
    bank = compile_bank(in_split(load_scenes(source), split, source), categories, detector)
    return build_training(bank) if split == "train" else build_evaluation(bank)


def build_training(bank: Bank, step_limit: int = 30) -> tuple[ObjectNav, EnvParams]:
    """Environment and parameters of a bank for training: one step limit for all scenes."""
    return build(bank, {}, step_limit)


def build_evaluation(bank: Bank, step_limit: int = 100, large_step_limit: int = 200) -> tuple[ObjectNav, EnvParams]:
    """Environment and parameters of a bank for evaluation: living rooms get the large step limit."""
    return build(bank, {"living_room": large_step_limit}, step_limit)
