"""One episode: its start, its steps and its end."""

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

BANK = compile_bank([generate_room("train", i, 0) for i in range(4)], Task())  # one of each type
# One cell: Done succeeds for the book at headings 7, 0 and 1, for the chair from behind.
ONE_CELL = compile_bank([draw(["."], ("Book", 0, 1.5, 1, *SMALL), ("Chair", 0, 1.5, -1, *SMALL))], Task(CATEGORIES))


def in_one_cell(goal=BOOK, heading=0, time=0):
    return State(pose=jnp.int32(2 * heading), scene=jnp.int32(0), goal=jnp.int32(goal), time=jnp.int32(time))


@pytest.mark.parametrize(
    ("heading", "goal", "reward", "success"), [(0, BOOK, 5.0, True), (0, CHAIR, -0.01, False), (4, CHAIR, 5.0, True)]
)
def test_done_on_the_last_step_is_terminated_only(heading, goal, reward, success):
    env, params = build_environment(ONE_CELL, {}, 3)
    state = in_one_cell(goal, heading, time=2)
    _, after, gained, terminated, truncated, info = env.step(jax.random.key(0), state, jnp.int32(DONE), params)
    assert (gained, terminated, truncated) == (np.float32(reward), True, False)
    assert (info["success"], info["length"], after.time) == (success, 3, 0)


def test_the_step_limit_truncates():
    env, params = build_environment(ONE_CELL, {}, 3)
    state, endings = in_one_cell(), []
    for action in (LOOK_DOWN, MOVE_AHEAD, LOOK_UP):
        state, reward, terminated, truncated = env.advance(state, jnp.int32(action), params)
        endings.append((bool(terminated), bool(truncated)))
        assert reward == np.float32(-0.01)
    assert endings == [(False, False), (False, False), (False, True)]
    assert (state.time, state.pose) == (3, 0)


def test_an_ending_does_not_leak_the_next_episode():
    env, params = build_environment(BANK, {}, 1)  # every step ends an episode
    keys = jax.random.split(jax.random.key(0), 400)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    action = jnp.arange(400) % 6
    observation, after, _, _, _, info = jax.vmap(env.step, (0, 0, 0, None))(keys[::-1], state, action, params)
    final, seen = info["final_state"], info["final_observation"]
    np.testing.assert_array_equal(final.pose, BANK.successor[state.pose, action])
    np.testing.assert_array_equal(final.scene, state.scene)
    np.testing.assert_array_equal(seen.goal, state.goal)
    np.testing.assert_array_equal(seen.row, BANK.rows[final.pose])
    # The new episodes are others, and observed as such.
    assert (np.asarray(after.scene) != state.scene).mean() > 0.5
    np.testing.assert_array_equal(observation.row, BANK.rows[after.pose])
    np.testing.assert_array_equal(observation.goal, after.goal)


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_starts_are_uniform(rules):
    # A scene of 4 cells with one goal, and one of 1 cell with two goals.
    wide = draw(["..", ".."], ("Book", 0, 1.5, 1, *SMALL))
    narrow = draw(["."], ("Book", 0, 1.5, 1, *SMALL), ("Fridge", 1, 0.9, 0.5, 0.3, 1.2, 0.3))
    bank = compile_bank([wide, narrow], Task(CATEGORIES, rules=rules))
    env, params = build_environment(bank, {}, 10)
    _, state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(jax.random.key(0), 40_000), params)
    pose, scene, goal = np.asarray(state.pose), np.asarray(state.scene), np.asarray(state.goal)
    assert not np.asarray(state.time).any()

    def uniform(values, choices):
        counts = np.bincount(np.searchsorted(choices, values), minlength=len(choices))
        assert np.isin(values, choices).all()
        return chisquare(counts).pvalue > 1e-3

    assert uniform(scene, [0, 1])
    assert (goal[scene == 0] == BOOK).all()
    assert uniform(goal[scene == 1], [0, 2])
    starts = np.arange(0, 5 * rules.poses_per_cell, len(rules.horizons))  # cell and heading; level
    assert uniform(pose[scene == 0], starts[: 4 * rules.headings])
    assert uniform(pose[scene == 1], starts[4 * rules.headings :])
    assert not uniform(np.append(scene, np.zeros(1000, int)), [0, 1])  # the test can tell


