"""The shortest-path oracle: an upper bound for agents, and a check of the environment and its metrics.

`oracle_actions` plans with the compiled tables, `run_oracle` executes the plans in the environment.
"""

import functools
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, ObjectNav, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome, finish_outcome, start_states
from jaxnav.policies.agent_loop import Agent, AgentLoop
from jaxnav.scenes.lattice import best_actions
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE


def run_oracle(
    banks: Iterable[Bank], lists: Sequence[EpisodeList], params: Iterable[EnvParams], env: ObjectNav
) -> EpisodeOutcome:
    """Run the oracle in the environment.

    Args:
      banks: the scenes.
      lists: episodes of each bank.
      params: environment parameters of each bank.
      env: the environment.

    Returns:
      Leaves [E], over the episodes of all banks.
    """
    # Pad the plans of all banks to one length, so that banks of equal sizes share one compilation.
    plans = [oracle_actions(bank, episodes) for bank, episodes in zip(banks, lists, strict=True)]
    max_length = max(map(len, plans))
    outcomes = []
    for plan, episodes, bank_params in zip(plans, lists, params, strict=True):
        actions = np.pad(plan, ((0, max_length - len(plan)), (0, 0)), constant_values=DONE)
        outcomes.append(replay_actions(jnp.asarray(actions), start_states(episodes), bank_params, env))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *outcomes)


def oracle_actions(bank: Bank, episodes: EpisodeList) -> np.ndarray:
    """Return a shortest sequence of actions for each episode.

    Returns:
      int32 [T, E], each sequence padded with Done to the longest one.
    """
    successor = bank.successor
    pose = episodes.pose
    remaining = episodes.best_length
    actions = []
    while (remaining > 0).any():
        best_action = best_actions(successor, bank.best_length, pose, episodes.goal)
        action = np.where(remaining > 0, best_action, DONE)
        actions.append(action)
        pose = successor[pose, action]
        remaining = np.maximum(remaining - 1, 0)
    return np.array(actions, np.int32)


@functools.partial(jax.jit, static_argnums=3)
def replay_actions(actions: jax.Array, state: State, params: EnvParams, env: ObjectNav) -> EpisodeOutcome:
    """Run given actions in the environment.

    Args:
      actions: int32 [T, E].
      state: start states, leaves [E].
      params: environment parameters.
      env: the environment.

    Returns:
      Leaves [E].
    """
    agent_loop = AgentLoop(env)
    batch_shape = state.pose.shape
    no_weight = jnp.zeros(batch_shape)  # no logits are removed

    def step(carry: tuple[Agent, jax.Array, EpisodeOutcome], action: jax.Array) -> tuple[tuple, None]:
        agent, running, outcome = carry
        agent, result = agent_loop.step(agent, action, None, params)
        outcome = outcome.add_step(running, action, result, no_weight)
        return (agent, running & ~result.ended, outcome), None

    agent = agent_loop.start_from(state, None, None, params)
    initial_carry = (agent, jnp.ones(batch_shape, bool), EpisodeOutcome.zeros(batch_shape))
    (agent, _, outcome), _ = jax.lax.scan(step, initial_carry, actions)

    return finish_outcome(outcome, agent.state, env, params)
