"""One evaluation episode, step by step: what was seen, believed and done."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.causal import Form, do, stde
from jaxnav.env.types import EnvParams, State
from jaxnav.policies.acting import Acting, Agent
from jaxnav.policies.pathways import Memory
from jaxnav.policies.policy import Params, bind
from jaxnav.policies.spec import PolicySpec


class Trace(NamedTuple):
    """The T decisions of one episode.

    Attributes:
      pose: int32 [T], pose at which each action was chosen.
      action: int32 [T]; only the last can be Done.
      gap: float32 [T], layout gap D.
      success: whether the episode ended with Done where the goal is found.
    """

    pose: np.ndarray
    action: np.ndarray
    gap: np.ndarray
    success: bool


def play(
    weights: Params,
    start: State,
    acting: Acting,
    spec: PolicySpec,
    params: EnvParams,
    priors: jax.Array,
    epsilon: float = float("inf"),
    use_layout: bool = True,
    form: Form = "residual",
) -> Trace:
    """Play one episode to its end, taking the best action at every step.

    Args:
      weights: parameters of one policy.
      start: of the episode, leaves [].
      acting: environment and layout setting; without a setting the gap stays 0.
      spec: sizes of the policy.
      params: the environment's.
      priors: float32 [rooms, K, K].
      epsilon: threshold of sTDE; infinity takes no experience out.
      use_layout: multiply the layout's weights in; otherwise they are ones.
      form: how sTDE combines the logits.
    """

    @jax.jit
    def step(weights: Params, agent: Agent) -> tuple[Agent, jax.Array, jax.Array, jax.Array]:
        policy = bind(spec, weights)
        observation, layout_weights = acting.observe(agent, params)
        layout_weights = layout_weights if use_layout else jnp.ones_like(layout_weights)
        pathways = policy.pathways(observation, layout_weights)
        factual = policy.decide(pathways, agent.memory)
        counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), agent.memory)
        logits = stde(factual.logits, counterfactual.logits, acting.gap(agent), epsilon, form)
        action = jnp.argmax(logits, axis=-1).astype(jnp.int32)
        found = jax.vmap(acting.env.found, (0, None))(agent.state, params)
        state, _, done, truncated = jax.vmap(acting.env.advance, (0, 0, None))(agent.state, action, params)
        layout = acting.believe(agent.layout, state, params, priors)
        return Agent(state, layout, Memory(factual.hidden, action)), action, done | truncated, done & found

    state = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], start)
    layout = acting.believe(acting.first_belief(state, params, priors), state, params, priors)
    agent = Agent(state=state, layout=layout, memory=bind(spec, weights).initial_memory((1,)))
    steps, ended, success = [], jnp.array([False]), jnp.array([False])
    while not ended[0]:
        pose, gap = agent.state.pose, acting.gap(agent)
        agent, action, ended, success = step(weights, agent)
        steps.append((pose[0], action[0], gap[0]))
    pose, action, gap = (np.asarray(column) for column in zip(*steps, strict=True))
    return Trace(pose=pose, action=action, gap=gap, success=bool(success[0]))