@pytest.mark.parametrize(("rules", "ahead"), [(ROOMS, 1.0), pytest.param(HOUSES, 0.75, marks=pytest.mark.slow)])
def test_shaping_rewards_metres_nearer_than_before(rules, ahead):
    # A corridor of 8 cells along z; the book's centre is at z = 2.75, its footprint from 2.5 m on (sight: 2.75 - z to
    # the centre, walk: 2.5 - z to the footprint). Each MoveAhead is 0.25 m, whatever is measured.
    corridor = draw(["."] * 8, ("Book", 0, 1.0, 2.75, 0.5, 0.5, 0.5))
    bank = compile_bank([corridor], Task(CATEGORIES, rules=rules))
    plain, params = build_environment(bank, {}, 100)
    shaped, _ = build_environment(bank, {}, 100, shaping=2.0)
    per_cell = rules.poses_per_cell
    back = rules.headings // 2 * len(rules.horizons)
    start = State(pose=jnp.int32(3 * per_cell), scene=jnp.int32(0), goal=jnp.int32(BOOK), time=jnp.int32(0))
    turned = start.replace(pose=start.pose + back)
    assert plain.advance(start, jnp.int32(MOVE_AHEAD), params)[1] == jnp.float32(-0.01)
    here = bank.goal_distance[3, BOOK]
    # Away pays nothing, nor does the way back to where it was nearer.
    for state, action, metres in [(start, MOVE_AHEAD, 0.25), (turned, MOVE_AHEAD, 0.0), (start, LOOK_UP, 0.0)]:
        for nearest, gained in [(here, metres), (here - 0.25, 0.0), (here - 0.125, max(metres - 0.125, 0.0))]:
            given = state.replace(min_goal_distance=jnp.float32(nearest))
            after, reward, _, _ = shaped.advance(given, jnp.int32(action), params)
            np.testing.assert_allclose(reward, -0.01 + 2.0 * gained, atol=1e-6)
            assert after.min_goal_distance == pytest.approx(nearest - gained, abs=1e-6)
    _, begun = shaped.reset(jax.random.key(0), params)
    assert begun.min_goal_distance == pytest.approx(bank.goal_distance[shaped.cell_of_pose(begun.pose), BOOK])
    done = start.replace(pose=jnp.int32(7 * per_cell), min_goal_distance=jnp.float32(ahead))
    np.testing.assert_allclose(bank.goal_distance[7, BOOK], ahead)  # z = 1.75
    assert shaped.advance(done, jnp.int32(DONE), params)[1] == 5.0
    assert make("rooms")[0].shaping == 0.0


def test_padded_tables_hold_the_same_episodes():
    cells, cell_poses = len(BANK.ahead), BANK.task.rules.poses_per_cell
    env, params = build_environment(BANK, {"kitchen": 7}, 9)
    padded_env, padded = build_environment(BANK, {"kitchen": 7}, 9, cells + 10, 6)
    assert padded_env == env
    # 4 scenes, and the first two again.
    assert (params.step_limit.tolist(), padded.step_limit.tolist()) == ([7, 9, 9, 9], [7, 9, 9, 9, 7, 9])
    assert (params.room.tolist(), padded.room.tolist()) == ([0, 1, 2, 3], [0, 1, 2, 3, 0, 1])
    tables, longer = vars(params.tables), vars(padded.tables)
    for name in ("first_cell", "num_cells", "goals", "num_goals"):
        np.testing.assert_array_equal(longer[name], np.asarray(tables[name])[[0, 1, 2, 3, 0, 1]])
    for name, added in (("ahead", 10), ("goal_distance", 10), ("rows", 10 * cell_poses)):
        np.testing.assert_array_equal(longer[name][:-added], tables[name])
        assert not np.asarray(longer[name][-added:]).any()
    small = build_environment(BANK, {}, 9, cells - 1, 2)[1]
    assert (len(small.tables.ahead), len(small.room)) == (cells, 4)


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_some_starts_are_near_the_goal(share):
    """Of C cells the nearest: its distance is at most x with probability 1 - (1 - F(x))^C, F that of one cell."""
    env, params = build_environment(BANK, {}, 10)
    keys = jax.random.split(jax.random.key(0), 40_000)

    def distances(env):
        _, state = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
        distance = BANK.goal_distance[np.asarray(env.cell_of_pose(state.pose)), np.asarray(state.goal)]
        return state, distance, np.asarray(state.scene) * 100 + np.asarray(state.goal)

    plain, uniform, kinds = distances(env)
    near, nearer, _ = distances(dataclasses.replace(env, near_starts=share))
    for name in ("scene", "goal"):
        np.testing.assert_array_equal(getattr(near, name), getattr(plain, name))
    assert (nearer <= uniform).all()
    assert (nearer < uniform).any()
    kind = np.bincount(kinds).argmax()  # one scene and goal, so that F is of its cells
    one, other = uniform[kinds == kind], nearer[kinds == kind]
    for x in np.quantile(one, [0.1, 0.3, 0.6]):
        below = (one <= x).mean()
        expected = (1 - share) * below + share * (1 - (1 - below) ** NUM_START_CANDIDATES)
        assert (other <= x).mean() == pytest.approx(expected, abs=0.04)


@pytest.mark.parametrize("action", [ROTATE_LEFT, DONE])
def test_a_plain_number_is_an_action(action):
    """Also where nothing is compiled, as wrappers of others call it."""
    env, params = build_environment(ONE_CELL, {}, 9)
    plain, array = (
        env.step(jax.random.key(0), in_one_cell(), number, params) for number in (action, jnp.int32(action))
    )
    chex.assert_trees_all_equal(plain, array)
