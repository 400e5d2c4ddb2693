"""Resamples keep strata and twins; ranks count repeats."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import rankdata
from support.study_results import episodes_in

from jaxnav.study.bootstrap import scene_draws, stratified_draws, weight_below


def test_strata_keep_their_sizes():
    strata = np.array([1, 0, 1, 0, 0])
    draws = stratified_draws(strata, np.random.default_rng(0), 100)
    assert draws.shape == (5, 101)
    np.testing.assert_array_equal(draws[:, 0], 1)
    for stratum, size in ((0, 3), (1, 2)):
        np.testing.assert_array_equal(draws[strata == stratum].sum(axis=0), size)


def test_scenes_are_drawn_within_room_types_with_their_twins():
    # Twins stand in the second list in another order, and one scene is there alone.
    here = episodes_in([0, 1, 1, 2], room=[0, 0, 1], names=("a", "b", "c"))
    there = episodes_in([0, 0, 1, 2, 3], room=[1, 0, 0, 0], names=("c", "b", "a", "only here"))
    one, other = scene_draws([here, there], np.random.default_rng(0), 500)
    assert one.shape == (4, 501)
    assert one.dtype == np.float32
    assert (one[:, 0] == 1).all()
    assert (other[:, 0] == 1).all()
    a, b, again, c = one
    np.testing.assert_array_equal(b, again)
    np.testing.assert_array_equal(other, [c, c, b, a, 3 - a - b])  # three bedrooms are drawn each time,
    np.testing.assert_array_equal(c, 1)  # and the only kitchen always
    # Each of three draws falls on `a` with probability 1/3: none does in (2/3)^3 = 0.296 +- 0.020 (s.e. of 500).
    assert (a[1:] == 0).mean() == pytest.approx(0.296, abs=0.08)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), min_size=1, max_size=30))
def test_weights_below_are_midranks_of_repeated_values(pairs):
    values, repeats = np.array(pairs).T
    ranks = weight_below(values, values, np.stack([np.ones(len(values)), repeats], axis=1))
    np.testing.assert_allclose(ranks[:, 0], rankdata(values) - 0.5)
    repeated = rankdata(np.repeat(values, repeats)) - 0.5
    np.testing.assert_allclose(np.repeat(ranks[:, 1], repeats), repeated)
