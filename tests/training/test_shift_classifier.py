"""Evidence of a shifted layout: exchanges of categories, co-visibility, and log odds from a regression on walks."""

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
from jaxnav.training import calibration
from jaxnav.training.calibration import (
    co_visibility_from_counts,
    draw_category_exchange,
    explore,
    fit_shift_classifier,
    fit_sighting_classifier,
    limit_walks,
)

NUM_CATEGORIES = 9
draw_exchange = jax.jit(draw_category_exchange)


def test_many_categories_limit_the_walks_of_a_regression():
    # 200 categories have 200 * 199 / 2 = 19,900 pairs with 20 features. In two layouts, a walk takes 3,184,000 bytes,
    # and 2 GiB hold 674 walks.
    assert limit_walks(4096, 20, 200) == 674
    # 22 categories have 231 pairs, and a walk takes 36,960 bytes.
    assert limit_walks(4096, 20, 22) == 4096
    assert limit_walks(4096, 20, 10_000) == 1


@given(st.integers(0, 2**32 - 2), st.lists(st.booleans(), min_size=NUM_CATEGORIES, max_size=NUM_CATEGORIES))
def test_categories_of_a_scene_exchange_in_pairs(seed, present):
    frequency = jax.random.uniform(jax.random.key(seed + 1), (NUM_CATEGORIES,))
    exchange = np.asarray(draw_exchange(jax.random.key(seed), jnp.array(present), frequency))
    np.testing.assert_array_equal(exchange[exchange], np.arange(NUM_CATEGORIES))
    is_exchanged = exchange != np.arange(NUM_CATEGORIES)
    assert not is_exchanged[~np.array(present)].any()
    assert is_exchanged.sum() == sum(present) // 2 * 2  # if their number is odd, one category stays


@pytest.mark.slow
def test_categories_exchange_with_categories_of_similar_frequency():
    """Mean distance in rank: fixed neighbours have 1, and random pairs of K = 24 categories have (K + 1) / 3."""
    frequency = jnp.arange(24.0)[::-1]
    present = jnp.ones(24, bool)
    keys = jax.random.split(jax.random.key(0), 500)
    exchanges = jax.vmap(draw_category_exchange, (0, None, None))(keys, present, frequency)
    rank_distance = np.abs(np.asarray(exchanges) - np.arange(24)).mean()
    assert 2 < rank_distance < 5 < 25 / 3
    assert len(np.unique(exchanges, axis=0)) > 400


def test_co_visibility_follows_worked_arithmetic():
    """Of 4 poses that show category 0, one shows category 1; of 2 poses that show category 1, one shows category 0.

    A room type without any counts gets the co-visibility of all rooms.
    """
    counts = jnp.array([[[4.0, 1], [1, 2]], [[0, 0], [0, 0]], [[0, 0], [0, 2]]])
    expected = [[[0, 0.25], [0.5, 0]], [[0, 0.25], [0.25, 0]], [[0, 0], [0, 0]]]
    np.testing.assert_array_equal(co_visibility_from_counts(counts), expected)


fit_log_odds = jax.jit(calibration._fit_log_odds, static_argnums=3)


@pytest.mark.slow
def test_the_regression_finds_the_log_odds_and_is_calibrated():
    """Pairs are seen independently, and the shifted layout permutes their rates: the exact log odds are known."""
    generator = np.random.default_rng(0)
    num_walks = 4000
    num_pairs = 36
    # The rates of the pairs in the training layout and in the shifted layout, and the log of their odds ratio.
    training_rates = generator.uniform(0.1, 0.7, num_pairs)
    rates = np.stack([training_rates, generator.permutation(training_rates)])
    training_logits, shifted_logits = np.log(rates / (1 - rates))
    exact_log_odds = shifted_logits - training_logits

    def draw_walks():
        """Pairs seen on walks in the training layout, then on walks in the shifted layout."""
        return np.concatenate([generator.random((num_walks, num_pairs)) < layout_rates for layout_rates in rates])

    # The fitted log odds agree with the exact ones.
    rooms = jnp.zeros(2 * num_walks, jnp.int32)
    is_held_out = jnp.tile(jnp.arange(num_walks) % 4 == 0, 2)
    log_odds = np.asarray(fit_log_odds(jnp.asarray(draw_walks()), rooms, is_held_out, 1))[0]
    assert np.corrcoef(log_odds, exact_log_odds)[0, 1] > 0.98
    assert np.polyfit(exact_log_odds, log_odds, 1)[0] == pytest.approx(1, abs=0.25)

    # Calibration: of the new walks with a gap in an interval, the share of shifted walks is their mean gap.
    gaps = 1 / (1 + np.exp(-(draw_walks() @ log_odds)))
    is_shifted = np.arange(2 * num_walks) >= num_walks
    for low in (0.0, 0.25, 0.5, 0.75):
        in_interval = (gaps >= low) & (gaps < low + 0.25)
        assert is_shifted[in_interval].mean() == pytest.approx(gaps[in_interval].mean(), abs=0.07)


