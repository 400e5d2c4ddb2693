"""One evaluation episode, step by step: what was seen, believed and done."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.grid import act
from jaxnav.evaluation.inference import Inference
from jaxnav.policies.acting import Acting, Agent, Taken, carried
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.policy import Params


class Trace(NamedTuple):
    """Hold the T decisions of one episode.

    Attributes:
      pose: int32 [T], pose at which each action was chosen.
      action: int32 [T]; only the last can be Done.
      gap: float32 [T], layout gap D.
      success: whether the episode ended with Done where it succeeds.
    """

    pose: np.ndarray
    action: np.ndarray
    gap: np.ndarray
    success: bool


def play(
    cell: Inference,
    weights: Params,
    start: State,
    acting: Acting,
    params: EnvParams,
    knowledge: Knowledge,
) -> Trace:
    """Play one episode to its end, step by step.

    Args:
      cell: how to infer, leaves []; `cell.params` is not used.
      weights: parameters of the policy.
      start: of the episode, leaves [].
      acting: how to act.
      params: the environment's.
      knowledge: what was learned before training.
    """

    @jax.jit
    def step(weights: Params, agent: Agent, keys: jax.Array) -> tuple[Agent, Taken]:
        after, taken, _ = act(cell, acting.bind(weights), agent, jnp.ones(1, bool), keys, acting, params, knowledge)
        return after, taken

    keys = jax.random.key(0)[None]
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], start)
    agent = acting.begin(first, acting.bind(weights).initial_memory((1,)), knowledge, params)
    steps = []
    while True:
        pose, gap = agent.state.pose, acting.gap(agent)
        agent, taken = step(weights, agent, keys)
        steps.append((pose[0], carried(taken.agent).action[0], gap[0]))
        if taken.ended[0]:
            break
    pose, action, gap = (np.asarray(column) for column in zip(*steps, strict=True))
    return Trace(pose=pose, action=action, gap=gap, success=bool(taken.success[0]))
