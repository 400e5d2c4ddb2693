"""The environment for Gymnasium: its own checker, and the functional environment step by step."""

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


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A file of one small room, which compiles at once."""
    path = tmp_path_factory.mktemp("gym") / "scenes.jsonl.gz"
    write_scenes(path, [ROOM])
    return path


@pytest.fixture(scope="module")
def single(scenes):
    return ObjectNavEnv(scenes=scenes)


def test_gymnasium_finds_nothing_wrong(scenes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("jaxnav.env.gym:jaxnav/rooms-v0", scenes=scenes)
        check_env(env.unwrapped, skip_render_check=True)
        vector = gymnasium.make_vec("jaxnav.env.gym:jaxnav/rooms-v0", num_envs=3, scenes=scenes)
    assert isinstance(vector.unwrapped, ObjectNavVectorEnv)


def test_worlds_have_ids_and_unknown_ones_are_refused():
    assert {f"jaxnav/{world}-v0" for world in ("rooms", "apartments", "houses")} <= gymnasium.registry.keys()
    with pytest.raises(InputError, match="world 'cellar': choose one of"):
        ObjectNavEnv("cellar")


def test_an_observation_holds_what_the_row_says_in_metres(single, scenes):
    """Confidence is of 255, there are 51 bytes a metre ahead, 25.4 a metre to the right around 128."""
    env, params = make(scenes=scenes)
    observation, _ = single.reset(seed=3)
    state = single._episodes.state
    row = env.observe(jax.tree.map(lambda leaf: leaf[0], state), params).row
    bytes_, seen = np.asarray(env.row_format.detections(row), np.float64), observation["detections"]
    is_detected = bytes_[:, 0] > 0
    np.testing.assert_allclose(seen[is_detected, 0], bytes_[is_detected, 0] / 255, rtol=1e-6)
    np.testing.assert_allclose(seen[is_detected, 1], bytes_[is_detected, 1] / 51, rtol=1e-6)
    np.testing.assert_allclose(seen[is_detected, 2], (bytes_[is_detected, 2] - 128) / 25.4, rtol=1e-6)
    assert (seen[~is_detected] == 0).all()
    np.testing.assert_array_equal(observation["view"].ravel(), env.row_format.view_cells(row))


def test_a_seed_gives_the_same_episodes(single):
    def episodes(seed):
        first, _ = single.reset(seed=seed)
        second, _ = single.reset()
        return [(part["goal"], part["heading"], part["view"].tobytes()) for part in (first, second)]

    assert episodes(5) == episodes(5)
    assert len({str(episodes(seed)) for seed in range(6)}) > 1


def test_a_step_is_that_of_the_environment(single, scenes):
    env, params = make(scenes=scenes)
    single.reset(seed=0)
    state = jax.tree.map(lambda leaf: leaf[0], single._episodes.state)
    for action in (0, 2, 0, 4, 1, 0, 0, DONE):
        before, (state, reward, terminated, truncated) = state, env.advance(state, jnp.int32(action), params)
        observation, *outcome, info = single.step(action)
        assert outcome == [reward, terminated, truncated]
        assert info["success"] == bool(terminated & env.done_succeeds(state, params))
        assert observation["moved"] == int(env.cell_of_pose(state.pose) != env.cell_of_pose(before.pose))
        assert observation["heading"] == state.pose // 2 % 8
        assert observation["horizon"] == state.pose % 2
    assert terminated


def test_episodes_side_by_side_begin_anew_where_they_end(scenes):
    vector = ObjectNavVectorEnv(4, scenes=scenes)
    before, _ = vector.reset(seed=1)
    assert vector.observation_space.contains(before)
    after, rewards, terminated, truncated, infos = vector.step(np.array([1, DONE, 1, DONE]))
    np.testing.assert_array_equal(terminated, [False, True, False, True])
    assert not truncated.any()
    np.testing.assert_array_equal(infos["_final_obs"], terminated)
    assert infos["final_obs"][0] is None
    # Done changes nothing, so the last observation is the one before; the next episode has no last action.
    for number in (1, 3):
        for name, value in infos["final_obs"][number].items():
            np.testing.assert_array_equal(value, 0 if name == "moved" else before[name][number])
    np.testing.assert_array_equal(after["heading"][[0, 2]], (before["heading"][[0, 2]] - 1) % 8)
    succeeded = infos["final_info"]["success"]
    np.testing.assert_array_equal(rewards[succeeded], 5.0)
    np.testing.assert_allclose(rewards[~succeeded], -0.01)
    assert infos["final_info"]["_success"].tolist() == terminated.tolist()


def test_a_seed_for_each_begins_each_like_the_single_environment(single, scenes):
    vector, seeds = ObjectNavVectorEnv(3, scenes=scenes), [5, 2, 5]
    together, _ = vector.reset(seed=seeds)
    for number, seed in enumerate(seeds):
        alone, _ = single.reset(seed=seed)
        for name, value in alone.items():
            np.testing.assert_array_equal(together[name][number], value)
    assert str(single.reset(seed=5)) != str(single.reset(seed=2))
    # What begins later is given by the seeds too.
    following = [vector.step(np.full(3, DONE))[0]["view"].tobytes() for _ in range(2)]
    vector.reset(seed=seeds)
    assert following == [vector.step(np.full(3, DONE))[0]["view"].tobytes() for _ in range(2)]
    with pytest.raises(ValueError, match="seed holds 2 seeds; give one for each of the 3 environments"):
        vector.reset(seed=[1, 2])


def test_what_is_returned_may_be_written_to(scenes):
    """Learners of other libraries do."""
    vector = ObjectNavVectorEnv(2, scenes=scenes)
    observation, _ = vector.reset(seed=0)
    _, *outcome, _ = vector.step(np.zeros(2, int))
    for array in (*observation.values(), *outcome):
        array[:] = 0


def test_no_observation_holds_the_answer(single):
    """By name: what is seen, sought and felt. Whether Done would succeed is in none of them."""
    assert set(single.observation_space.spaces) == {"view", "detections", "goal", "heading", "horizon", "moved"}


@pytest.mark.parametrize("wrong", [[0, 6], [0, -1], [0.9, 0.0], [[0], [1]], [0]])
def test_what_is_no_action_is_refused(scenes, wrong):
    vector = ObjectNavVectorEnv(2, scenes=scenes)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.zeros(2, int))
    vector.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction, match="give whole numbers from 0 to 5"):
        vector.step(np.array(wrong))


def test_the_single_environment_refuses_too(scenes):
    env = ObjectNavEnv(scenes=scenes)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction):
        env.step(6)
