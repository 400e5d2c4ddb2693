"""The shortest-path oracle: it knows the way, walks it in the environment, and so checks environment and metrics."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome, first_states
from jaxnav.scenes.compile import Bank
from jaxnav.scenes.task import DONE, MOVE_AHEAD


def oracle_actions(bank: Bank, episodes: EpisodeList) -> np.ndarray:
    """A shortest sequence of actions for each episode, int32 [T, E], its Done repeated up to the longest one."""
    successor, goal = bank.successor, episodes.goal
    pose, left, actions = episodes.pose, episodes.best_length, []
    while (left > 0).any():
        after = successor[pose]
        nearer = bank.best_length[after[:, :DONE], goal[:, None]] == (left - 1)[:, None]
        action = np.where(left > 1, nearer.argmax(axis=1), DONE)
        pose, left = after[np.arange(len(pose)), action], np.maximum(left - 1, 0)
        actions.append(action)
    return np.array(actions, np.int32)


def replay(actions: np.ndarray, episodes: EpisodeList, env: ObjectNav, params: EnvParams) -> Outcome:
    """What the environment makes of fixed actions int32 [T, E]; leaves [E]."""

    def step(carry: tuple[State, jax.Array, Outcome], action: jax.Array) -> tuple[tuple, None]:
        state, running, outcome = carry
        found = jax.vmap(env.found, (0, None))(state, params)
        state, _, terminated, truncated = jax.vmap(env.advance, (0, 0, None))(state, action, params)
        outcome = outcome._replace(
            success=outcome.success | (running & terminated & found),
            length=outcome.length + running.astype(jnp.int32),
            moves=outcome.moves + (running & (action == MOVE_AHEAD)).astype(jnp.int32),
        )
        return (state, running & ~terminated & ~truncated, outcome), None

    @jax.jit
    def run(actions: jax.Array, state: State, params: EnvParams) -> Outcome:
        first = (state, jnp.ones(state.pose.shape, bool), Outcome.start(state.pose.shape))
        (state, _, outcome), _ = jax.lax.scan(step, first, actions)
        return outcome._replace(distance=params.tables.goal_distance[env.cell(state.pose), state.goal])

    return jax.tree.map(np.asarray, run(jnp.asarray(actions), first_states(episodes), params))
