"""What a search with a map knew at one step of an episode, and what it meant to do."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.errors import InputError
from jaxnav.policies.methods import Knowledge, Percept, find_method
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import Course, found
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.scenes.task import LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT
from jaxnav.viz.panel import Episode

AHEAD = 80  # actions to look ahead at most


class Search(NamedTuple):
    """Hold a map and a plan.

    Attributes:
      course: with the map, after the choice of the step; leaves are NumPy arrays.
      planned: int32 [L, 2], cells (z, x) where the next actions lead if nothing new is seen.
    """

    course: Course
    planned: np.ndarray

    @property
    def searching(self) -> bool:
        """Return whether the goal is not on the map."""
        return not found(jax.tree.map(jnp.asarray, self.course))


def search_at(episode: Episode, step: int) -> Search:
    """Return the map and the plan of a step.

    Args:
      episode: as played.
      step: from 0.

    Raises:
      InputError: the method keeps no map, or the episode has no such step.
    """
    name, steps = episode.policies.spec.method, len(episode.trace.pose)
    method, knowledge = find_method(name), episode.policies.knowledge
    control = method.control
    if not isinstance(control, LocalPolicy) or method.tracker is None:
        raise InputError(f"--map: method {name!r} keeps no map to plan on; give a run of semexp")
    if not 0 <= step < steps:
        raise InputError(f"--step {step + 1}: give a number from 1 to {steps}")
    tracker = method.tracker

    def take_in(note: Course, seen: tuple[Percept, jax.Array]) -> tuple[Course, None]:
        percept, choice = seen
        return control.act(choice, tracker.update(note, knowledge, percept), knowledge)[1], None

    percepts, choices = _percepts(episode), jnp.asarray(episode.trace.inferred.corrected.argmax(axis=-1))
    seen = jax.tree.map(lambda leaf: leaf[: step + 1], (percepts, choices))
    course, _ = jax.jit(lambda seen: jax.lax.scan(take_in, tracker.init(knowledge), seen))(seen)
    planned = jax.jit(lambda course: plan(control, course, choices[step], knowledge))(course)
    return Search(jax.tree.map(np.asarray, course), np.asarray(planned))


def plan(control: LocalPolicy, course: Course, choice: jax.Array, knowledge: Knowledge) -> jax.Array:
    """Return where the next actions lead if nothing new is seen.

    Returns:
      int32 [AHEAD, 2], cells (z, x).
    """
    strides, size = knowledge.method["steps"], len(course.cells)

    def go(body: tuple[jax.Array, ...], _: None) -> tuple[tuple[jax.Array, ...], jax.Array]:
        place, heading, horizon = body
        now = course._replace(place=place, heading=heading, horizon=horizon)
        action = control.act(choice, now, knowledge)[0]
        ahead = (place + strides[heading]) % size
        turn = (action == ROTATE_RIGHT).astype(jnp.int32) - (action == ROTATE_LEFT).astype(jnp.int32)
        tilt = (action == LOOK_DOWN).astype(jnp.int32) - (action == LOOK_UP).astype(jnp.int32)
        place = jnp.where(action == MOVE_AHEAD, ahead, place)
        return (place, (heading + turn) % len(strides), horizon + tilt), place

    return jax.lax.scan(go, (course.place, course.heading, course.horizon), length=AHEAD)[1]


def _percepts(episode: Episode) -> Percept:
    """Return what the tracker was told, leaves [T, ...]."""
    _, heading, horizon = episode.task.rules.split(episode.trace.pose)
    moved = np.concatenate([[False], (np.diff(episode.places, axis=0) != 0).any(axis=1)])
    return Percept(
        row=jnp.asarray(episode.rows),
        heading=jnp.asarray(heading),
        action=jnp.concatenate([jnp.array([NO_ACTION], jnp.int32), jnp.asarray(episode.trace.action[:-1], jnp.int32)]),
        moved=jnp.asarray(moved),
        horizon=jnp.asarray(horizon),
        goal=jnp.full(len(heading), episode.goal, jnp.int32),
    )
