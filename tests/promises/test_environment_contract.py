"""`check_environment`, the public check of the environment contract: built environments pass, broken ones are named."""

import jax.numpy as jnp
import pytest
from support.real_scenes import ITHOR, require

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.testing import check_environment
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Task

BANK = compile_bank([generate_room("train", index, 0) for index in range(4)], Task())  # one of each type


@pytest.mark.slow
def test_generated_rooms_satisfy_the_environment_contract():
    check_environment(*build_environment(BANK, {}, 5))


@pytest.mark.slow
def test_imported_rooms_satisfy_the_environment_contract():
    check_environment(*build_environment(compile_bank(read_scenes(require(ITHOR))[::25], Task()), {}, 100))


class DoubleEndingEnv(ObjectNav):
    """Environment that truncates the last step even if it terminated."""

    def advance(self, state, action, params):
        next_state, reward, terminated, _ = super().advance(state, action, params)
        return next_state, reward, terminated, next_state.time >= params.step_limit[state.scene]


class ContinuedTimeEnv(ObjectNav):
    """Environment whose time goes on after an ending."""

    def step(self, key, state, action, params):
        observation, next_state, reward, terminated, truncated, info = super().step(key, state, action, params)
        return observation, next_state.replace(time=state.time + 1), reward, terminated, truncated, info


class InvalidGoalEnv(ObjectNav):
    """Environment that asks for a category that does not exist."""

    def observe(self, state, params):
        return super().observe(state, params).replace(goal=state.goal + len(self.categories))


class FalseSuccessEnv(ObjectNav):
    """Environment that reports every step as a success."""

    def step(self, key, state, action, params):
        observation, next_state, reward, terminated, truncated, info = super().step(key, state, action, params)
        info |= {"success": jnp.ones_like(info["success"])}
        return observation, next_state, reward, terminated, truncated, info


@pytest.mark.slow
@pytest.mark.parametrize(
    ("broken_env", "message"),
    [
        (DoubleEndingEnv, "terminated and truncated at once"),
        (ContinuedTimeEnv, "no new episode begins after an episode has ended"),
        (InvalidGoalEnv, "a goal is not the index of a category"),
        (FalseSuccessEnv, "an episode succeeds without being terminated"),
    ],
)
def test_check_environment_refuses_broken_environments(broken_env, message):
    env, params = build_environment(BANK, {}, 5)
    check_environment(env, params, num_steps=1)
    with pytest.raises(AssertionError, match=message):
        check_environment(broken_env(env.task), params)
