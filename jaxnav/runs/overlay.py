"""A YAML file laid over a tree of frozen config dataclasses."""

import dataclasses
import difflib
import math
import reprlib
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import yaml

from jaxnav.errors import InputError

Config = TypeVar("Config")

#: Configurations that come with jaxnav, by name.
CONFIGS = {path.stem: path for path in sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))}

#: Names of settings that have changed: old to new.
RENAMED = {"sizes.relation_layers": "method_sizes.relation_layers"}


def apply_yaml(default: Config, source: str | Path) -> Config:
    """Return `default` with the values of a configuration.

    Only what the file names changes, and each value is checked against the annotation of its field. Known annotations:
    `bool`, `int`, `float`, `str`, `Path`, `Any`, `Literal`, `X | None`, `tuple`, `dict`, nested dataclasses. Where a
    float is expected, whole numbers and texts such as `3e-4` (text to YAML 1.1) are taken as floats.

    Args:
      default: instance of a frozen dataclass.
      source: name of a packaged configuration, see `CONFIGS`, or a YAML file; an empty one changes nothing.

    Raises:
      InputError: the file is missing or no YAML mapping, has a key twice, an unknown key or a value of another type;
        names file, line or dotted key, and mend.
    """
    path = CONFIGS.get(str(source), Path(source))
    values = _load(path)
    return default if values is None else _overlay(default, values, path, "")


def apply_values(default: Config, values: dict[str, Any], source: Path) -> Config:
    """Return `default` with values that were read from a file.

    Raises:
      InputError: see `apply_yaml`.
    """
    return _overlay(default, values, source, "")


def from_text(text: str, annotation: Any) -> Any:
    """Return the value of an annotated setting in YAML, or raise `ValueError`."""
    try:
        return _convert(yaml.load(text, _Loader), annotation)
    except (_Mismatch, yaml.YAMLError) as error:
        raise ValueError(f"{text!r}: give {_describe(annotation)} in YAML") from error


class _Loader(yaml.SafeLoader):
    """Load YAML safely, and refuse equal keys.

    YAML's safe loader would let the last of them win.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.MarkedYAMLError(problem=f"{key.value} is given twice", problem_mark=key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def _load(path: Path) -> Any:
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such configuration; choose from {', '.join(CONFIGS)}, or give a file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(f"{path}{line}: not valid YAML ({error.problem}); mend the line") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # no text, impossible dates, deep nests
        raise InputError(f"{path}: not valid YAML ({error}); mend the file") from error


def _overlay(default: Any, values: Any, path: Path, prefix: str) -> Any:
    if not isinstance(values, dict):
        where = f"{prefix.rstrip('.')} " if prefix else ""
        raise InputError(f"{path}: {where}holds {_shown(values)}; give a mapping of names to values")
    annotations = typing.get_type_hints(type(default))
    names = [field.name for field in dataclasses.fields(default)]
    changes = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        if renamed := [new for old, new in RENAMED.items() if f".{key}".endswith(f".{old}")]:
            raise InputError(f"{path}: unknown key {key}; it is {renamed[0]} now")
        if name not in names:
            near = difflib.get_close_matches(str(name), names, n=1)
            mend = f"did you mean {prefix}{near[0]}?" if near else f"known here are {', '.join(names)}"
            raise InputError(f"{path}: unknown key {key}; {mend}")
        if dataclasses.is_dataclass(current := getattr(default, name)):
            changes[name] = _overlay(current, value, path, f"{key}.")
            continue
        try:
            changes[name] = _convert(value, annotations[name])
        except _Mismatch as error:
            expected = _describe(annotations[name])
            raise InputError(f"{path}: {key} must be {expected}, but is {_shown(value)}; change the value") from error
    return dataclasses.replace(default, **changes)


class _Mismatch(Exception):
    """Say that the value does not fit the annotation."""


def _convert(value: Any, annotation: Any) -> Any:
    """Convert the value to the annotated type, or raise `_Mismatch`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (Union, types.UnionType):
        for argument in arguments:
            try:
                return _convert(value, argument)
            except _Mismatch:
                continue
    elif origin is Literal:
        # By type too, since True == 1.
        if any(type(value) is type(option) and value == option for option in arguments):
            return value
    elif origin is tuple:
        return _convert_tuple(value, arguments)
    elif origin is dict:
        return _convert_dict(value, arguments)
    elif annotation is float:
        return _convert_float(value)
    elif annotation is Any:
        return value
    elif annotation is Path:
        return Path(_convert(value, str))
    elif annotation in (bool, int, str, types.NoneType):
        if type(value) is annotation:
            return value
    else:
        raise TypeError(f"config fields of type {annotation!r} cannot be read from YAML")
    raise _Mismatch


def _convert_tuple(value: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _Mismatch
    if arguments[1:] == (Ellipsis,):
        arguments = arguments[:1] * len(value)
    if len(value) != len(arguments):
        raise _Mismatch
    return tuple(_convert(item, argument) for item, argument in zip(value, arguments, strict=True))


def _convert_dict(value: Any, arguments: tuple[Any, ...]) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise _Mismatch
    return {_convert(key, arguments[0]): _convert(item, arguments[1]) for key, item in value.items()}


def _convert_float(value: Any) -> float:
    if type(value) not in (int, float, str):
        raise _Mismatch
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise _Mismatch from None
    if math.isnan(number):
        raise _Mismatch
    return number


def _describe(annotation: Any) -> str:
    """Describe an annotation: `float or null`, `one of 'a', 'b'`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(map(_describe, arguments))
    if origin is Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if origin is tuple and arguments[1:] == (Ellipsis,):
        return f"a list of {_describe(arguments[0])}"
    if origin is tuple:
        return f"a list [{', '.join(map(_describe, arguments))}]"
    if origin is dict:
        return f"a mapping of {_describe(arguments[0])} to {_describe(arguments[1])}"
    named: dict[Any, str] = {Path: "a path", Any: "anything", types.NoneType: "null"}
    return named.get(annotation) or annotation.__name__


def _shown(value: Any) -> str:
    return "null" if value is None else f"{reprlib.repr(value)} ({type(value).__name__})"
