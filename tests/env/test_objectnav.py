"""The start, the steps and the end of an episode."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare
from support.scenes import BOOK, CATEGORIES, CHAIR, HOUSES, ROOMS, SMALL, draw

from jaxnav.env.make import build_environment, make
from jaxnav.env.objectnav import NUM_START_CANDIDATES, State
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, Task

BANK = compile_bank([generate_room("train", index, 0) for index in range(4)], Task())  # one of each type
# One cell: Done succeeds for the book at headings 7, 0 and 1, for the chair from behind.
ONE_CELL = compile_bank([draw(["."], ("Book", 0, 1.5, 1, *SMALL), ("Chair", 0, 1.5, -1, *SMALL))], Task(CATEGORIES))


def state_in_one_cell(goal=BOOK, heading=0, time=0):
    return State(pose=jnp.int32(2 * heading), scene=jnp.int32(0), goal=jnp.int32(goal), time=jnp.int32(time))


def start_episodes(env, params, count):
    """States of `count` new episodes, leaves [count]."""
    keys = jax.random.split(jax.random.key(0), count)
    _, states = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
    return states


@pytest.mark.parametrize(
    ("heading", "goal", "expected_reward", "success"),
    [(0, BOOK, 5.0, True), (0, CHAIR, -0.01, False), (4, CHAIR, 5.0, True)],
)
def test_done_at_the_step_limit_terminates_without_truncation(heading, goal, expected_reward, success):
    env, params = build_environment(ONE_CELL, {}, 3)
    state = state_in_one_cell(goal, heading, time=2)
    _, next_state, reward, terminated, truncated, info = env.step(jax.random.key(0), state, jnp.int32(DONE), params)
    assert (reward, terminated, truncated) == (np.float32(expected_reward), True, False)
    assert (info["success"], info["length"], next_state.time) == (success, 3, 0)


def test_step_limit_truncates_the_episode():
    env, params = build_environment(ONE_CELL, {}, 3)
    state = state_in_one_cell()
    endings = []
    for action in (LOOK_DOWN, MOVE_AHEAD, LOOK_UP):
        state, reward, terminated, truncated = env.advance(state, jnp.int32(action), params)
        endings.append((bool(terminated), bool(truncated)))
        assert reward == np.float32(-0.01)
    assert endings == [(False, False), (False, False), (False, True)]
    assert (state.time, state.pose) == (3, 0)


@pytest.mark.slow
def test_final_observation_is_of_the_episode_that_ends():
    env, params = build_environment(BANK, {}, 1)  # every step ends an episode
    num_episodes = 400
    states = start_episodes(env, params, num_episodes)
    keys = jax.random.split(jax.random.key(1), num_episodes)
    actions = jnp.arange(num_episodes) % 6
    step = jax.vmap(env.step, (0, 0, 0, None))
    observation, next_states, _, _, _, info = step(keys, states, actions, params)

    # The last state and observation are those of the action in the old episode.
    final_state = info["final_state"]
    final_observation = info["final_observation"]
    np.testing.assert_array_equal(final_state.pose, BANK.successor[states.pose, actions])
    np.testing.assert_array_equal(final_state.scene, states.scene)
    np.testing.assert_array_equal(final_observation.goal, states.goal)
    np.testing.assert_array_equal(final_observation.row, BANK.rows[final_state.pose])

    # The next state and observation are those of a new episode.
    assert (np.asarray(next_states.scene) != states.scene).mean() > 0.5
    np.testing.assert_array_equal(observation.row, BANK.rows[next_states.pose])
    np.testing.assert_array_equal(observation.goal, next_states.goal)


def is_uniform(values, choices):
    """True where a chi-squared test accepts values, which must be among the sorted choices, as uniform."""
    assert np.isin(values, choices).all()
    counts = np.bincount(np.searchsorted(choices, values), minlength=len(choices))
    return chisquare(counts).pvalue > 1e-3


def test_uniformity_check_notices_a_small_excess():
    scenes = np.random.default_rng(0).integers(0, 2, 40_000)
    assert is_uniform(scenes, [0, 1])
    assert not is_uniform(np.append(scenes, np.zeros(1000, int)), [0, 1])


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_reset_draws_scene_goal_and_pose_uniformly(rules):
    # A scene of 4 cells with one goal, and one of 1 cell with two goals.
    wide_scene = draw(["..", ".."], ("Book", 0, 1.5, 1, *SMALL))
    narrow_scene = draw(["."], ("Book", 0, 1.5, 1, *SMALL), ("Fridge", 1, 0.9, 0.5, 0.3, 1.2, 0.3))
    bank = compile_bank([wide_scene, narrow_scene], Task(CATEGORIES, rules=rules))
    env, params = build_environment(bank, {}, 10)
    states = start_episodes(env, params, 40_000)
    pose = np.asarray(states.pose)
    scene = np.asarray(states.scene)
    goal = np.asarray(states.goal)
    assert not np.asarray(states.time).any()

    # Scenes, then the goals of each scene.
    assert is_uniform(scene, [0, 1])
    assert (goal[scene == 0] == BOOK).all()
    assert is_uniform(goal[scene == 1], [0, 2])

    # Cells and headings of each scene; the camera is level.
    start_poses = np.arange(0, 5 * rules.poses_per_cell, len(rules.horizons))
    assert is_uniform(pose[scene == 0], start_poses[: 4 * rules.headings])
    assert is_uniform(pose[scene == 1], start_poses[4 * rules.headings :])


#: A corridor of 8 cells along z. The centre of the book is at z = 2.75 m, and its footprint begins at z = 2.5 m.
#: By the rules of rooms the goal distance is the distance of sight to the centre, 2.75 - z; by the rules of houses it
#: is the length of a walk to the footprint, 2.5 - z. A MoveAhead changes either distance by 0.25 m.
CORRIDOR = draw(["."] * 8, ("Book", 0, 1.0, 2.75, 0.5, 0.5, 0.5))
each_distance_measure = pytest.mark.parametrize("rules", [ROOMS, pytest.param(HOUSES, marks=pytest.mark.slow)])


def corridor_with_shaping(rules, shaping):
    """Bank, environment, parameters, and the state at the start of an episode in the fourth cell."""
    bank = compile_bank([CORRIDOR], Task(CATEGORIES, rules=rules))
    env, params = build_environment(bank, {}, 100, shaping=shaping)
    pose = jnp.int32(3 * rules.poses_per_cell)
    return bank, env, params, State(pose=pose, scene=jnp.int32(0), goal=jnp.int32(BOOK), time=jnp.int32(0))


@each_distance_measure
def test_shaping_pays_for_metres_nearer_than_ever_before(rules):
    bank, env, params, north_state = corridor_with_shaping(rules, shaping=2.0)
    half_turn = rules.headings // 2 * len(rules.horizons)
    south_state = north_state.replace(pose=north_state.pose + half_turn)
    start_distance = bank.goal_distance[3, BOOK]

    # Metres are paid only where the agent gets nearer to the goal than ever before: a step away pays nothing, nor does
    # the way back.
    for state, action, metres in [
        (north_state, MOVE_AHEAD, 0.25),
        (south_state, MOVE_AHEAD, 0.0),
        (north_state, LOOK_UP, 0.0),
    ]:
        for min_distance, metres_paid in [
            (start_distance, metres),
            (start_distance - 0.25, 0.0),
            (start_distance - 0.125, max(metres - 0.125, 0.0)),
        ]:
            state_before = state.replace(min_goal_distance=jnp.float32(min_distance))
            state_after, reward, _, _ = env.advance(state_before, jnp.int32(action), params)
            np.testing.assert_allclose(reward, -0.01 + 2.0 * metres_paid, atol=1e-6)
            assert state_after.min_goal_distance == pytest.approx(min_distance - metres_paid, abs=1e-6)


@each_distance_measure
def test_reset_sets_the_minimum_goal_distance_to_that_of_the_start(rules):
    bank, env, params, _ = corridor_with_shaping(rules, shaping=2.0)
    _, state = env.reset(jax.random.key(0), params)
    assert state.min_goal_distance == pytest.approx(bank.goal_distance[env.cell_of_pose(state.pose), BOOK])


@pytest.mark.parametrize(("rules", "goal_distance"), [(ROOMS, 1.0), pytest.param(HOUSES, 0.75, marks=pytest.mark.slow)])
def test_shaping_does_not_change_the_reward_of_done(rules, goal_distance):
    bank, env, params, start_state = corridor_with_shaping(rules, shaping=2.0)
    np.testing.assert_allclose(bank.goal_distance[7, BOOK], goal_distance)  # z = 1.75
    last_pose = jnp.int32(7 * rules.poses_per_cell)
    state = start_state.replace(pose=last_pose, min_goal_distance=jnp.float32(goal_distance))
    _, reward, _, _ = env.advance(state, jnp.int32(DONE), params)
    assert reward == 5.0


@pytest.mark.slow
@each_distance_measure
def test_without_shaping_a_step_nearer_pays_nothing(rules):
    _, env, params, state = corridor_with_shaping(rules, shaping=0.0)
    _, reward, _, _ = env.advance(state, jnp.int32(MOVE_AHEAD), params)
    assert reward == jnp.float32(-0.01)
    assert make("rooms")[0].shaping == 0.0


def test_build_environment_pads_tables_and_repeats_scenes():
    num_cells = len(BANK.ahead)
    env, params = build_environment(BANK, {"kitchen": 7}, 9)
    padded_env, padded_params = build_environment(BANK, {"kitchen": 7}, 9, num_cells + 10, 6)
    assert padded_env == env

    # 4 scenes, and the first two again.
    assert params.step_limit.tolist() == [7, 9, 9, 9]
    assert padded_params.step_limit.tolist() == [7, 9, 9, 9, 7, 9]
    assert params.room.tolist() == [0, 1, 2, 3]
    assert padded_params.room.tolist() == [0, 1, 2, 3, 0, 1]
    tables = vars(params.tables)
    padded_tables = vars(padded_params.tables)
    for name in ("first_cell", "num_cells", "goals", "num_goals"):
        np.testing.assert_array_equal(padded_tables[name], np.asarray(tables[name])[[0, 1, 2, 3, 0, 1]])

    # 10 more cells, and their poses, hold zeros.
    for name, num_added in (("ahead", 10), ("goal_distance", 10), ("rows", 10 * BANK.task.rules.poses_per_cell)):
        np.testing.assert_array_equal(padded_tables[name][:-num_added], tables[name])
        assert not np.asarray(padded_tables[name][-num_added:]).any()


def test_build_environment_never_cuts_tables_off():
    num_cells = len(BANK.ahead)
    _, params = build_environment(BANK, {}, 9, num_cells - 1, 2)
    assert (len(params.tables.ahead), len(params.room)) == (num_cells, 4)


@pytest.mark.parametrize("num_scenes", [0, 6])
def test_scenes_are_equally_likely_in_a_padded_bank_too(num_scenes):
    """A bank of four scenes that is padded to six repeats the first two, which must not be drawn twice as often."""
    env, params = build_environment(BANK, {}, 9, num_scenes=num_scenes)
    states = start_episodes(env, params, 4000)
    assert chisquare(np.bincount(states.scene, minlength=4)).pvalue > 0.001


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_near_starts_take_the_nearest_of_several_candidates(share):
    """The nearest of C cells is at most x away with probability 1 - (1 - F(x))^C, and a single cell with F(x)."""
    env, params = build_environment(BANK, {}, 10)
    near_env = dataclasses.replace(env, near_starts=share)

    def start_distances(states):
        return BANK.goal_distance[np.asarray(env.cell_of_pose(states.pose)), np.asarray(states.goal)]

    # Scenes and goals are drawn as before, only the cells are nearer.
    states = start_episodes(env, params, 40_000)
    near_states = start_episodes(near_env, params, 40_000)
    np.testing.assert_array_equal(near_states.scene, states.scene)
    np.testing.assert_array_equal(near_states.goal, states.goal)
    distances = start_distances(states)
    near_distances = start_distances(near_states)
    assert (near_distances <= distances).all()
    assert (near_distances < distances).any()

    # Compare the distributions in the most frequent pair of scene and goal, so that F is the distribution of its cells.
    pair_index = np.asarray(states.scene) * 100 + np.asarray(states.goal)
    in_pair = pair_index == np.bincount(pair_index).argmax()
    pair_distances = distances[in_pair]
    near_pair_distances = near_distances[in_pair]
    for limit in np.quantile(pair_distances, [0.1, 0.3, 0.6]):
        single_cell = (pair_distances <= limit).mean()
        nearest_cell = 1 - (1 - single_cell) ** NUM_START_CANDIDATES
        expected_share = (1 - share) * single_cell + share * nearest_cell
        assert (near_pair_distances <= limit).mean() == pytest.approx(expected_share, abs=0.04)


@pytest.mark.parametrize("action", [ROTATE_LEFT, DONE])
def test_step_takes_a_python_number_as_action(action):
    """Wrappers of other libraries call `step` outside of `jax.jit`, with plain numbers."""
    env, params = build_environment(ONE_CELL, {}, 9)
    number_result = env.step(jax.random.key(0), state_in_one_cell(), action, params)
    array_result = env.step(jax.random.key(0), state_in_one_cell(), jnp.int32(action), params)
    chex.assert_trees_all_equal(number_result, array_result)
