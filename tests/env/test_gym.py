"""The environments for Gymnasium: Gymnasium's own checker, and the functional environment step by step."""

import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from support.scenes import SMALL, draw

from jaxnav.env.gym import ObjectNavEnv, ObjectNavVectorEnv
from jaxnav.env.make import make
from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.task import DONE

ROOM = draw(["....", "....", "...."], ("Book", 0.25, 0.8, 0.5, *SMALL), ("Chair", 0.75, 0.5, 0.5, 0.5, 0.9, 0.5))
ROOMS_ID = "jaxnav.env.gym:jaxnav/rooms-v0"


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """A file of one small room, which compiles in no time."""
    path = tmp_path_factory.mktemp("gym") / "scenes.jsonl.gz"
    write_scenes(path, [ROOM])
    return path


@pytest.fixture(scope="module")
def single_env(scene_file):
    return ObjectNavEnv(scenes=scene_file)


def functional_state(env):
    """The state of the functional environment inside a single environment."""
    return jax.tree.map(lambda leaf: leaf[0], env._episodes.state)


def test_env_passes_the_checker_of_gymnasium(scene_file):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ROOMS_ID, scenes=scene_file)
        check_env(env.unwrapped, skip_render_check=True)


def test_make_vec_gives_the_vector_env(scene_file):
    vector_env = gymnasium.make_vec(ROOMS_ID, num_envs=3, scenes=scene_file)
    assert isinstance(vector_env.unwrapped, ObjectNavVectorEnv)


def test_every_world_has_an_id():
    assert {f"jaxnav/{world}-v0" for world in ("rooms", "apartments", "houses")} <= gymnasium.registry.keys()


def test_env_refuses_an_unknown_world():
    with pytest.raises(InputError, match="world 'cellar': choose one of"):
        ObjectNavEnv("cellar")


def test_observation_gives_the_bytes_of_the_row_in_metres(single_env, scene_file):
    """Confidence is of 255, there are 51 bytes a metre ahead, 25.4 a metre to the right around 128."""
    functional_env, params = make(scenes=scene_file)
    observation, _ = single_env.reset(seed=3)
    row = functional_env.observe(functional_state(single_env), params).row
    detection_bytes = np.asarray(functional_env.row_format.detections(row), np.float64)
    is_detected = detection_bytes[:, 0] > 0

    # Confidence, metres ahead and metres to the right; zeros where nothing is detected.
    detections = observation["detections"]
    detected_bytes = detection_bytes[is_detected]
    np.testing.assert_allclose(detections[is_detected, 0], detected_bytes[:, 0] / 255, rtol=1e-6)
    np.testing.assert_allclose(detections[is_detected, 1], detected_bytes[:, 1] / 51, rtol=1e-6)
    np.testing.assert_allclose(detections[is_detected, 2], (detected_bytes[:, 2] - 128) / 25.4, rtol=1e-6)
    assert (detections[~is_detected] == 0).all()

    np.testing.assert_array_equal(observation["view"].ravel(), functional_env.row_format.view_cells(row))


def test_observation_holds_no_entry_on_whether_done_succeeds(single_env):
    assert set(single_env.observation_space.spaces) == {"view", "detections", "goal", "heading", "horizon", "moved"}


def test_reset_with_a_seed_repeats_its_episodes(single_env):
    def start_two_episodes(seed):
        first_observation, _ = single_env.reset(seed=seed)
        second_observation, _ = single_env.reset()
        observations = (first_observation, second_observation)
        return [(obs["goal"], obs["heading"], obs["view"].tobytes()) for obs in observations]

    assert start_two_episodes(5) == start_two_episodes(5)
    assert len({str(start_two_episodes(seed)) for seed in range(6)}) > 1


def test_step_equals_that_of_the_functional_environment(single_env, scene_file):
    functional_env, params = make(scenes=scene_file)
    single_env.reset(seed=0)
    state = functional_state(single_env)
    for action in (0, 2, 0, 4, 1, 0, 0, DONE):
        # The same action in both environments.
        last_cell = functional_env.cell_of_pose(state.pose)
        state, reward, terminated, truncated = functional_env.advance(state, jnp.int32(action), params)
        observation, *outcome, info = single_env.step(action)

        assert outcome == [reward, terminated, truncated]
        assert info["success"] == bool(terminated & functional_env.done_succeeds(state, params))
        assert observation["moved"] == int(functional_env.cell_of_pose(state.pose) != last_cell)
        assert observation["heading"] == state.pose // 2 % 8
        assert observation["horizon"] == state.pose % 2
    assert terminated


