"""gymnax 1.0's wrappers use the environment as it is, and rejax trains on it through gymnax's own adapter.

Neither is among the development requirements: gymnax 1.0.1 wants gymnasium below 1.4 and imports six without asking for
it, rejax 0.1.3 wants distrax, which wants a nightly build of TensorFlow Probability. CI installs them for these tests:

    pip install gymnax==1.0.1 six rejax==0.1.3
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnav
from jaxnav.scenes.task import DONE

wrappers = pytest.importorskip("gymnax.wrappers")
jaxnav_gymnax = pytest.importorskip("jaxnav.env.gymnax")

KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def user_promotion():
    """The promotion rules of users: the arithmetic of gymnax and rejax needs them."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="module")
def flat_env():
    """The environment and its parameters."""
    return jaxnav_gymnax.make("rooms", split="val")


def test_flat_observation_holds_the_entries_of_the_row(flat_env):
    env, params = flat_env
    row_env, _ = jaxnav.make("rooms", split="val")
    num_episodes = 64
    num_categories = len(env.categories)

    # Both environments start the same episodes.
    keys = jax.random.split(KEY, num_episodes)
    flat_observations, state = jax.vmap(env.reset, (0, None))(keys, params)
    row_observations, row_state = jax.vmap(row_env.reset, (0, None))(keys, params)
    np.testing.assert_array_equal(state.pose, row_state.pose)

    # Shape, type and bounds are those of the space: four numbers and a goal of each category, two masks of 11 x 11.
    space = env.observation_space(params)
    assert flat_observations.shape == (num_episodes, *space.shape) == (num_episodes, 5 * num_categories + 2 * 121)
    assert flat_observations.dtype == space.dtype == jnp.float32
    assert jax.vmap(space.contains)(flat_observations).all()

    # Detections in units: confidence of 255, 51 bytes a metre ahead, 25.4 to the right around 128, size of 127.5.
    detection_bytes = np.asarray(row_env.row_format.detections(row_observations.row), np.float64)
    is_detected = detection_bytes[..., 0] > 0
    expected_detections = (detection_bytes - [0, 0, 128, 0]) / [255, 51, 25.4, 127.5] * is_detected[..., None]
    detections = np.asarray(flat_observations[:, : 4 * num_categories]).reshape(num_episodes, num_categories, 4)
    np.testing.assert_allclose(detections, expected_detections, rtol=1e-5, atol=1e-6)
    assert is_detected.any()

    # The goal, then the masks of free and blocked cells.
    one_hot_goals = flat_observations[:, 4 * num_categories : 5 * num_categories]
    np.testing.assert_array_equal(one_hot_goals.argmax(axis=1), row_observations.goal)
    free_mask, blocked_mask = np.split(np.asarray(flat_observations[:, 5 * num_categories :]), 2, axis=1)
    np.testing.assert_array_equal(free_mask + 2 * blocked_mask, row_env.row_format.view_cells(row_observations.row))


def test_log_wrapper_counts_returns_and_lengths(flat_env):
    """Two turns and a Done: three steps, and the sum of their rewards."""
    env = wrappers.LogWrapper(flat_env[0])
    params = flat_env[1]
    _, state = env.reset(KEY, params)
    total_reward = 0.0
    for action in (1, 2, DONE):
        _, state, reward, terminated, truncated, info = env.step(KEY, state, jnp.int32(action), params)
        total_reward += float(reward)
    assert (bool(terminated), bool(truncated), bool(info["returned_episode"])) == (True, False, True)
    assert int(info["returned_episode_lengths"]) == 3
    assert float(info["returned_episode_returns"]) == pytest.approx(total_reward)


def test_sticky_action_wrapper_replays_the_last_action(flat_env):
    env = wrappers.StickyActionWrapper(flat_env[0], 1.0)
    params = flat_env[1]
    _, state = env.reset(KEY, params)
    first_pose = state.env_state.pose

    # With probability 1 the last action is repeated, which before the first step is MoveAhead.
    _, state, *_, info = env.step(KEY, state, jnp.int32(DONE), params)
    assert int(info["length"]) == 1
    assert int(state.env_state.pose) == int(flat_env[0].next_pose(first_pose, jnp.int32(0), params))


def test_flatten_wrapper_changes_nothing(flat_env):
    env = wrappers.FlattenObservationWrapper(flat_env[0])
    params = flat_env[1]
    observation, state = env.reset(KEY, params)
    assert env.observation_space(params).shape == observation.shape
    *_, info = env.step(KEY, state, jnp.int32(1), params)
    assert info["final_observation"].shape == observation.shape


def test_legacy_step_wrapper_gives_five_values(flat_env):
    env = wrappers.LegacyStepAPIWrapper(flat_env[0])
    params = flat_env[1]
    _, state = env.reset(KEY, params)
    _, _, _, done, info = env.step(KEY, state, jnp.int32(DONE), params)
    assert bool(done)
    assert int(info["length"]) == 1


def test_gymnax_to_gym_wrapper_makes_a_gymnasium_environment(flat_env):
    env = wrappers.GymnaxToGymWrapper(flat_env[0], params=flat_env[1])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(np.asarray(observation))
    _, _, terminated, truncated, _ = env.step(DONE)
    assert (bool(terminated), bool(truncated)) == (True, False)


class RejaxAdapter(wrappers.LegacyStepAPIWrapper):
    """gymnax's adapter; rejax copies it deeply, which without this method recurses without end."""

    def __deepcopy__(self, memo):
        return self


@pytest.mark.exhaustive
def test_rejax_ppo_improves_on_the_untrained_policy(flat_env):
    """Mean returns of 128 episodes: about 1.5 against 0.5 untrained; shortest paths give about 5."""
    rejax = pytest.importorskip("rejax")
    evaluate = pytest.importorskip("rejax.evaluate").evaluate
    env, params = flat_env
    trainer = rejax.PPO.create(
        env=RejaxAdapter(env),
        env_params=params,
        total_timesteps=262_144,
        eval_freq=262_144,
        num_envs=128,
        num_steps=32,
        num_epochs=2,
        num_minibatches=4,
        learning_rate=1e-3,
        ent_coef=0.01,
        skip_initial_evaluation=True,
    )

    def mean_return(train_state):
        act = trainer.make_act(train_state)
        _, returns = evaluate(act, jax.random.key(1), trainer.env, params, 128, 100)
        return float(returns.mean())

    untrained_return = mean_return(jax.jit(trainer.init_state)(KEY))
    trained_state, (_, evaluated_returns) = jax.jit(trainer.train)(KEY)
    assert evaluated_returns.shape == (1, 128)  # of rejax's own evaluation, after the last step
    assert mean_return(trained_state) > untrained_return + 0.5
