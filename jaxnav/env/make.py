"""From the name of a world to an environment."""

import dataclasses
from pathlib import Path

from jaxnav.env.build import build
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.errors import InputError
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, Scenes, from_file, generated, shifted


def make(
    world: str = "rooms",
    split: str = "train",
    scenes: str | Path | None = None,
    task: Task | None = None,
    seed: int = 0,
    shift: float = 0.0,
) -> tuple[ObjectNav, EnvParams]:
    """Make an environment and its parameters.

    Args:
      world: `rooms`, `apartments` or `houses`: what is asked of the agent and how long episodes may last, and the
        scenes themselves where `scenes` is None.
      split: `train`, `val` or `test`; training episodes are shorter.
      scenes: path of a scene file to read instead.
      task: what is asked instead of the world's own.
      seed: of the generated scenes, and of the shift.
      shift: layout shift, from 0 to 1: the share of the categories that exchange their places.

    Raises:
      InputError: bad world, split or scene file, or no scene with a reachable goal.
    """
    if world not in WORLDS:
        raise InputError(f"world {world!r}: choose one of {', '.join(WORLDS)}; a scene file goes to `scenes`")
    usual = WORLDS[world]
    task = task or usual.task
    unshifted: Scenes = generated(world, split, None, seed) if scenes is None else from_file(scenes, split)
    chosen = shifted(unshifted, task, shift, seed)
    bank = compile_bank((chosen[i] for i in range(len(chosen))), task)
    if split == "train":
        env, params = build(bank, {}, usual.train_step_limit, shaping=usual.shaping)
        env = dataclasses.replace(env, near_starts=usual.near_starts)
    else:
        env, params = build(bank, {"living_room": usual.large_step_limit}, usual.step_limit)
    return dataclasses.replace(env, made_with=params), params
