"""No bit of an observation reveals whether Done would succeed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.leakage import find_leaks, step_into
from support.tiers import params_by_tier

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import EnvParams, ObjectNav
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

#: Scenes of each world, enough that a perfect predictor differs from the detector beyond chance for most goals.
NUM_SCENES = {"rooms": 12, "apartments": 8, "houses": 4}
all_worlds = pytest.mark.parametrize(
    "world", params_by_tier(["rooms", "houses", "apartments"], fast=["rooms"], slow=["houses"])
)


@functools.cache
def build_world(world: str) -> tuple[Bank, ObjectNav, EnvParams]:
    """Tables of generated training scenes, and an environment with them."""
    scenes = make_generated_scenes(world, "train", NUM_SCENES[world])
    bank = compile_bank([scenes[index] for index in range(len(scenes))], WORLDS[world].task)
    env, params = build_environment(bank, {}, 10)
    return bank, env, params


@pytest.mark.slow
@all_worlds
def test_no_observation_bit_predicts_success_better_than_the_goals_detection(world):
    bank, env, params = build_world(world)
    leaks = find_leaks(env, params, bank)
    assert not leaks.bits
    assert len(leaks.goals) >= 0.75 * leaks.num_goals


@pytest.mark.slow
@all_worlds
def test_find_leaks_flags_success_bits_planted_in_the_rows(world):
    bank, env, params = build_world(world)

    # Bit g of the padding says whether Done would succeed for goal g.
    success_bits = np.packbits(bank.best_length == 1, axis=1, bitorder="little")
    num_bytes = success_bits.shape[1]
    leaky_rows = bank.rows.copy()
    assert not leaky_rows[:, -num_bytes:].any()
    leaky_rows[:, -num_bytes:] = success_bits
    leaky_params = params.replace(tables=params.tables.replace(rows=jnp.asarray(leaky_rows)))

    # Exactly these bits are flagged, in both observations of a step.
    leaks = find_leaks(env, leaky_params, bank)
    first_bit = 8 * (leaky_rows.shape[1] - num_bytes)
    expected_bits = set()
    for goal in leaks.goals:
        expected_bits.add((goal, "observation.row", first_bit + goal))
        expected_bits.add((goal, "final_observation.row", first_bit + goal))
    assert leaks.bits == expected_bits
    assert len(leaks.goals) >= 0.75 * leaks.num_goals


@pytest.mark.slow
@all_worlds
def test_reset_and_step_observe_a_state_alike(world):
    _, env, params = build_world(world)
    keys = jax.random.split(jax.random.key(0), 500)
    reset_observation, states = jax.vmap(env.reset, (0, None))(keys, params)
    step_observations = jax.vmap(functools.partial(step_into, env), (0, None))(states, params)
    for observation in step_observations.values():
        jax.tree.map(np.testing.assert_array_equal, observation, reset_observation)
