"""Spaces contain what they draw and what the environment gives, and refuse everything else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny

import jaxnav
from jaxnav.env.objectnav import Observation
from jaxnav.env.spaces import Box, Dict, Discrete, Space
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.task import DONE, NUM_ACTIONS

ENV, PARAMS = tiny.world()
BYTES = Box(3, 9, (4,), jnp.uint8)
BOTH = Dict({"row": BYTES, "goal": Discrete(5)})


def batch(number: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(seed), number)


@pytest.mark.parametrize("space", [Discrete(5), Discrete(3, (2, 2)), BYTES, Box(-2, 2, (), jnp.int32), BOTH])
def test_what_is_drawn_is_contained(space: Space):
    drawn = jax.jit(jax.vmap(space.sample))(batch(64))
    assert jax.jit(jax.vmap(space.contains))(drawn).tolist() == [True] * 64
    assert bool(space.contains(space.sample(jax.random.key(0))))


@pytest.mark.parametrize(
    ("space", "expected"),
    [(Discrete(5), range(5)), (Box(3, 9, (1,), jnp.uint8), range(3, 10))],
    ids=["discrete", "box"],
)
def test_draws_reach_every_value_and_no_other(space, expected):
    drawn = jax.vmap(space.sample)(batch(512))
    assert drawn.dtype == space.dtype
    assert set(drawn.ravel().tolist()) == set(expected)


def test_the_names_of_a_dict_are_drawn_independently():
    space = Dict({"a": Discrete(1000), "b": Discrete(1000)})
    drawn = jax.vmap(space.sample)(batch(64))
    assert (drawn["a"] != drawn["b"]).any()


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (Discrete(5), jnp.int32(-1)),
        (Discrete(5), jnp.int32(5)),
        (Discrete(5), jnp.float32(2)),
        (Discrete(5), jnp.bool_(True)),
        (Discrete(5), 7),
        (Discrete(5), jnp.zeros(2, jnp.int32)),
        (Discrete(5, (2,)), jnp.int32(0)),
        (Discrete(5, (2,)), jnp.array([0, 5])),
        (BYTES, jnp.full(4, 2, jnp.uint8)),
        (BYTES, jnp.full(4, 10, jnp.uint8)),
        (BYTES, jnp.array([3, 4, 5, 10], jnp.uint8)),
        (BYTES, jnp.full(3, 5, jnp.uint8)),
        (BYTES, jnp.full((1, 4), 5, jnp.uint8)),
        (BYTES, jnp.full(4, 5, jnp.int32)),
        (BYTES, jnp.full(4, 5, jnp.float32)),
        (BOTH, {"row": jnp.full(4, 5, jnp.uint8), "goal": jnp.int32(5)}),
        (BOTH, {"row": jnp.full(4, 2, jnp.uint8), "goal": jnp.int32(4)}),
        (BOTH, {"row": jnp.full(4, 5, jnp.uint8)}),
        (BOTH, {"row": jnp.full(4, 5, jnp.uint8), "goal": jnp.int32(4), "more": jnp.int32(0)}),
        (BOTH, Observation(row=jnp.full(4, 5, jnp.uint8), goal=jnp.int32(5))),
        (BOTH, jnp.int32(4)),
    ],
)
def test_other_values_shapes_and_types_are_not_contained(space, value):
    assert not bool(space.contains(value))
    assert not bool(jax.jit(space.contains)(value))


@pytest.mark.parametrize("value", [4, np.int64(4), jnp.uint8(4), jnp.int32(0)])
def test_whole_numbers_of_any_type_are_numbers(value):
    assert bool(Discrete(5).contains(value))
    assert bool(Discrete(300).contains(value))


def test_a_dict_takes_mappings_and_objects():
    row, goal = jnp.full(4, 5, jnp.uint8), jnp.int32(4)
    assert bool(BOTH.contains({"row": row, "goal": goal}))
    assert bool(BOTH.contains({"goal": goal, "row": row}))
    assert bool(BOTH.contains(Observation(row=row, goal=goal)))


def test_observations_of_reset_and_step_are_in_the_space():
    space = ENV.observation_space(PARAMS)
    contains = jax.jit(jax.vmap(space.contains))
    observation, state = jax.vmap(ENV.reset, (0, None))(batch(16), PARAMS)
    assert contains(observation).all()
    step = jax.jit(jax.vmap(ENV.step, (0, 0, 0, None)))
    endings = 0
    for time in range(12):
        action = jax.vmap(ENV.action_space(PARAMS).sample)(batch(16, 2 * time + 1))
        observation, state, _, terminated, truncated, info = step(batch(16, 2 * time + 2), state, action, PARAMS)
        assert contains(observation).all()
        assert contains(info["final_observation"]).all()
        endings += int((terminated | truncated).sum())
    assert endings
    wrong = observation.replace(goal=observation.goal.at[3].set(len(tiny.CATEGORIES)))
    assert contains(wrong).tolist() == [i != 3 for i in range(16)]


def test_the_space_of_actions_is_that_of_the_task():
    for space in (ENV.action_space(), ENV.action_space(PARAMS)):
        assert (space.n, space.shape, space.dtype) == (NUM_ACTIONS, (), jnp.int32)
        assert bool(space.contains(jnp.int32(DONE)))
        assert not bool(space.contains(jnp.int32(NUM_ACTIONS)))
    # Every number in the space is an action of its own: five of them lead to poses, Done ends.
    state = ENV.reset(jax.random.key(0), PARAMS)[1]
    ended = jax.vmap(functools.partial(ENV.advance, state, params=PARAMS))(jnp.arange(NUM_ACTIONS))[2]
    assert ended.tolist() == [action == DONE for action in range(NUM_ACTIONS)]


def test_the_space_of_observations_is_that_of_the_rows():
    space = ENV.observation_space(PARAMS)
    assert list(space.spaces) == ["row", "goal"]
    drawn = space.sample(jax.random.key(0))
    observation = ENV.reset(jax.random.key(0), PARAMS)[0]
    for name, value in vars(observation).items():
        assert (drawn[name].shape, drawn[name].dtype) == (value.shape, value.dtype)


def test_the_calls_are_those_of_gymnax():
    key = jax.random.key(0)
    observation, state = ENV.reset(key, PARAMS)
    results = ENV.step(key, state, ENV.action_space(PARAMS).sample(key), PARAMS)
    assert len(results) == 6
    following, after, reward, terminated, truncated, info = results
    assert jax.tree.structure(following) == jax.tree.structure(observation)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert [value.dtype for value in (reward, terminated, truncated)] == [jnp.float32, jnp.bool_, jnp.bool_]
    assert isinstance(info, dict)
    assert ENV.name == "ObjectNav"
    assert ENV.num_actions == ENV.action_space(PARAMS).n


def test_an_environment_that_was_made_knows_its_parameters(tmp_path):
    scenes = tmp_path / "scenes.jsonl.gz"
    write_scenes(scenes, [tiny.KITCHEN])
    env, params = jaxnav.make("rooms", scenes=scenes)
    assert env.default_params is params
    observation, _ = env.reset(jax.random.key(0), env.default_params)
    assert bool(env.observation_space(env.default_params).contains(observation))
    # They are no part of what the environment is: it stays hashable, and equal to one built by hand.
    again, _ = jaxnav.make("rooms", scenes=scenes)
    assert env == again
    assert hash(env) == hash(again)


def test_an_environment_that_was_built_by_hand_has_no_parameters():
    with pytest.raises(ValueError, match=r"no bundled parameters; jaxnav\.make returns both"):
        _ = ENV.default_params
    np.testing.assert_array_equal(PARAMS.step_limit, tiny.LIMITS)
