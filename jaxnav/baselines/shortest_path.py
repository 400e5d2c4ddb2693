"""The shortest-path oracle, an upper bound and a check.

It walks a shortest path in the environment, which checks environment and metrics.
"""

import functools
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome, first_states
from jaxnav.policies.acting import Acting, Agent
from jaxnav.scenes.lattice import best_actions
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import DONE


def oracle_actions(bank: Bank, episodes: EpisodeList) -> np.ndarray:
    """Return a shortest sequence of actions for each episode.

    Returns:
      int32 [T, E], each sequence filled up with Done to the longest one.
    """
    successor, goal = bank.successor, episodes.goal
    pose, left, actions = episodes.pose, episodes.best_length, []
    while (left > 0).any():
        action = np.where(left > 0, best_actions(successor, bank.best_length, pose, goal), DONE)
        pose, left = successor[pose, action], np.maximum(left - 1, 0)
        actions.append(action)
    return np.array(actions, np.int32)


def oracle_outcome(
    banks: Iterable[Bank], lists: Sequence[EpisodeList], params: Iterable[EnvParams], env: ObjectNav
) -> Outcome:
    """Run the oracle in the environment.

    Args:
      banks: of scenes.
      lists: episodes in each.
      params: the environment's, bank by bank.
      env: the environment.

    Returns:
      Leaves [E], over the episodes of all banks.
    """
    actions = [oracle_actions(bank, episodes) for bank, episodes in zip(banks, lists, strict=True)]
    longest = max(map(len, actions))
    padded = [np.pad(steps, ((0, longest - len(steps)), (0, 0)), constant_values=DONE) for steps in actions]
    outcomes = [
        replay(jnp.asarray(steps), first_states(episodes), bank_params, env)
        for steps, episodes, bank_params in zip(padded, lists, params, strict=True)
    ]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *outcomes)


@functools.partial(jax.jit, static_argnums=3)
def replay(actions: jax.Array, state: State, params: EnvParams, env: ObjectNav) -> Outcome:
    """Run fixed actions in the environment.

    Args:
      actions: int32 [T, E].
      state: the first states, leaves [E].
      params: the environment's.
      env: the environment.

    Returns:
      Leaves [E].
    """

    acting, nothing = Acting(env), jnp.zeros(state.pose.shape)

    def step(carry: tuple[Agent, jax.Array, Outcome], action: jax.Array) -> tuple[tuple, None]:
        agent, running, outcome = carry
        agent, taken = acting.step(agent, action, None, params)
        return (agent, running & ~taken.ended, outcome.after(running, action, taken, nothing)), None

    agent = acting.begin(state, None, None, params)
    first = (agent, jnp.ones(state.pose.shape, bool), Outcome.start(state.pose.shape))
    (agent, _, outcome), _ = jax.lax.scan(step, first, actions)
    last = agent.state
    return outcome._replace(distance=params.tables.goal_distance[env.cell(last.pose), last.goal])
