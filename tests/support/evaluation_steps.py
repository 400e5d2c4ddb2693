"""Evaluation episodes of the small world, step by step, with large layout gaps."""

import jax

from jaxnav.evaluation.grid import infer_and_act
from jaxnav.evaluation.replacements import DecisionContext
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from support import tiny_world as tiny

#: A weak prior: the belief follows the first views, so gaps are large.
KNOWLEDGE = Knowledge(0.05 * tiny.knowledge().priors)
AGENT_LOOP = AgentLoop(tiny.world()[0], tiny.SPEC, tiny.ESTIMATOR)


@jax.jit
def start_agent(weights, states, env_params):
    """Return the agent of all episodes after their first view."""
    memory = AGENT_LOOP.bind(weights).initial_memory(states.pose.shape)
    return AGENT_LOOP.start_from(states, memory, KNOWLEDGE, env_params)


@jax.jit
def take_step(cell, weights, agent, running, keys, env_params):
    """Take one step by a cell of the evaluation grid."""
    context = DecisionContext(AGENT_LOOP.bind(weights), cell.use_layout, AGENT_LOOP, KNOWLEDGE, env_params)
    return infer_and_act(cell, context, agent, running, keys)
