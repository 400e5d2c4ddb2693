"""The public check of the contract, with broken environments."""

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

BANK = compile_bank([generate_room("train", i, 0) for i in range(4)], Task())  # one of each type


@pytest.mark.slow
def test_generated_rooms_satisfy_the_environment_contract():
    check_environment(*build_environment(BANK, {}, 5))


@pytest.mark.slow
def test_imported_rooms_satisfy_the_environment_contract():
    check_environment(*build_environment(compile_bank(read_scenes(require(ITHOR))[::25], Task()), {}, 100))


class EndsTwice(ObjectNav):
    """Truncate the last step, whatever it was."""

    def advance(self, state, action, params):
        after, reward, terminated, _ = super().advance(state, action, params)
        return after, reward, terminated, after.time >= params.step_limit[state.scene]


class NeverStartsAnew(ObjectNav):
    """Let time go on after an ending."""

    def step(self, key, state, action, params):
        observation, after, reward, terminated, truncated, info = super().step(key, state, action, params)
        return observation, after.replace(time=state.time + 1), reward, terminated, truncated, info


class AsksForTooMuch(ObjectNav):
    """Seek a category that does not exist."""

    def observe(self, state, params):
        return super().observe(state, params).replace(goal=state.goal + len(self.categories))


class Lies(ObjectNav):
    """Call every step a success."""

    def step(self, key, state, action, params):
        observation, after, reward, terminated, truncated, info = super().step(key, state, action, params)
        info |= {"success": jnp.ones_like(info["success"])}
        return observation, after, reward, terminated, truncated, info


@pytest.mark.slow
@pytest.mark.parametrize(
    ("broken", "promise"),
    [
        (EndsTwice, "terminated and truncated at once"),
        (NeverStartsAnew, "no new episode begins after an episode has ended"),
        (AsksForTooMuch, "a goal is not the index of a category"),
        (Lies, "an episode succeeds without being terminated"),
    ],
)
def test_check_environment_refuses_broken_environments(broken, promise):
    env, params = build_environment(BANK, {}, 5)
    check_environment(env, params, num_steps=1)
    with pytest.raises(AssertionError, match=promise):
        check_environment(broken(env.task), params)
