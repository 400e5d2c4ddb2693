"""One episode: its contract, how it starts and ends, and how environments are made."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import BOOK, CATEGORIES, CHAIR, SMALL, draw
from scipy.stats import chisquare

from jaxnav.env.make import build_evaluation, make
from jaxnav.env.objectnav import ObjectNav, build
from jaxnav.env.testing import check_environment
from jaxnav.env.types import State
from jaxnav.errors import InputError
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.compile import compile_bank
from jaxnav.scenes.io import read_scenes, write_scenes
from jaxnav.scenes.lattice import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD
from jaxnav.scenes.rooms import generate_rooms

REAL_FILE = Path(__file__).parents[2] / "shared" / "scenes" / "ithor_train_val.jsonl.gz"
ROOMS = generate_rooms(4, 4, 0)  # one of each type
BANK = compile_bank(ROOMS[:4])
# One cell: the book is found at headings 7, 0 and 1, the chair from behind.
ONE_CELL = compile_bank([draw(["."], ("Book", 0, 1.5, 1, *SMALL), ("Chair", 0, 1.5, -1, *SMALL))], CATEGORIES)


def in_one_cell(goal=BOOK, heading=0, time=0):
    return State(pose=jnp.int32(2 * heading), scene=jnp.int32(0), goal=jnp.int32(goal), time=jnp.int32(time))


def test_contract_on_generated_rooms():
    check_environment(*build(BANK, {}, 5))


def test_contract_on_real_rooms():
    if not REAL_FILE.exists():
        pytest.skip("the real rooms are not here")
    check_environment(*build_evaluation(compile_bank(read_scenes(REAL_FILE)[::25])))


class EndsTwice(ObjectNav):
    """A wrong environment: the last step is truncated, whatever it was."""

    def advance(self, state, action, params):
        after, reward, terminated, _ = super().advance(state, action, params)
        return after, reward, terminated, after.time >= params.step_limit[state.scene]


class NeverStartsAnew(ObjectNav):
    """A wrong environment: time goes on after an ending."""

    def step(self, key, state, action, params):
        observation, after, *rest = super().step(key, state, action, params)
        return observation, after.replace(time=state.time + 1), *rest


class AsksForTooMuch(ObjectNav):
    """A wrong environment: it seeks a category that it does not know."""

    def observe(self, state, params):
        return super().observe(state, params).replace(goal=state.goal + len(self.categories))


class Lies(ObjectNav):
    """A wrong environment: every step is a success."""

    def step(self, key, state, action, params):
        *rest, info = super().step(key, state, action, params)
        return *rest, info | {"success": jnp.ones_like(info["success"])}


@pytest.mark.parametrize(
    ("broken", "promise"),
    [
        (EndsTwice, "terminated and truncated at once"),
        (NeverStartsAnew, "not followed by a new episode"),
        (AsksForTooMuch, "a goal that is no category"),
        (Lies, "a success that is not an ending"),
    ],
)
def test_contract_refuses_broken_environments(broken, promise):
    env, params = build(BANK, {}, 5)
    check_environment(env, params, num_steps=1)
    with pytest.raises(AssertionError, match=promise):
        check_environment(broken(env.categories), params)


@pytest.mark.parametrize(
    ("heading", "goal", "reward", "success"), [(0, BOOK, 5.0, True), (0, CHAIR, -0.01, False), (4, CHAIR, 5.0, True)]
)
def test_done_on_the_last_step_is_terminated_only(heading, goal, reward, success):
    env, params = build(ONE_CELL, {}, 3)
    state = in_one_cell(goal, heading, time=2)
    _, after, gained, terminated, truncated, info = env.step(jax.random.key(0), state, jnp.int32(DONE), params)
    assert (gained, terminated, truncated) == (np.float32(reward), True, False)
    assert (info["success"], info["length"], after.time) == (success, 3, 0)


def test_the_step_limit_truncates():
    env, params = build(ONE_CELL, {}, 3)
    state, endings = in_one_cell(), []
    for action in (LOOK_DOWN, MOVE_AHEAD, LOOK_UP):
        state, reward, terminated, truncated = env.advance(state, jnp.int32(action), params)
        endings.append((bool(terminated), bool(truncated)))
        assert reward == np.float32(-0.01)
    assert endings == [(False, False), (False, False), (False, True)]
    assert (state.time, state.pose) == (3, 0)


def test_an_ending_does_not_leak_the_next_episode():
    env, params = build(BANK, {}, 1)  # every step ends an episode
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


def test_starts_are_uniform():
    # A scene of 4 cells with one goal, and one of 1 cell with two goals.
    wide = draw(["..", ".."], ("Book", 0, 1.5, 1, *SMALL))
    narrow = draw(["."], ("Book", 0, 1.5, 1, *SMALL), ("Fridge", 1, 0.9, 1, 0.3, 1.2, 0.3))
    bank = compile_bank([wide, narrow], CATEGORIES)
    env, params = build(bank, {}, 10)
    _, state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(jax.random.key(0), 40_000), params)
    pose, scene, goal = np.asarray(state.pose), np.asarray(state.scene), np.asarray(state.goal)
    assert not np.asarray(state.time).any()
    assert not (pose % 2).any()  # level

    def uniform(values, choices):
        counts = np.bincount(np.searchsorted(choices, values), minlength=len(choices))
        assert np.isin(values, choices).all()
        return chisquare(counts).pvalue > 1e-3

    assert uniform(scene, [0, 1])
    assert (goal[scene == 0] == BOOK).all()
    assert uniform(goal[scene == 1], [0, 2])
    assert uniform(pose[scene == 0], np.arange(0, 64, 2))  # cell and heading
    assert uniform(pose[scene == 1], np.arange(64, 80, 2))
    assert not uniform(np.append(scene, np.zeros(1000, int)), [0, 1])  # the test can tell


def test_make_from_a_scene_file(tmp_path):
    path = tmp_path / "rooms.jsonl.gz"
    write_scenes(path, ROOMS)
    types = tuple(scene.room_type for scene in ROOMS[4:])
    assert types == ROOM_TYPES
    env, params = make(path, "val")
    assert params.step_limit.tolist() == [200 if room == "living_room" else 100 for room in types]
    assert params.room.tolist() == [0, 1, 2, 3]
    assert (env.num_actions, len(env.categories)) == (6, 22)
    assert make(path)[1].step_limit.tolist() == [30] * 4
    assert make(path, categories=("Television", "Sink"))[0].categories == ("Television", "Sink")


def test_make_refuses_what_it_does_not_know(tmp_path):
    with pytest.raises(InputError, match=r"romms: neither a world \(rooms\) nor the name of a scene file"):
        make("romms")
    path = tmp_path / "train.jsonl.gz"
    write_scenes(path, ROOMS[:1])
    with pytest.raises(InputError, match=r"split 'valid': choose one of train, val, test"):
        make(path, "valid")
    with pytest.raises(InputError, match=r"train\.jsonl\.gz: holds no scene of split 'test'; it holds train"):
        make(path, "test")
    with pytest.raises(InputError, match="reachable goal"):
        make(path, categories=("Unicorn",))
