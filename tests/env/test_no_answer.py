"""Observations hold no bit that says whether Done would succeed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.leakage import find_leaks, step_into

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import EnvParams, ObjectNav
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

#: Scenes of each world, enough that a perfect predictor differs from the detector beyond chance for most goals.
NUM_SCENES = {"rooms": 12, "apartments": 8, "houses": 4}
EACH = ["rooms", "houses", pytest.param("apartments", marks=pytest.mark.slow)]


@functools.cache
def world(name: str) -> tuple[Bank, ObjectNav, EnvParams]:
    scenes = make_generated_scenes(name, "train", NUM_SCENES[name])
    bank = compile_bank([scenes[i] for i in range(len(scenes))], WORLDS[name].task)
    return bank, *build_environment(bank, {}, 10)


@pytest.mark.parametrize("name", EACH)
def test_no_bit_predicts_success_better_than_the_detection_of_the_goal(name):
    bank, env, params = world(name)
    leaks = find_leaks(env, params, bank)
    assert not leaks.bits
    assert len(leaks.goals) >= 0.75 * leaks.num_goals


@pytest.mark.parametrize("name", EACH)
def test_success_bits_in_the_rows_are_flagged(name):
    bank, env, params = world(name)
    answers = np.packbits(bank.best_length == 1, axis=1, bitorder="little")
    rows = bank.rows.copy()
    padding = rows[:, -answers.shape[1] :]
    assert not padding.any()
    padding[:] = answers
    leaky = params.replace(tables=params.tables.replace(rows=jnp.asarray(rows)))
    leaks = find_leaks(env, leaky, bank)
    first = 8 * (rows.shape[1] - answers.shape[1])
    arrays = ("observation.row", "final_observation.row")
    assert leaks.bits == {(goal, array, first + goal) for goal in leaks.goals for array in arrays}
    assert len(leaks.goals) >= 0.75 * leaks.num_goals


@pytest.mark.parametrize("name", EACH)
def test_a_reset_shows_what_a_step_shows(name):
    _, env, params = world(name)
    shown, states = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), 500), params)
    stepped = jax.vmap(functools.partial(step_into, env), (0, None))(states, params)
    for observation in stepped.values():
        jax.tree.map(np.testing.assert_array_equal, observation, shown)
