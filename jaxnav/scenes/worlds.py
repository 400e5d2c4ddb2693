"""The worlds of the paper, and scenes as sequences."""

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from jaxnav.errors import InputError, MissingSplitError
from jaxnav.scenes.exchange import check_shift, exchange_places
from jaxnav.scenes.files.record import read_bytes
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.generate.homes import generate_apartment, generate_house
from jaxnav.scenes.generate.rooms import generate_room_at
from jaxnav.scenes.scene import SPLITS, Scene
from jaxnav.scenes.task import APARTMENTS, HOUSES, ROOMS, Task


@dataclasses.dataclass(frozen=True)
class World:
    """Describe what the scenes of a world have in common.

    Attributes:
      generate: a scene from (split, index, seed).
      counts: usual number of scenes of each split.
      task: categories, goals and rules.
      total_steps: environment steps that a policy is usually trained for.
      train_step_limit: actions of a training episode.
      step_limit: actions of an evaluation episode.
      large_step_limit: the same in living rooms.
      shaping: reward in training for every metre nearer to the goal than before in the episode, needed where goals are
        rarely reached by chance.
      near_starts: probability that a training episode starts near its goal, for the same reason.
      budgets: actions within which success is counted too: where experience is worth most, and later.
    """

    generate: Callable[[str, int, int], Scene]
    counts: dict[str, int]
    task: Task
    total_steps: int
    train_step_limit: int
    step_limit: int
    large_step_limit: int
    shaping: float
    near_starts: float
    budgets: tuple[int, int]


#: AI2-THOR, RoboTHOR and Gibson in the paper.
WORLDS = {
    "rooms": World(
        generate=generate_room_at,
        counts={"train": 80, "val": 20, "test": 20},
        task=ROOMS,
        total_steps=1_200_000,
        train_step_limit=100,
        step_limit=100,
        large_step_limit=200,
        shaping=0.0,
        near_starts=0.0,
        budgets=(20, 50),
    ),
    "apartments": World(
        generate=generate_apartment,
        counts={"train": 120, "val": 15, "test": 15},
        task=APARTMENTS,
        total_steps=6_000_000,
        train_step_limit=100,
        step_limit=500,
        large_step_limit=500,
        shaping=1.0,
        near_starts=0.5,
        budgets=(50, 150),
    ),
    "houses": World(
        generate=generate_house,
        counts={"train": 100, "val": 10, "test": 10},
        task=HOUSES,
        total_steps=6_000_000,
        train_step_limit=100,
        step_limit=500,
        large_step_limit=500,
        shaping=1.0,
        near_starts=0.5,
        budgets=(50, 150),
    ),
}

_STAND_FOR = {
    "robothor": "apartments",
    "apartments": "apartments",
    "procthor": "houses",
    "habitat": "houses",
    "gibson": "houses",
    "houses": "houses",
}


def world_named(origin: str) -> str:
    """Return the name of the world that scenes of an origin stand for.

    Args:
      origin: the `world` of a scene, such as `robothor`; one that is not known stands for `rooms`.
    """
    return _STAND_FOR.get(origin, "rooms")


class Scenes(Protocol):
    """Provide the scenes of one split, in order.

    A scene is made on access.
    """

    @property
    def identity(self) -> str:
        """Return a text that differs wherever the scenes differ."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Scene: ...


@dataclasses.dataclass(frozen=True)
class GeneratedScenes:
    """Generate the scenes of a world on access.

    Attributes:
      world: its name, a key of `WORLDS`.
      split: `train`, `val` or `test`.
      count: number of scenes.
      seed: of the generator, at least 0.
    """

    world: str
    split: str
    count: int
    seed: int = 0

    @property
    def identity(self) -> str:
        """Return the arguments of the generator."""
        return repr(self)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Scene:
        if not 0 <= index < self.count:
            raise IndexError(index)
        return WORLDS[self.world].generate(self.split, index, self.seed)


@dataclasses.dataclass(frozen=True)
class FileScenes:
    """Hold the scenes of a file.

    Attributes:
      scenes: as read.
      identity: split and checksum of the file.
    """

    scenes: tuple[Scene, ...]
    identity: str

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Scene:
        return self.scenes[index]


@dataclasses.dataclass(frozen=True)
class ShiftedScenes:
    """Shift the layout of scenes on access.

    Attributes:
      scenes: without a shift.
      task: its categories exchange their places.
      shift: share of the categories, from 0 to 1; see `exchange_places`.
      seed: of the exchange.
    """

    scenes: Scenes
    task: Task
    shift: float
    seed: int

    @property
    def identity(self) -> str:
        """Return that of the scenes, and the shift."""
        categories, goals = self.task.categories, self.task.goals
        return f"{self.scenes.identity}, places exchanged: {self.shift}, {self.seed}, {categories}, {goals}"

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Scene:
        return exchange_places(self.scenes[index], self.task, self.shift, self.seed)


def shifted(scenes: Scenes, task: Task, shift: float, seed: int = 0) -> Scenes:
    """Return scenes with a shifted layout.

    Args:
      scenes: of a file or of a generated world.
      task: its categories exchange their places; see `exchange_places`.
      shift: layout shift, from 0 (the scenes themselves) to 1.
      seed: of the exchange, at least 0.

    Raises:
      InputError: an impossible number.
    """
    check_shift(shift, seed)
    return ShiftedScenes(scenes, task, shift, seed) if shift else scenes


def generated(world: str, split: str, count: int | None = None, seed: int = 0) -> GeneratedScenes:
    """Describe the scenes of one split of a generated world.

    Args:
      world: a key of `WORLDS`.
      split: `train`, `val` or `test`.
      count: number of scenes; None for the world's usual one.
      seed: of the generator, at least 0.

    Raises:
      InputError: an unknown name, or an impossible number.
    """
    if world not in WORLDS:
        raise InputError(f"world {world!r}: choose one of {', '.join(WORLDS)}")
    _check_split(split)
    count = WORLDS[world].counts[split] if count is None else count
    if count < 1:
        raise InputError(f"world {world!r}: {count} scenes of split {split!r}; ask for at least one")
    if seed < 0:
        raise InputError(f"world {world!r}: seed {seed}; give a number of at least 0")
    return GeneratedScenes(world, split, count, seed)


def from_file(path: str | Path, split: str | None) -> FileScenes:
    """Read the scenes of one split of a scene file.

    Args:
      path: the scene file.
      split: `train`, `val` or `test`; None for all scenes.

    Raises:
      MissingSplitError: the file holds no scene of the split.
      InputError: unknown split, or no readable scene file.
    """
    if split is not None:
        _check_split(split)
    scenes = read_scenes(path)
    chosen = tuple(scene for scene in scenes if split in (None, scene.split))
    if not chosen:
        held = sorted({scene.split for scene in scenes})
        raise MissingSplitError(f"{path}: holds no scene of split {split!r}; it holds {', '.join(held)}")
    return FileScenes(chosen, f"{split or 'all'} of {hashlib.sha256(read_bytes(Path(path))).hexdigest()}")


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise InputError(f"split {split!r}: choose one of {', '.join(SPLITS)}")
