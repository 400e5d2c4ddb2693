"""Signs of another layout: exchanges, chances, and what a regression on walks learns."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE, HOUSES, SMALL, draw

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.gaps import NUM_NEAR_FEATURES, surprise_gap
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes
from jaxnav.training import calibration as module
from jaxnav.training.calibration import (
    co_visibility_from_counts,
    draw_category_exchange,
    explore,
    fit_shift_classifier,
    fit_sighting_classifier,
    limit_walks,
)

K = 9
EXCHANGE = jax.jit(draw_category_exchange)


def test_many_categories_limit_the_walks_of_a_regression():
    # 200 categories have 200 * 199 / 2 = 19,900 pairs with 20 features, in two layouts 3,184,000 bytes a walk; 2 GiB
    # hold 674 of them.
    assert limit_walks(4096, 20, 200) == 674
    # 22 categories have 231 pairs, 36,960 bytes a walk.
    assert limit_walks(4096, 20, 22) == 4096
    assert limit_walks(4096, 20, 10_000) == 1


@given(st.integers(0, 2**32 - 2), st.lists(st.booleans(), min_size=K, max_size=K))
def test_an_exchange_is_between_pairs_of_the_present(seed, present):
    often = jax.random.uniform(jax.random.key(seed + 1), (K,))
    order = np.asarray(EXCHANGE(jax.random.key(seed), jnp.array(present), often))
    np.testing.assert_array_equal(order[order], np.arange(K))
    moved = order != np.arange(K)
    assert not moved[~np.array(present)].any()
    assert moved.sum() == sum(present) // 2 * 2  # one of an odd number stays


@pytest.mark.slow
def test_categories_exchange_with_those_seen_about_as_often():
    """The distance in rank is under that of a pair at random, (K + 1) / 3, and over that of fixed neighbours, 1."""
    often, present = jnp.arange(24.0)[::-1], jnp.ones(24, bool)
    orders = jax.vmap(draw_category_exchange, (0, None, None))(jax.random.split(jax.random.key(0), 500), present, often)
    distance = np.abs(np.asarray(orders) - np.arange(24)).mean()
    assert 2 < distance < 5 < 25 / 3
    assert len(np.unique(orders, axis=0)) > 400


def test_chances_by_hand():
    """Of 4 poses showing 0, one shows 1, which is half of those that show 1. An unmet room gets those of all rooms."""
    counts = jnp.array([[[4.0, 1], [1, 2]], [[0, 0], [0, 0]], [[0, 0], [0, 2]]])
    expected = [[[0, 0.25], [0.5, 0]], [[0, 0.25], [0.25, 0]], [[0, 0], [0, 0]]]
    np.testing.assert_array_equal(co_visibility_from_counts(counts), expected)


REGRESSION = jax.jit(module._fit_log_odds, static_argnums=3)


@pytest.mark.slow
def test_the_regression_finds_the_odds_and_is_calibrated():
    """Pairs seen independently, in the other layout with exchanged shares: the odds are known, ln of the odds ratio."""
    generator, walks, pairs = np.random.default_rng(0), 4000, 36
    share = np.stack([x := generator.uniform(0.1, 0.7, pairs), generator.permutation(x)])
    exact = np.subtract(*np.log(share / (1 - share))[::-1])

    def both():
        return np.concatenate([generator.random((walks, pairs)) < rate for rate in share])

    rooms, held_out = jnp.zeros(2 * walks, jnp.int32), jnp.tile(jnp.arange(walks) % 4 == 0, 2)
    odds = np.asarray(REGRESSION(jnp.asarray(both()), rooms, held_out, 1))[0]
    assert np.corrcoef(odds, exact)[0, 1] > 0.98
    assert np.polyfit(exact, odds, 1)[0] == pytest.approx(1, abs=0.25)
    gaps, other = 1 / (1 + np.exp(-(both() @ odds))), np.arange(2 * walks) >= walks
    for low in (0.0, 0.25, 0.5, 0.75):
        inside = (gaps >= low) & (gaps < low + 0.25)
        assert other[inside].mean() == pytest.approx(gaps[inside].mean(), abs=0.07)


@pytest.mark.slow
def test_nothing_is_learned_where_layouts_are_alike():
    """Negative control: both halves hold the same walks."""
    pairs = jnp.tile(jnp.asarray(np.random.default_rng(0).random((200, 36)) < 0.3), (2, 1))
    odds = REGRESSION(pairs, jnp.zeros(400, jnp.int32), jnp.tile(jnp.arange(200) % 4 == 0, 2), 1)
    assert np.abs(odds).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("pooled", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_signs_of_a_world(pooled):
    """Rooms of two categories: their exchange leaves the pair, so that there is nothing to learn but chances."""
    env, params = tiny.world()
    size = env.row_format.num_categories
    counts = jnp.zeros((NUM_PRIORS, size, size)).at[np.unique(params.room)].set(1 + jnp.eye(size)[None])
    signs = jax.jit(fit_shift_classifier, static_argnums=(0, 4, 5))(env, params, counts, jax.random.key(1), 64, pooled)
    assert signs.log_odds.shape == signs.co_visibility.shape == counts.shape
    assert signs.log_odds.dtype == signs.co_visibility.dtype == np.float32
    assert np.abs(signs.log_odds).max() < 1e-3
    np.testing.assert_array_equal(signs.co_visibility, co_visibility_from_counts(counts))


@pytest.mark.slow
def test_near_log_odds_of_a_world():
    """Rooms of two categories: their exchange leaves the pair as near as before, so it tells nothing."""
    env, params = tiny.world()
    size = env.row_format.num_categories
    counts = jnp.zeros((NUM_PRIORS, size, size)).at[np.unique(params.room)].set(1 + jnp.eye(size)[None])
    fit = jax.jit(fit_sighting_classifier, static_argnums=(0, 4, 5))
    log_odds = fit(env, params, counts, jax.random.key(1), 64, False)
    assert log_odds.shape == (NUM_PRIORS, NUM_NEAR_FEATURES, size, size)
    assert log_odds.dtype == np.float32
    # The third category of a room is a false alarm.
    for scene, present in enumerate(np.asarray(module._find_present_categories(env, params))):
        first, second = np.flatnonzero(present)
        np.testing.assert_allclose(log_odds[params.room[scene], :, first, second], 0.0, atol=1e-3)


@pytest.mark.exhaustive
def test_near_log_odds_separate_layouts_in_new_homes():
    """Fitted to 24 houses, the gap of walks in 12 others is larger where their categories have exchanged places."""
    task = WORLDS["houses"].task
    worlds = []
    for split, num_scenes in (("train", 24), ("val", 12)):
        scenes = make_generated_scenes("houses", split, num_scenes)
        worlds.append(build_environment(compile_bank((scenes[i] for i in range(num_scenes)), task), {}, 500))
    (env, params), (_, new_params) = worlds
    counts = jax.jit(explore, static_argnums=(0, 3, 4))(env, params, jax.random.key(0), 512, 100).counts
    fit = jax.jit(fit_sighting_classifier, static_argnums=(0, 4, 5))
    log_odds = fit(env, params, counts, jax.random.key(1), 1024, True)[0]
    assert not np.tril(log_odds).any()

    # Sightings of new walks, and of the same walks with categories exchanged.
    num_walks = 256
    poses, scene = jax.jit(module._walk, static_argnums=(0, 3, 4))(env, new_params, jax.random.key(2), num_walks, 80)
    count_sightings = jax.jit(jax.vmap(functools.partial(module._count_sightings, env, new_params)))
    sightings = count_sightings(poses, jnp.full(num_walks, 80))
    present = module._find_present_categories(env, new_params)[scene]
    frequency = jnp.broadcast_to(jnp.diagonal(counts.sum(axis=0)), present.shape)
    exchanges = jax.vmap(draw_category_exchange)(jax.random.split(jax.random.key(3), num_walks), present, frequency)
    shifted = jax.vmap(lambda matrix, exchange: matrix[:, exchange][:, :, exchange])(sightings, exchanges)
    gap = np.asarray(jax.vmap(surprise_gap, (0, None))(sightings, log_odds))
    shifted_gap = np.asarray(jax.vmap(surprise_gap, (0, None))(shifted, log_odds))

    # Area under the curve, and calibration: the mean gap is the share of shifted walks, one half.
    area = (shifted_gap[:, None] > gap).mean() + 0.5 * (shifted_gap[:, None] == gap).mean()
    assert area > 0.6
    assert np.concatenate([gap, shifted_gap]).mean() == pytest.approx(0.5, abs=0.1)


def test_all_that_stands_in_a_scene_exchanges_goal_or_not():
    """Of three categories one is a goal; the fridge stands in the second scene alone."""
    near, chair = ("Book", 0, 0.9, 1, *SMALL), ("Chair", 0.25, 0.5, 1, *SMALL)
    scenes = [draw(["..", ".."], near, chair), draw(["..", ".."], near, ("Fridge", 0.5, 0.9, 1.5, *SMALL))]
    env, params = build_environment(compile_bank(scenes, Task(CATEGORIES, ("Book",), HOUSES, PERFECT_DETECTOR)), {}, 30)
    present = module._find_present_categories(env, params)
    expected = np.zeros((2, 3), bool)
    expected[:, BOOK] = expected[0, CHAIR] = expected[1, FRIDGE] = True
    np.testing.assert_array_equal(present, expected)