@pytest.mark.slow
def test_equal_layouts_have_log_odds_of_zero():
    """Negative control: the walks of the two layouts are equal."""
    pairs = jnp.tile(jnp.asarray(np.random.default_rng(0).random((200, 36)) < 0.3), (2, 1))
    is_held_out = jnp.tile(jnp.arange(200) % 4 == 0, 2)
    log_odds = fit_log_odds(pairs, jnp.zeros(400, jnp.int32), is_held_out, 1)
    assert np.abs(log_odds).max() < 1e-3


def make_counts(env, params):
    """Counts [NUM_PRIORS, K, K] of the rooms of a world: each category at two poses, each pair at one of them."""
    num_categories = env.row_format.num_categories
    counts = jnp.zeros((NUM_PRIORS, num_categories, num_categories))
    return counts.at[np.unique(params.room)].set(1 + jnp.eye(num_categories)[None])


@pytest.mark.slow
@pytest.mark.parametrize("pooled", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_rooms_of_two_categories_have_log_odds_of_zero(pooled):
    """An exchange of two categories leaves their pair unchanged, so only co-visibility can be learned."""
    env, params = tiny.world()
    counts = make_counts(env, params)
    fit = jax.jit(fit_shift_classifier, static_argnums=(0, 4, 5))
    evidence = fit(env, params, counts, jax.random.key(1), 64, pooled)
    assert evidence.log_odds.shape == evidence.co_visibility.shape == counts.shape
    assert evidence.log_odds.dtype == evidence.co_visibility.dtype == np.float32
    assert np.abs(evidence.log_odds).max() < 1e-3
    np.testing.assert_array_equal(evidence.co_visibility, co_visibility_from_counts(counts))


@pytest.mark.slow
def test_rooms_of_two_categories_have_near_log_odds_of_zero():
    """An exchange of two categories leaves their distance unchanged, so it is no evidence of a shift."""
    env, params = tiny.world()
    counts = make_counts(env, params)
    num_categories = env.row_format.num_categories
    fit = jax.jit(fit_sighting_classifier, static_argnums=(0, 4, 5))
    log_odds = fit(env, params, counts, jax.random.key(1), 64, False)
    assert log_odds.shape == (NUM_PRIORS, NUM_NEAR_FEATURES, num_categories, num_categories)
    assert log_odds.dtype == np.float32
    # Only the pair of the two present categories counts, because the third category of a room is a false alarm.
    for scene, present in enumerate(np.asarray(calibration._find_present_categories(env, params))):
        low_category, high_category = np.flatnonzero(present)
        np.testing.assert_allclose(log_odds[params.room[scene], :, low_category, high_category], 0.0, atol=1e-3)


@pytest.mark.exhaustive
def test_near_log_odds_separate_layouts_in_new_homes():
    """After a fit to 24 houses, the gap of walks in 12 new houses is larger where categories have exchanged places."""
    # The log odds of the training houses.
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

    # Sightings of walks in new houses, and sightings of these walks with categories exchanged.
    num_walks = 256
    walk = jax.jit(calibration._walk, static_argnums=(0, 3, 4))
    poses, scene = walk(env, new_params, jax.random.key(2), num_walks, 80)
    count_sightings = jax.jit(jax.vmap(functools.partial(calibration._count_sightings, env, new_params)))
    sightings = count_sightings(poses, jnp.full(num_walks, 80))
    present = calibration._find_present_categories(env, new_params)[scene]
    frequency = jnp.broadcast_to(jnp.diagonal(counts.sum(axis=0)), present.shape)
    exchanges = jax.vmap(draw_category_exchange)(jax.random.split(jax.random.key(3), num_walks), present, frequency)
    shifted_sightings = jax.vmap(lambda matrix, exchange: matrix[:, exchange][:, :, exchange])(sightings, exchanges)
    gap = np.asarray(jax.vmap(surprise_gap, (0, None))(sightings, log_odds))
    shifted_gap = np.asarray(jax.vmap(surprise_gap, (0, None))(shifted_sightings, log_odds))

    # Area under the ROC curve, and calibration: the mean gap is the share of shifted walks, one half.
    area = (shifted_gap[:, None] > gap).mean() + 0.5 * (shifted_gap[:, None] == gap).mean()
    assert area > 0.6
    assert np.concatenate([gap, shifted_gap]).mean() == pytest.approx(0.5, abs=0.1)


def test_present_categories_are_all_objects_of_a_scene_not_only_goals():
    """Of three categories only the book is a goal; the chair is in the first scene, the fridge in the second."""
    book = ("Book", 0, 0.9, 1, *SMALL)
    chair = ("Chair", 0.25, 0.5, 1, *SMALL)
    fridge = ("Fridge", 0.5, 0.9, 1.5, *SMALL)
    scenes = [draw(["..", ".."], book, chair), draw(["..", ".."], book, fridge)]
    task = Task(CATEGORIES, ("Book",), HOUSES, PERFECT_DETECTOR)
    env, params = build_environment(compile_bank(scenes, task), {}, 30)
    present = calibration._find_present_categories(env, params)
    expected = np.zeros((2, 3), bool)
    expected[:, BOOK] = True
    expected[0, CHAIR] = True
    expected[1, FRIDGE] = True
    np.testing.assert_array_equal(present, expected)
