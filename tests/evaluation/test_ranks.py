"""Ranks count repeats, and ties as halves."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import rankdata

from jaxnav.evaluation.statistics import weight_below


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), min_size=1, max_size=30))
def test_weight_below_gives_midranks_of_repeated_values(pairs):
    values, repeats = np.array(pairs).T
    ranks = weight_below(values, values, np.stack([np.ones(len(values)), repeats], axis=1))
    np.testing.assert_allclose(ranks[:, 0], rankdata(values) - 0.5)
    repeated = rankdata(np.repeat(values, repeats)) - 0.5
    np.testing.assert_allclose(np.repeat(ranks[:, 1], repeats), repeated)


def test_weight_below_accepts_fractional_weights():
    # Below 2: weight 1.5 of the 1, and half the 0.25 of the other 2. Below 5: all of both. Below 0: none.
    weights_below = weight_below(np.array([2, 5, 0]), np.array([2, 1]), np.array([[0.25], [1.5]]))
    np.testing.assert_allclose(weights_below[:, 0], [1.625, 1.75, 0.0])
