"""A public check of the environment contract, for environments and banks of one's own.

In the style of `jumanji.testing`: run it in a test; it raises `AssertionError` with the promise that is broken.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, Observation


def check_environment(
    env: ObjectNav, params: EnvParams, num_envs: int = 16, num_steps: int = 64, seed: int = 0
) -> None:
    """Check that an environment keeps its promises.

    It checks: one compilation for reset and step; equal keys give equal episodes; shapes, dtypes and ranges of outputs;
    terminated and truncated never together; a batch of N behaves as N single episodes; time starts anew after an ending
    and the final state is the one before the reset; observations equal `observe(state)`.

    Raises:
      AssertionError: a promise is broken.
    """
    chex.clear_trace_counter()
    reset = jax.jit(jax.vmap(chex.assert_max_traces(env.reset, n=1), (0, None)))
    step = jax.jit(jax.vmap(chex.assert_max_traces(env.step, n=1), (0, 0, 0, None)))
    key = jax.random.key(seed)
    keys = jax.random.split(key, num_envs)
    observation, state = reset(keys, params)
    chex.assert_trees_all_equal((observation, state), reset(keys, params))
    _check_observation(env, observation, num_envs)

    for time in range(num_steps):
        now = jax.random.fold_in(key, time)
        keys = jax.random.split(now, num_envs)
        action = jax.random.randint(jax.random.fold_in(now, 1), (num_envs,), 0, env.num_actions)
        before = state
        result = step(keys, state, action, params)
        observation, state, reward, terminated, truncated, info = result
        one_key, one_state, one_action = jax.tree.map(lambda leaf: leaf[0], (keys, before, action))
        single = env.step(one_key, one_state, one_action, params)
        chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[0], result), single)
        _check_observation(env, observation, num_envs)
        _check_observation(env, info["final_observation"], num_envs)
        chex.assert_trees_all_equal(observation, jax.vmap(env.observe, (0, None))(state, params))
        chex.assert_tree_all_finite((reward, state, info))
        chex.assert_shape([reward, terminated, truncated, info["success"], info["length"]], (num_envs,))
        chex.assert_type([reward, terminated, truncated, info["success"]], [jnp.float32, bool, bool, bool])
        _promise(not bool(np.any(terminated & truncated)), "an episode is terminated and truncated at once")
        _promise(not bool(np.any(info["success"] & ~terminated)), "a success that is not an ending")
        ended = np.asarray(terminated | truncated)
        _promise(bool(np.all(info["final_state"].time == before.time + 1)), "a step that takes no time")
        _promise(bool(np.all(np.asarray(state.time)[ended] == 0)), "an ending that is not followed by a new episode")
        for leaf, last in zip(jax.tree.leaves(state), jax.tree.leaves(info["final_state"]), strict=True):
            _promise(bool(np.all((leaf == last) | ended)), "a state that changes after a step without an ending")


def _check_observation(env: ObjectNav, observation: Observation, num_envs: int) -> None:
    chex.assert_shape(observation.row, (num_envs, env.row_format.num_bytes))
    chex.assert_type([observation.row, observation.goal], [jnp.uint8, jnp.int32])
    goal = np.asarray(observation.goal)
    _promise(bool(np.all((goal >= 0) & (goal < len(env.categories)))), "a goal that is no category")


def _promise(kept: bool, broken: str) -> None:
    if not kept:
        raise AssertionError(f"the environment breaks its contract: {broken}")
