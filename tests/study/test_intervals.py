"""Intervals: from resamples, moved, turned and written."""

import math

import numpy as np
import pytest

from jaxnav.evaluation.statistics import Summary
from jaxnav.study.intervals import UNDEFINED, Effect, Estimate, Interval, percentile_interval


def test_an_interval_leaves_out_what_is_not_defined():
    # 101 resamples 0 ... 100 and one without a value: percentiles 2.5 and 97.5 of 0 ... 100.
    result = percentile_interval(np.array([7.0, np.nan, *range(101)]))
    assert (result.mean, result.low, result.high) == pytest.approx((7.0, 2.5, 97.5))
    assert not percentile_interval(np.array([np.nan, 1.0])).defined
    assert not percentile_interval(np.array([1.0, np.nan])).defined


def test_it_is_written_with_its_bounds():
    assert f"{Interval(1.25, -0.5, 3.0):+.1f}" == "+1.2 [-0.5, +3.0]"
    assert f"{Effect(0.5, 0.25, 0.75, 0.1):.2f}" == "0.50 [0.25, 0.75]"
    assert f"{UNDEFINED:.1f}" == "undefined"


def test_levels_and_signs_keep_the_bounds_in_order():
    interval = Interval(0.2, 0.1, 0.4)
    assert -interval == Interval(-0.2, -0.4, -0.1)
    assert interval - 0.5 == Interval(0.2 - 0.5, 0.1 - 0.5, 0.4 - 0.5)
    assert 0.5 - interval == Interval(0.5 - 0.2, 0.5 - 0.4, 0.5 - 0.1)
    # A difference of 0 has no sign of its own.
    assert math.copysign(1.0, (0.5 - Interval(0.5, 0.5, 0.5)).mean) == 1.0
    assert not (-UNDEFINED).defined


def test_summaries_keep_their_numbers():
    summary = Summary(87.5, 17.5, (75.0, 100.0))
    values = np.array([[50.0, 100.0], [100.0, 100.0]])
    assert Effect.of(summary) == Effect(87.5, 75.0, 100.0, 17.5)
    assert Estimate.of(summary, values) == Estimate(87.5, 75.0, 100.0, 17.5, (75.0, 100.0))
