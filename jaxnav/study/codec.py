"""Frozen dataclasses as JSON.

Keys are the names of the fields. Metadata of a field changes this: `INLINE` puts the keys of its value among those of
the record, `OPTIONAL` leaves out None, and `key("from")` gives another name. An `Interval` has a form of its own.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar, Union

import numpy as np

from jaxnav.evaluation.statistics import Interval

Record = TypeVar("Record")

INLINE = types.MappingProxyType({"inline": True})
OPTIONAL = types.MappingProxyType({"optional": True})


def key(name: str) -> dict[str, str]:
    """Return the metadata that gives a field another key."""
    return {"key": name}


def to_json(value: Any) -> Any:
    """Return a record, or what it holds, as JSON."""
    if isinstance(value, Interval):
        return value.to_json()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _record_to_json(value)
    if isinstance(value, np.ndarray):
        return [to_json(item) for item in value.tolist()]
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, Mapping):
        return {name: to_json(item) for name, item in value.items()}
    return [to_json(item) for item in value] if isinstance(value, list | tuple) else value


def from_json(kind: type[Record], data: Mapping[str, Any]) -> Record:
    """Return the record that JSON holds.

    Other keys are ignored.

    Raises:
      KeyError: a key is missing.
    """
    return _decoded(kind, data)


def _record_to_json(record: Any) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if field.metadata.get("inline"):
            data |= to_json(value)
        elif not (value is None and field.metadata.get("optional")):
            data[_key(field)] = to_json(value)
    return data


def _decoded(kind: Any, value: Any) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if value is None or kind is Any:
        return value
    if origin in (Union, types.UnionType):
        return _decoded(arguments[0], value)  # X | None
    if origin is tuple:
        return tuple(_decoded(arguments[0], item) for item in value)
    if origin is Mapping:
        return {name: _decoded(arguments[1], item) for name, item in value.items()}
    if kind is np.ndarray:
        array = np.asarray(value)
        return array.astype(np.float64) if array.dtype == object else array  # null is NaN
    if kind is Interval:
        return Interval.from_json(value)
    return _record(kind, value) if dataclasses.is_dataclass(kind) else value


def _record(kind: Any, data: Mapping[str, Any]) -> Any:
    fields, hints = dataclasses.fields(kind), _hints(kind)
    rest = {name: item for name, item in data.items() if name not in map(_key, fields)}
    values = {}
    for field in fields:
        if field.metadata.get("inline"):
            values[field.name] = _decoded(hints[field.name], rest)
        elif _key(field) in data or not field.metadata.get("optional"):
            values[field.name] = _decoded(hints[field.name], data[_key(field)])
    return kind(**values)


def _key(field: dataclasses.Field) -> str:
    return field.metadata.get("key", field.name)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)
