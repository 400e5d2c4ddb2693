"""Settings of a game; a module of its own, so that the help of the command needs no JAX."""

import dataclasses
from pathlib import Path

from jaxnav.choices import ShiftKind, Split, WorldName


@dataclasses.dataclass(frozen=True)
class PlayConfig:
    """Settings of an episode that you play yourself.

    Attributes:
      world: generated world, which sets scenes and rules.
      scenes: scene file to use instead of generated scenes.
      split: scenes to play in.
      goal: category to search for. By default, a random goal.
      seed: random seed of the scenes and of the episode, at least 0.
      shift: layout shift of the scenes, from 0 (as in training) to 1.
      shift_by: categories that exchange their places under a shift. `size`: neighbours in size, drawn for each scene.
        `context`: the ones whose exchange misleads most, fitted to the training scenes and equal in all scenes.
      policy: policy whose advice and belief are shown: the folder of an exported policy, or the name of a packaged
        policy, such as `rooms-org`. Without a policy, the belief starts from random walks in training scenes.
      epsilon: threshold of sTDE in the advice of the policy, at least 0.
    """

    world: WorldName = "rooms"
    scenes: Path | None = None
    split: Split = "val"
    goal: str | None = None
    seed: int = 0
    shift: float = 0.0
    shift_by: ShiftKind = "size"
    policy: str | None = None
    epsilon: float = 0.5
