"""Evaluation episodes, step by step: what was seen, believed, inferred and done."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.grid import act
from jaxnav.evaluation.inference import Inference, Inferred
from jaxnav.policies.acting import Acting, Agent, carried, select
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.policy import Params


class Trace(NamedTuple):
    """Hold the T decisions of one episode.

    Attributes:
      pose: int32 [T], pose at which each action was chosen.
      action: int32 [T]; only the last can be Done.
      inferred: how each action was inferred, leaves [T, ...].
      success: whether the episode ended with Done where it succeeds.
    """

    pose: np.ndarray
    action: np.ndarray
    inferred: Inferred
    success: bool

    @property
    def gap(self) -> np.ndarray:
        """Return the layout gap D, float32 [T]."""
        return np.asarray(self.inferred.gap)


class _Step(NamedTuple):
    """Hold one step of E episodes, leaves [E, ...]."""

    pose: jax.Array
    action: jax.Array
    inferred: Inferred
    success: jax.Array
    running: jax.Array


def play(
    cell: Inference,
    weights: Params,
    start: State,
    acting: Acting,
    params: EnvParams,
    knowledge: Knowledge,
) -> list[Trace]:
    """Play episodes to their ends, step by step.

    Args:
      cell: how to infer, leaves []; `cell.params` is not used.
      weights: parameters of the policy.
      start: of the episodes, leaves [E].
      acting: how to act.
      params: the environment's.
      knowledge: what was learned before training.
    """
    count = len(start.pose)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), jnp.arange(count))
    agent, running = _begin(weights, start, acting, params, knowledge), jnp.ones(count, bool)
    steps = []
    while running.any():
        before = running
        agent, running, step = _step(cell, weights, agent, running, keys, acting, params, knowledge)
        steps.append(jax.tree.map(np.asarray, step._replace(running=before)))
    course = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *steps)  # [E, T, ...]
    return [_trace(jax.tree.map(lambda leaf, e=e: leaf[e], course)) for e in range(count)]


def _trace(course: _Step) -> Trace:
    """Return the part of a course in which the episode runs."""
    pose, action, inferred, success, _ = jax.tree.map(lambda leaf: leaf[course.running], course)
    return Trace(pose, action, inferred, bool(success[-1]))


@functools.partial(jax.jit, static_argnames="acting")
def _begin(weights: Params, start: State, acting: Acting, params: EnvParams, knowledge: Knowledge) -> Agent:
    return acting.begin(start, acting.bind(weights).initial_memory(start.pose.shape), knowledge, params)


@functools.partial(jax.jit, static_argnames="acting")
def _step(
    cell: Inference,
    weights: Params,
    agent: Agent,
    running: jax.Array,
    keys: jax.Array,
    acting: Acting,
    params: EnvParams,
    knowledge: Knowledge,
) -> tuple[Agent, jax.Array, _Step]:
    """Act once where episodes run; return what runs on, and the step."""
    policy = acting.bind(weights)
    after, taken, inferred = act(cell, policy, agent, running, keys, acting, params, knowledge)
    step = _Step(agent.state.pose, carried(taken.agent).action, inferred, taken.success, running)
    return select(running, after, agent), running & ~taken.ended, step
