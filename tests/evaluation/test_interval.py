"""Intervals: format, negation and subtraction, and the round trip through JSON."""

import json
import math

import pytest
from support.intervals import bounds

from jaxnav.evaluation.statistics import Interval

NAN = math.nan
UNDEFINED = Interval(NAN)


def interval_fields(interval: Interval) -> list[float]:
    return [*bounds(interval), interval.std, *interval.seeds]


@pytest.mark.parametrize(
    ("interval", "spec", "text"),
    [
        (Interval(1.25, -0.5, 3.0), "+.1f", "+1.2 [-0.5, +3.0]"),
        (Interval(0.5, 0.25, 0.75, std=0.1, seeds=(0.4, 0.6)), ".2f", "0.50 [0.25, 0.75]"),
        (Interval(1.0), "+.1f", "+1.0 [-]"),  # too few scenes or runs for bounds
        (Interval(1.0, std=0.5, seeds=(0.5, 1.5)), ".0f", "1 [-]"),
        (UNDEFINED, ".1f", "-"),
    ],
)
def test_interval_is_formatted_with_its_bounds(interval, spec, text):
    assert f"{interval:{spec}}" == text
    assert interval.has_bounds == ("," in text)


def test_negation_and_subtraction_keep_the_bounds_in_order():
    interval = Interval(0.2, 0.1, 0.4)
    assert interval_fields(-interval)[:3] == [-0.2, -0.4, -0.1]
    assert interval_fields(interval - 0.5)[:3] == [0.2 - 0.5, 0.1 - 0.5, 0.4 - 0.5]
    assert interval_fields(0.5 - interval)[:3] == [0.5 - 0.2, 0.5 - 0.4, 0.5 - 0.1]
    # A difference of 0 is positive zero.
    assert math.copysign(1.0, (0.5 - Interval(0.5, 0.5, 0.5)).mean) == 1.0


@pytest.mark.parametrize("result", [-UNDEFINED, UNDEFINED - 0.5, 0.5 - UNDEFINED, -Interval(1.0), 0.5 - Interval(1.0)])
def test_arithmetic_adds_no_bounds(result):
    assert not result.has_bounds
    assert math.isnan(result.high)


@pytest.mark.parametrize(
    ("interval", "data"),
    [
        (
            Interval(1.0, 0.5, 1.5, std=0.25, seeds=(0.75, 1.25)),
            {"mean": 1.0, "std": 0.25, "ci95": [0.5, 1.5], "seeds": [0.75, 1.25]},
        ),
        (Interval(1.0, 0.5, 1.5), {"mean": 1.0, "std": None, "ci95": [0.5, 1.5]}),
        (Interval(1.0, seeds=(1.0,)), {"mean": 1.0, "std": None, "ci95": None, "seeds": [1.0]}),
        (UNDEFINED, {"mean": None, "std": None, "ci95": None}),
    ],
)
def test_interval_json_round_trip_is_exact(interval, data):
    interval_json = interval.to_json()
    assert interval_json == data
    result = Interval.from_json(json.loads(json.dumps(interval_json, allow_nan=False)))
    assert interval_fields(result) == pytest.approx(interval_fields(interval), nan_ok=True, rel=0, abs=0)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({"mean": 1.0, "ci95": [0.5, 1.5]}, [1.0, 0.5, 1.5, NAN]),
        ({"mean": 1.0, "ci95": [0.5, 1.5], "std": 0.25}, [1.0, 0.5, 1.5, 0.25]),
        ({"mean": None, "ci95": [None, None]}, [NAN, NAN, NAN, NAN]),
    ],
)
def test_interval_reads_json_of_version_0_1(data, expected):
    assert interval_fields(Interval.from_json(data)) == pytest.approx(expected, nan_ok=True)
