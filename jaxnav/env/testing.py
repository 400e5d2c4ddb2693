"""Check of the environment contract, for environments and scenes of your own.

`check_environment` runs random episodes, in the style of `jumanji.testing`. Call it in a test; an `AssertionError`
names the promise that is broken.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation


def check_environment(
    env: ObjectNav, params: EnvParams, num_envs: int = 16, num_steps: int = 64, seed: int = 0
) -> None:
    """Check that an environment keeps its contract.

    The checks: reset and step compile once; equal keys give equal resets; outputs have their shapes, dtypes and
    ranges; no episode is terminated and truncated at once; the first episode of a batch equals the same episode alone;
    time restarts after an episode ends, and the final state is the one before the reset; observations equal
    `observe(state)`.

    Args:
      env: environment to check.
      params: its parameters.
      num_envs: number of parallel episodes.
      num_steps: number of random actions in each.
      seed: seed of episodes and actions.

    Raises:
      AssertionError: a promise is broken.
    """
    # A second compilation of reset or step raises an AssertionError; with JAX_DISABLE_JIT nothing is compiled.
    chex.clear_trace_counter()
    max_traces = 2**31 if jax.config.values["jax_disable_jit"] else 1
    batched_reset = jax.jit(jax.vmap(chex.assert_max_traces(env.reset, n=max_traces), (0, None)))
    batched_step = jax.jit(jax.vmap(chex.assert_max_traces(env.step, n=max_traces), (0, 0, 0, None)))
    reset_key, action_key, step_key = jax.random.split(jax.random.key(seed), 3)

    # Resets are reproducible.
    reset_keys = jax.random.split(reset_key, num_envs)
    observation, state = batched_reset(reset_keys, params)
    chex.assert_trees_all_equal((observation, state), batched_reset(reset_keys, params))
    _check_observation(env, observation, num_envs)

    for step_index in range(num_steps):
        # Take random actions.
        step_keys = jax.random.split(jax.random.fold_in(step_key, step_index), num_envs)
        action = jax.random.randint(jax.random.fold_in(action_key, step_index), (num_envs,), 0, env.num_actions)
        last_state = state
        step_result = batched_step(step_keys, state, action, params)
        observation, state, reward, terminated, truncated, step_info = step_result

        # The first episode of the batch equals the same step of a single episode.
        first_key, first_state, first_action = jax.tree.map(
            lambda batch_leaf: batch_leaf[0], (step_keys, last_state, action)
        )
        first_result = jax.tree.map(lambda batch_leaf: batch_leaf[0], step_result)
        chex.assert_trees_all_equal(first_result, env.step(first_key, first_state, first_action, params))

        # Shapes, dtypes and finite values.
        _check_observation(env, observation, num_envs)
        _check_observation(env, step_info["final_observation"], num_envs)
        chex.assert_trees_all_equal(observation, jax.vmap(env.observe, (0, None))(state, params))
        chex.assert_tree_all_finite((reward, state, step_info))
        chex.assert_shape([reward, terminated, truncated, step_info["success"], step_info["length"]], (num_envs,))
        chex.assert_type([reward, terminated, truncated, step_info["success"]], [jnp.float32, bool, bool, bool])

        # Endings, and the new episodes that follow them.
        has_ended = np.asarray(terminated | truncated)
        _promise(not bool(np.any(terminated & truncated)), "an episode is terminated and truncated at once")
        _promise(not bool(np.any(step_info["success"] & ~terminated)), "an episode succeeds without being terminated")
        _promise(bool(np.all(step_info["final_state"].time == last_state.time + 1)), "a step does not add 1 to `time`")
        _promise(
            bool(np.all(np.asarray(state.time)[has_ended] == 0)), "no new episode begins after an episode has ended"
        )
        for state_leaf, final_leaf in zip(
            jax.tree.leaves(state), jax.tree.leaves(step_info["final_state"]), strict=True
        ):
            _promise(
                bool(np.all((state_leaf == final_leaf) | has_ended)),
                "the state is reset although the episode has not ended",
            )


def _check_observation(env: ObjectNav, observation: Observation, num_envs: int) -> None:
    chex.assert_shape(observation.row, (num_envs, env.row_format.num_bytes))
    chex.assert_type([observation.row, observation.goal], [jnp.uint8, jnp.int32])
    goal = np.asarray(observation.goal)
    _promise(bool(np.all((goal >= 0) & (goal < len(env.categories)))), "a goal is not the index of a category")


def _promise(is_kept: bool, violation: str) -> None:
    if not is_kept:
        raise AssertionError(f"the environment breaks its contract: {violation}")