def test_vector_env_restarts_only_the_episodes_that_end(scene_file):
    vector_env = ObjectNavVectorEnv(4, scenes=scene_file)
    first_observation, _ = vector_env.reset(seed=1)
    assert vector_env.observation_space.contains(first_observation)
    next_observation, rewards, terminated, truncated, infos = vector_env.step(np.array([1, DONE, 1, DONE]))

    # Environments 1 and 3 end, and only they have a last observation.
    np.testing.assert_array_equal(terminated, [False, True, False, True])
    assert not truncated.any()
    np.testing.assert_array_equal(infos["_final_obs"], terminated)
    assert infos["final_obs"][0] is None

    # Done changes nothing, so the last observation is the one before; the next episode has no last action.
    for index in (1, 3):
        for name, value in infos["final_obs"][index].items():
            np.testing.assert_array_equal(value, 0 if name == "moved" else first_observation[name][index])
    np.testing.assert_array_equal(next_observation["heading"][[0, 2]], (first_observation["heading"][[0, 2]] - 1) % 8)

    # Success pays 5, every other step costs 0.01.
    succeeded = infos["final_info"]["success"]
    np.testing.assert_array_equal(rewards[succeeded], 5.0)
    np.testing.assert_allclose(rewards[~succeeded], -0.01)
    assert infos["final_info"]["_success"].tolist() == terminated.tolist()


def end_all_episodes_twice(vector_env):
    """Views of the episodes that begin after two rounds of Done."""
    views = []
    for _ in range(2):
        observation, *_ = vector_env.step(np.full(vector_env.num_envs, DONE))
        views.append(observation["view"].tobytes())
    return views


def test_vector_env_with_a_seed_each_starts_like_single_envs(single_env, scene_file):
    vector_env = ObjectNavVectorEnv(3, scenes=scene_file)
    seeds = [5, 2, 5]
    batch_observation, _ = vector_env.reset(seed=seeds)
    for index, seed in enumerate(seeds):
        single_observation, _ = single_env.reset(seed=seed)
        for name, value in single_observation.items():
            np.testing.assert_array_equal(batch_observation[name][index], value)
    assert str(single_env.reset(seed=5)) != str(single_env.reset(seed=2))

    # The seeds determine the later episodes too.
    later_views = end_all_episodes_twice(vector_env)
    vector_env.reset(seed=seeds)
    assert later_views == end_all_episodes_twice(vector_env)


def test_vector_env_refuses_another_number_of_seeds(scene_file):
    with pytest.raises(ValueError, match="seed holds 2 seeds; give one for each of the 3 environments"):
        ObjectNavVectorEnv(3, scenes=scene_file).reset(seed=[1, 2])


def test_vector_env_returns_writable_arrays(scene_file):
    """Learners of other libraries write into them."""
    vector_env = ObjectNavVectorEnv(2, scenes=scene_file)
    observation, _ = vector_env.reset(seed=0)
    _, *outcome, _ = vector_env.step(np.zeros(2, int))
    for array in (*observation.values(), *outcome):
        array[:] = 0


@pytest.mark.parametrize("actions", [[0, 6], [0, -1], [0.9, 0.0], [[0], [1]], [0]])
def test_vector_env_refuses_invalid_actions(scene_file, actions):
    vector_env = ObjectNavVectorEnv(2, scenes=scene_file)
    vector_env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction, match="give whole numbers from 0 to 5"):
        vector_env.step(np.array(actions))


def test_single_env_refuses_an_invalid_action(scene_file):
    env = ObjectNavEnv(scenes=scene_file)
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction):
        env.step(6)


def test_step_before_reset_is_refused(scene_file):
    with pytest.raises(gymnasium.error.ResetNeeded):
        ObjectNavEnv(scenes=scene_file).step(0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        ObjectNavVectorEnv(2, scenes=scene_file).step(np.zeros(2, int))
