"""Where an episode has been, pose by pose."""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.methods.base import Knowledge, Percept
from jaxnav.scenes.tables.compile import Bank

_SIDE = 2**13  # cells of a line; with 12 headings and 2 horizons the numbers of poses fit in 31 bits
_NOWHERE = np.iinfo(np.int32).min


class Trail(NamedTuple):
    """Hold the poses of one episode.

    Attributes:
      poses: int32 [N], numbers of the last ones, the present one at the end.
      place: int32 [2], (dz, dx) in cells from where the episode began.
      repeated: bool [], whether the present pose is among those before.
    """

    poses: jax.Array
    place: jax.Array
    repeated: jax.Array


@dataclasses.dataclass(frozen=True)
class PoseTracker:
    """Tell by compass, odometry and horizon whether the agent was here before.

    A pose is cell, heading and horizon. The method's knowledge is that of `learn_motion`.

    Attributes:
      length: N, poses that are remembered.
    """

    length: int = 100

    def init(self, knowledge: Knowledge) -> Trail:
        """Return a trail that has not begun."""
        nowhere = jnp.full(self.length, _NOWHERE, jnp.int32)
        return Trail(nowhere, jnp.zeros(2, jnp.int32), jnp.bool_(False))

    def update(self, note: Trail, knowledge: Knowledge, percept: Percept) -> Trail:
        """Go on to the present pose."""
        strides, horizons = knowledge.method["steps"], knowledge.method["horizons"]
        place = note.place + jnp.where(percept.moved, strides[percept.heading], 0)
        pose = ((place[0] * _SIDE + place[1]) * len(strides) + percept.heading) * horizons + percept.horizon
        poses = jnp.concatenate([note.poses[1:], pose[None]])
        return Trail(poses, place, (note.poses == pose).any())

    def read(self, note: Trail, knowledge: Knowledge, goal: jax.Array) -> jax.Array:
        """Return whether the present pose is repeated, bool []."""
        return note.repeated


def learn_motion(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return how the task's agent moves.

    Args:
      banks: of training scenes; the first one's task is that of all.
      counts: of exploration, unused.

    Returns:
      By name `steps`, int32 [H, 2], the displacement (dz, dx) of a step ahead by heading, and `horizons`, int32 [], the
      number of horizons.
    """
    rules = next(iter(banks)).task.rules
    return {"steps": rules.steps().astype(np.int32), "horizons": np.array(len(rules.horizons), np.int32)}
