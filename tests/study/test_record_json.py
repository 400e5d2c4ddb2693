"""Records as JSON: inline, optional and undefined values."""

import dataclasses
import json
import math
from collections.abc import Mapping

import numpy as np
import pytest

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.records import INLINE, OPTIONAL, Curve, from_json, json_key, to_json


@dataclasses.dataclass(frozen=True)
class Inner:
    name: str
    size: float | None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Outer:
    start: int = dataclasses.field(metadata=json_key("from"))
    inner: Inner = dataclasses.field(metadata=INLINE)
    several: tuple[Inner, ...]
    missing: Inner | None = dataclasses.field(default=None, metadata=OPTIONAL)
    array: np.ndarray


@dataclasses.dataclass(frozen=True)
class Measured:
    shift: float
    intervals: Mapping[str, Interval] = dataclasses.field(metadata=INLINE)


OUTER = Outer(start=3, inner=Inner("a", None), several=(Inner("b", 1.5), Inner("c", 2.5)), array=np.array([[1.0, 2.0]]))
DATA = {
    "from": 3,
    "name": "a",
    "size": None,
    "several": [{"name": "b", "size": 1.5}, {"name": "c", "size": 2.5}],
    "array": [[1.0, 2.0]],
}


def test_a_record_has_the_keys_of_its_fields():
    assert to_json(OUTER) == DATA


def test_an_optional_field_is_there_if_it_is_not_none():
    assert to_json(dataclasses.replace(OUTER, missing=Inner("d", 0.5)))["missing"] == {"name": "d", "size": 0.5}


def test_it_is_read_again_with_its_types():
    data = DATA | {"missing": {"name": "d", "size": 0.5}}
    outer = from_json(Outer, data)
    assert outer.inner == Inner("a", None)
    assert outer.several == OUTER.several
    assert outer.missing == Inner("d", 0.5)
    np.testing.assert_array_equal(outer.array, OUTER.array)
    assert from_json(Inner, {"name": "e", "size": 1.0, "unknown": 1}) == Inner("e", 1.0)


def test_an_inline_mapping_takes_the_keys_that_are_left():
    measured = Measured(0.5, {"x": Interval(1.0, 0.5, 1.5), "y": Interval(2.0, 1.5, 2.5)})
    data = {
        "shift": 0.5,
        "x": {"mean": 1.0, "std": None, "ci95": [0.5, 1.5]},
        "y": {"mean": 2.0, "std": None, "ci95": [1.5, 2.5]},
    }
    assert to_json(measured) == data
    read = from_json(Measured, data)
    assert read.shift == 0.5
    assert {name: f"{interval}" for name, interval in read.intervals.items()} == {
        "x": "1.0 [0.5, 1.5]",
        "y": "2.0 [1.5, 2.5]",
    }


def test_an_undefined_interval_is_null():
    data = {"mean": None, "std": None, "ci95": None}
    assert json.loads(json.dumps(to_json(Interval(math.nan)), allow_nan=False)) == data
    assert math.isnan(from_json(Interval, data).mean)


def test_what_is_undefined_in_an_array_is_null():
    # The gap has no interval at a step where too few scenes still run.
    curve = Curve(np.array([0.5, 0.25]), np.array([0.25, math.nan]), np.array([0.75, math.nan]))
    data = json.loads(json.dumps(to_json(curve), allow_nan=False))
    assert data == {"mean": [0.5, 0.25], "low": [0.25, None], "high": [0.75, None]}
    read = from_json(Curve, data)
    np.testing.assert_array_equal(read.low, curve.low, strict=True)
    np.testing.assert_array_equal(read.high, curve.high, strict=True)


def test_an_interval_carries_its_seeds():
    interval = Interval(1.0, 0.5, 1.5, 0.25, (0.75, 1.25))
    data = {"mean": 1.0, "std": 0.25, "ci95": [0.5, 1.5], "seeds": [0.75, 1.25]}
    assert to_json(interval) == data
    assert list(to_json(interval)) == list(data)
    assert from_json(Interval, data) == interval


def test_a_missing_key_is_refused():
    with pytest.raises(KeyError, match="from"):
        from_json(Outer, {"name": "a"})
