"""Spaces contain their samples and the environment's observations, and no other value."""

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
BYTE_BOX = Box(3, 9, (4,), jnp.uint8)
DICT_SPACE = Dict({"row": BYTE_BOX, "goal": Discrete(5)})


def random_keys(count: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


@pytest.mark.parametrize("space", [Discrete(5), Discrete(3, (2, 2)), BYTE_BOX, Box(-2, 2, (), jnp.int32), DICT_SPACE])
def test_space_contains_its_samples(space: Space):
    samples = jax.jit(jax.vmap(space.sample))(random_keys(64))
    assert jax.jit(jax.vmap(space.contains))(samples).tolist() == [True] * 64
    assert bool(space.contains(space.sample(jax.random.key(0))))


@pytest.mark.parametrize(
    ("space", "expected_values"),
    [(Discrete(5), range(5)), (Box(3, 9, (1,), jnp.uint8), range(3, 10))],
    ids=["discrete", "box"],
)
def test_space_samples_every_value_and_no_other(space, expected_values):
    samples = jax.vmap(space.sample)(random_keys(512))
    assert samples.dtype == space.dtype
    assert set(samples.ravel().tolist()) == set(expected_values)


def test_dict_space_samples_its_entries_independently():
    space = Dict({"a": Discrete(1000), "b": Discrete(1000)})
    samples = jax.vmap(space.sample)(random_keys(64))
    assert (samples["a"] != samples["b"]).any()


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
        (BYTE_BOX, jnp.full(4, 2, jnp.uint8)),
        (BYTE_BOX, jnp.full(4, 10, jnp.uint8)),
        (BYTE_BOX, jnp.array([3, 4, 5, 10], jnp.uint8)),
        (BYTE_BOX, jnp.full(3, 5, jnp.uint8)),
        (BYTE_BOX, jnp.full((1, 4), 5, jnp.uint8)),
        (BYTE_BOX, jnp.full(4, 5, jnp.int32)),
        (BYTE_BOX, jnp.full(4, 5, jnp.float32)),
        (DICT_SPACE, {"row": jnp.full(4, 5, jnp.uint8), "goal": jnp.int32(5)}),
        (DICT_SPACE, {"row": jnp.full(4, 2, jnp.uint8), "goal": jnp.int32(4)}),
        (DICT_SPACE, {"row": jnp.full(4, 5, jnp.uint8)}),
        (DICT_SPACE, {"row": jnp.full(4, 5, jnp.uint8), "goal": jnp.int32(4), "more": jnp.int32(0)}),
        (DICT_SPACE, Observation(row=jnp.full(4, 5, jnp.uint8), goal=jnp.int32(5))),
        (DICT_SPACE, jnp.int32(4)),
    ],
)
def test_space_contains_no_value_out_of_range_or_of_another_shape_or_type(space, value):
    assert not bool(space.contains(value))
    assert not bool(jax.jit(space.contains)(value))


@pytest.mark.parametrize("value", [4, np.int64(4), jnp.uint8(4), jnp.int32(0)])
def test_discrete_space_contains_whole_numbers_of_any_type(value):
    assert bool(Discrete(5).contains(value))
    assert bool(Discrete(300).contains(value))


def test_dict_space_contains_mappings_and_objects():
    row = jnp.full(4, 5, jnp.uint8)
    goal = jnp.int32(4)
    assert bool(DICT_SPACE.contains({"row": row, "goal": goal}))
    assert bool(DICT_SPACE.contains({"goal": goal, "row": row}))
    assert bool(DICT_SPACE.contains(Observation(row=row, goal=goal)))


@pytest.mark.slow
def test_observation_space_contains_the_observations_of_reset_and_step():
    num_envs = 16
    contains = jax.jit(jax.vmap(ENV.observation_space(PARAMS).contains))
    step = jax.jit(jax.vmap(ENV.step, (0, 0, 0, None)))
    observation, state = jax.vmap(ENV.reset, (0, None))(random_keys(num_envs), PARAMS)
    assert contains(observation).all()

    # Random actions, longer than any episode.
    num_endings = 0
    for time in range(12):
        actions = jax.vmap(ENV.action_space(PARAMS).sample)(random_keys(num_envs, 2 * time + 1))
        step_keys = random_keys(num_envs, 2 * time + 2)
        observation, state, _, terminated, truncated, info = step(step_keys, state, actions, PARAMS)
        assert contains(observation).all()
        assert contains(info["final_observation"]).all()
        num_endings += int((terminated | truncated).sum())
    assert num_endings

    # Only the observation whose goal is no category is rejected.
    wrong_observation = observation.replace(goal=observation.goal.at[3].set(len(tiny.CATEGORIES)))
    assert contains(wrong_observation).tolist() == [index != 3 for index in range(num_envs)]


def test_action_space_is_that_of_the_task():
    for space in (ENV.action_space(), ENV.action_space(PARAMS)):
        assert (space.n, space.shape, space.dtype) == (NUM_ACTIONS, (), jnp.int32)
        assert bool(space.contains(jnp.int32(DONE)))
        assert not bool(space.contains(jnp.int32(NUM_ACTIONS)))


@pytest.mark.slow
def test_only_done_of_all_actions_terminates():
    _, state = ENV.reset(jax.random.key(0), PARAMS)
    advance = jax.vmap(functools.partial(ENV.advance, state, params=PARAMS))
    _, _, terminated, _ = advance(jnp.arange(NUM_ACTIONS))
    assert terminated.tolist() == [action == DONE for action in range(NUM_ACTIONS)]


def test_observation_space_has_the_shapes_and_types_of_observations():
    space = ENV.observation_space(PARAMS)
    assert list(space.spaces) == ["row", "goal"]
    sample = space.sample(jax.random.key(0))
    observation, _ = ENV.reset(jax.random.key(0), PARAMS)
    for name, value in vars(observation).items():
        assert (sample[name].shape, sample[name].dtype) == (value.shape, value.dtype)


def test_environment_has_the_interface_of_gymnax():
    key = jax.random.key(0)
    observation, state = ENV.reset(key, PARAMS)

    # A step has six results, of fixed structures and types.
    results = ENV.step(key, state, ENV.action_space(PARAMS).sample(key), PARAMS)
    assert len(results) == 6
    next_observation, next_state, reward, terminated, truncated, info = results
    assert jax.tree.structure(next_observation) == jax.tree.structure(observation)
    assert jax.tree.structure(next_state) == jax.tree.structure(state)
    assert [value.dtype for value in (reward, terminated, truncated)] == [jnp.float32, jnp.bool_, jnp.bool_]
    assert isinstance(info, dict)

    # Environments of gymnax also have a name and a number of actions.
    assert ENV.name == "ObjectNav"
    assert ENV.num_actions == ENV.action_space(PARAMS).n


def test_environment_of_make_has_default_params(tmp_path):
    scene_file = tmp_path / "scenes.jsonl.gz"
    write_scenes(scene_file, [tiny.KITCHEN])
    env, params = jaxnav.make("rooms", scenes=scene_file)
    assert env.default_params is params
    observation, _ = env.reset(jax.random.key(0), env.default_params)
    assert bool(env.observation_space(env.default_params).contains(observation))

    # The parameters do not count for equality and hash.
    same_env, _ = jaxnav.make("rooms", scenes=scene_file)
    assert env == same_env
    assert hash(env) == hash(same_env)


def test_environment_built_by_hand_has_no_default_params():
    with pytest.raises(ValueError, match=r"no bundled parameters; use those of jaxnav\.make"):
        _ = ENV.default_params
