"""Divergence and likeness of layouts: worked numbers, SciPy as a second opinion, and what must not matter."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cosine
from scipy.special import rel_entr
from support import tiny_world as tiny

from jaxnav.evaluation.similarity import (
    cooccurrence_counts,
    expected_cooccurrence,
    scene_layout_gap,
    scene_layout_similarity,
)
from jaxnav.scenes.tables.observation_row import RowFormat

NUM_CATEGORIES = 4
MATRICES = st.lists(
    st.integers(0, 30), min_size=NUM_CATEGORIES * NUM_CATEGORIES, max_size=NUM_CATEGORIES * NUM_CATEGORIES
).map(lambda n: np.array(n, float).reshape(NUM_CATEGORIES, NUM_CATEGORIES))


def test_cooccurrence_counts_equal_a_loop_over_poses():
    bank, row_format = tiny.BANK, RowFormat(len(tiny.CATEGORIES))
    counts = cooccurrence_counts(bank)
    assert counts.shape == (2, 3, 3)
    num_kitchen_poses = bank.num_cells[0] * tiny.POSES_PER_CELL  # the kitchen's 16 cells, then the bedroom's 6
    for scene, rows in enumerate((bank.rows[:num_kitchen_poses], bank.rows[num_kitchen_poses:])):
        visible_sets = [set(np.flatnonzero(row)) for row in row_format.presence(rows)]
        for row_category in range(3):
            for column_category in range(3):
                assert counts[scene, row_category, column_category] == (row_category != column_category) * sum(
                    {row_category, column_category} <= visible_set for visible_set in visible_sets
                )
    assert (counts.sum(axis=(1, 2)) > 0).all()


def test_expected_cooccurrence_normalizes_rows_without_the_diagonal():
    # Row 0: 1 and 3 of 4; row 1: nothing; row 2: all with category 0. The diagonal is no part of it.
    counts = np.array([[9, 1, 3], [0, 5, 0], [2, 0, 0]])
    np.testing.assert_array_equal(expected_cooccurrence(counts), [[0, 0.25, 0.75], [0, 0, 0], [1, 0, 0]])


def test_scene_gap_and_similarity_follow_worked_arithmetic():
    # Two others per row, so 0.05 of uniform is 0.025 each. Row 0 of the scene: w = (1/4, 3/4), p = 0.95 w + 0.025 =
    # (0.2625, 0.7375); of the prior: w = (1/2, 1/2), q = (0.5, 0.5). Row 2: w = (1, 0), p = (0.975, 0.025); the prior's
    # row (1, 1) has w = (1/2, 1/2), so q = (0.5, 0.5). Row 1 of the scene is empty and left out.
    counts = np.array([[[9, 1, 3], [0, 5, 0], [2, 0, 0]]])
    prior = np.array([[0, 7, 7], [1, 0, 1], [1, 1, 0]])
    row_0 = 0.2625 * math.log(0.2625 / 0.5) + 0.7375 * math.log(0.7375 / 0.5)
    row_2 = 0.975 * math.log(0.975 / 0.5) + 0.025 * math.log(0.025 / 0.5)
    np.testing.assert_allclose(scene_layout_gap(counts, prior), [(row_0 + row_2) / 2], rtol=1e-12)
    # Cosine: the scene's rows 0 and 2 are (1/4, 3/4, 1, 0), the prior's (1/2, 1/2, 1/2, 1/2).
    expected_similarity = (0.125 + 0.375 + 0.5) / math.sqrt((0.0625 + 0.5625 + 1) * 1)
    np.testing.assert_allclose(scene_layout_similarity(counts, prior), [expected_similarity], rtol=1e-12)


def test_scene_without_cooccurrence_has_nan_gap_and_similarity():
    counts = np.stack([np.diag([3.0, 4, 0, 0]), np.ones((NUM_CATEGORIES, NUM_CATEGORIES))])
    assert np.isnan(scene_layout_gap(counts, np.ones((NUM_CATEGORIES, NUM_CATEGORIES)))).tolist() == [True, False]
    assert np.isnan(scene_layout_similarity(counts, np.ones((NUM_CATEGORIES, NUM_CATEGORIES)))).tolist() == [
        True,
        False,
    ]


@given(st.lists(MATRICES, min_size=3, max_size=3), st.lists(MATRICES, min_size=3, max_size=3))
def test_scene_gap_and_similarity_agree_with_scipy(counts, priors):
    counts, priors = np.array(counts), np.array(priors)
    gaps, similarities = scene_layout_gap(counts, priors), scene_layout_similarity(counts, priors)
    for scene, prior, gap, similarity in zip(counts, priors, gaps, similarities, strict=True):
        rows = [
            (np.delete(scene[i], i), np.delete(prior[i], i))
            for i in range(NUM_CATEGORIES)
            if np.delete(scene[i], i).sum() > 0
        ]
        if not rows:
            assert np.isnan(gap)
            continue
        scene_shares, prior_shares = (
            np.array([row / max(row.sum(), 1) for row in side]) for side in zip(*rows, strict=True)
        )
        scene_probs, prior_probs = (
            0.95 * scene_shares + 0.05 / (NUM_CATEGORIES - 1),
            0.95 * prior_shares + 0.05 / (NUM_CATEGORIES - 1),
        )
        np.testing.assert_allclose(gap, rel_entr(scene_probs, prior_probs).sum(axis=1).mean(), rtol=1e-9, atol=1e-15)
        if prior_shares.any():
            np.testing.assert_allclose(
                similarity, 1 - cosine(scene_shares.ravel(), prior_shares.ravel()), rtol=1e-9, atol=1e-12
            )
        else:
            assert np.isnan(similarity)


@given(MATRICES, st.floats(0.1, 50))
def test_scene_gap_and_similarity_ignore_scale_and_diagonal(counts, factor):
    counts, prior = counts[None] + 1, factor * (counts + 1) + np.diag([1.0, 2, 3, 4])
    np.testing.assert_allclose(scene_layout_gap(counts, prior), 0, atol=1e-12)
    np.testing.assert_allclose(scene_layout_similarity(counts, prior), 1, rtol=1e-12)


def test_priors_may_differ_between_scenes():
    counts = np.random.default_rng(0).integers(0, 9, (3, NUM_CATEGORIES, NUM_CATEGORIES))
    priors = np.random.default_rng(1).integers(0, 9, (3, NUM_CATEGORIES, NUM_CATEGORIES))
    for measure in (scene_layout_gap, scene_layout_similarity):
        single_values = [measure(scene[None], prior)[0] for scene, prior in zip(counts, priors, strict=True)]
        np.testing.assert_allclose(measure(counts, priors), single_values, rtol=1e-12)
        assert measure(counts, priors) != pytest.approx(measure(counts, priors[::-1]))
