"""Records as JSON: inline, optional and undefined values."""

import dataclasses
import json
from collections.abc import Mapping

import numpy as np
import pytest

from jaxnav.study.codec import INLINE, OPTIONAL, from_json, key, to_json
from jaxnav.study.intervals import UNDEFINED, Estimate, Interval


@dataclasses.dataclass(frozen=True)
class Inner:
    name: str
    size: float | None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Outer:
    start: int = dataclasses.field(metadata=key("from"))
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
    data = {"shift": 0.5, "x": {"mean": 1.0, "ci95": [0.5, 1.5]}, "y": {"mean": 2.0, "ci95": [1.5, 2.5]}}
    assert to_json(measured) == data
    assert from_json(Measured, data) == measured


def test_what_is_undefined_is_null():
    data = {"mean": None, "ci95": [None, None]}
    assert json.loads(json.dumps(to_json(UNDEFINED), allow_nan=False)) == data
    assert not from_json(Interval, data).defined


def test_an_estimate_carries_its_seeds():
    estimate = Estimate(1.0, 0.5, 1.5, 0.25, (0.75, 1.25))
    data = {"mean": 1.0, "std": 0.25, "ci95": [0.5, 1.5], "seeds": [0.75, 1.25]}
    assert to_json(estimate) == data
    assert list(to_json(estimate)) == list(data)
    assert from_json(Estimate, data) == estimate


def test_a_missing_key_is_refused():
    with pytest.raises(KeyError, match="from"):
        from_json(Outer, {"name": "a"})
