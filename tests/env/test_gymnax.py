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
flat = pytest.importorskip("jaxnav.env.gymnax")

KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def usual_promotion():
    """That of users: gymnax's and rejax's own arithmetic needs it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="module")
def made():
    return flat.make("rooms", split="val")


def test_an_observation_holds_what_the_row_does(made):
    env, params = made
    plain, _ = jaxnav.make("rooms", split="val")
    keys = jax.random.split(KEY, 64)
    observations, state = jax.vmap(env.reset, (0, None))(keys, params)
    seen, same = jax.vmap(plain.reset, (0, None))(keys, params)
    np.testing.assert_array_equal(state.pose, same.pose)
    space, count = env.observation_space(params), len(env.categories)
    assert observations.shape == (64, *space.shape) == (64, 5 * count + 2 * 121)
    assert observations.dtype == space.dtype == jnp.float32
    assert jax.vmap(space.contains)(observations).all()
    table = np.asarray(observations[:, : 4 * count]).reshape(64, count, 4)
    row = np.asarray(plain.row_format.detections(seen.row), np.float64)
    is_detected = row[..., 0] > 0
    expected = (row - [0, 0, 128, 0]) / [255, 51, 25.4, 127.5] * is_detected[..., None]
    np.testing.assert_allclose(table, expected, rtol=1e-5, atol=1e-6)
    assert is_detected.any()
    np.testing.assert_array_equal(observations[:, 4 * count : 5 * count].argmax(axis=1), seen.goal)
    free, blocked = np.split(np.asarray(observations[:, 5 * count :]), 2, axis=1)
    np.testing.assert_array_equal(free + 2 * blocked, plain.row_format.view_cells(seen.row))


def test_the_log_wrapper_counts_returns(made):
    """Two turns at -0.01 and a wrong or right Done: its own reward more, in three steps."""
    env, params = wrappers.LogWrapper(made[0]), made[1]
    _, state = env.reset(KEY, params)
    total = 0.0
    for action in (1, 2, DONE):
        _, state, reward, terminated, truncated, info = env.step(KEY, state, jnp.int32(action), params)
        total += float(reward)
    assert (bool(terminated), bool(truncated), bool(info["returned_episode"])) == (True, False, True)
    assert int(info["returned_episode_lengths"]) == 3
    assert float(info["returned_episode_returns"]) == pytest.approx(total)


def test_the_sticky_wrapper_replays_actions(made):
    env, params = wrappers.StickyActionWrapper(made[0], 1.0), made[1]
    _, state = env.reset(KEY, params)
    before = state.env_state.pose
    _, state, *_, info = env.step(KEY, state, jnp.int32(DONE), params)  # the first action is MoveAhead, always
    assert int(info["length"]) == 1
    assert int(state.env_state.pose) == int(made[0].next_pose(before, jnp.int32(0), params))


def test_the_flatten_wrapper_has_nothing_to_do(made):
    env, params = wrappers.FlattenObservationWrapper(made[0]), made[1]
    observation, state = env.reset(KEY, params)
    assert env.observation_space(params).shape == observation.shape
    *_, info = env.step(KEY, state, jnp.int32(1), params)
    assert info["final_observation"].shape == observation.shape


def test_the_legacy_wrapper_gives_five_values(made):
    env, params = wrappers.LegacyStepAPIWrapper(made[0]), made[1]
    _, state = env.reset(KEY, params)
    _, _, _, done, info = env.step(KEY, state, jnp.int32(DONE), params)
    assert bool(done)
    assert int(info["length"]) == 1


def test_gymnax_makes_it_an_environment_of_gymnasium(made):
    env = wrappers.GymnaxToGymWrapper(made[0], params=made[1])
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(np.asarray(observation))
    _, _, terminated, truncated, _ = env.step(DONE)
    assert (bool(terminated), bool(truncated)) == (True, False)


class Adapter(wrappers.LegacyStepAPIWrapper):
    """gymnax's adapter, which rejax copies, and which cannot be copied without end of recursion."""

    def __deepcopy__(self, memo):
        return self


@pytest.mark.slow
def test_rejax_learns_on_it(made):
    """PPO beats the same policy untrained, on the return of 128 episodes: 1.5 to 0.5; shortest paths give about 5."""
    rejax, evaluate = pytest.importorskip("rejax"), pytest.importorskip("rejax.evaluate").evaluate
    env, params = made
    trainer = rejax.PPO.create(
        env=Adapter(env),
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
    ).replace(eval_callback=lambda *_: jnp.float32(0.0))  # its own asks for `max_steps_in_episode`

    def reward(state):
        act = trainer.make_act(state)
        return float(evaluate(act, jax.random.key(1), trainer.env, params, 128, 100)[1].mean())

    before = reward(jax.jit(trainer.init_state)(KEY))
    state, _ = jax.jit(trainer.train)(KEY)
    after = reward(state)
    assert after > before + 0.5, (before, after)
