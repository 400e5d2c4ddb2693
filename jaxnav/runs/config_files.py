"""Configurations in YAML files, applied to frozen dataclasses.

`apply_yaml` replaces the values that a file names in a tree of dataclasses, and checks each value against the
annotation of its field. `apply_values` does the same for values that were read from elsewhere, and `parse_setting`
reads one value from the command line.
"""

import dataclasses
import difflib
import math
import re
import reprlib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import yaml

from jaxnav.errors import InputError
from jaxnav.store.files import expand_home

Config = TypeVar("Config", bound=Any)

#: Configurations that come with jaxnav, by name.
CONFIGS = {path.stem: path for path in sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))}

#: Settings that were renamed: old name to new name.
RENAMED_SETTINGS = {
    "sizes.relation_layers": "method_sizes.relation_layers",
    "unaware": "reference",
    "without": "reference",
}

#: Numbers that YAML 1.1 does not read as decimal ones: 010 is 8 there, and 1:30 is 90.
_AMBIGUOUS_NUMBER = re.compile(r"[-+]?(0[0-9_]+|[0-9_]+(:[0-9_]+)+(\.[0-9_]*)?)")


def apply_yaml(default: Config, source: str | Path, configs: Mapping[str, Path] = CONFIGS) -> Config:
    """Apply a YAML configuration to a dataclass.

    Only fields that the file names change, and each value is checked against the annotation of its field. Supported
    annotations are `bool`, `int`, `float`, `str`, `Path`, `Any`, `Literal`, `X | None`, `tuple`, `dict` and nested
    dataclasses. A float field also accepts whole numbers, and text such as `3e-4` (which is text in YAML 1.1). Numbers
    that YAML 1.1 reads as octal or in base 60 are refused, and so are those beyond the range of floats.

    A file with the key `extends` changes the configuration that it names, instead of `default`.

    Args:
      default: instance of a frozen dataclass.
      source: name of a packaged configuration, or a YAML file; an empty file changes nothing.
      configs: packaged configurations by name.

    Returns:
      A copy of `default` with the values of the file.

    Raises:
      InputError: the file is missing or is no YAML mapping, has a key twice, an unknown key or a value of another type.
        The message names the file, the line or dotted key, and a remedy.
    """
    return _apply_file(default, configs.get(str(source)) or expand_home(source), configs, extended_by=())


def _apply_file(default: Config, path: Path, configs: Mapping[str, Path], extended_by: tuple[Path, ...]) -> Config:
    """Apply a file, after the configuration that it extends; `extended_by` are the resolved paths of its successors."""
    if path.resolve() in extended_by:
        raise InputError(f"{path}: extends itself; name another configuration in extends")
    values = _load_yaml(path, configs)
    if isinstance(values, dict) and "extends" in values:
        # The extended configuration comes first, so that the values of this file replace its own.
        source = values.pop("extends")
        if not isinstance(source, str) or not source:
            value_text = _describe_value(source)
            raise InputError(f"{path}: extends must be a name or a file, but is {value_text}; change the value")
        extended_path = configs.get(source) or path.parent / expand_home(source)
        if not extended_path.exists():
            raise InputError(f"{path}: extends {source}, which does not exist; give {', '.join(configs)} or a file")
        default = _apply_file(default, extended_path, configs, (*extended_by, path.resolve()))
    return default if values is None else apply_values(default, values, path)


def parse_setting(text: str, annotation: Any) -> Any:
    """Parse the YAML text of one setting, or raise `ValueError` where it does not fit the annotation."""
    try:
        return _convert(yaml.load(text, _UniqueKeyLoader), annotation)
    except (_MismatchError, yaml.YAMLError) as error:
        raise ValueError(f"{text!r}: give {_describe_type(annotation)} in YAML") from error


class _UniqueKeyLoader(yaml.SafeLoader):
    """Safe YAML loader that refuses repeated keys, of which `SafeLoader` would silently use the last.

    Numbers that are not decimal to every reader (`_AMBIGUOUS_NUMBER`), or beyond the range of floats, stay text, so
    that errors can quote them.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        mapping_keys = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            if key_node.value in mapping_keys:
                problem = f"{key_node.value} is given twice"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
            mapping_keys.add(key_node.value)
        return super().construct_mapping(node, deep)

    def construct_decimal_int(self, node: yaml.ScalarNode) -> int | str:
        text = self.construct_scalar(node)
        return text if _is_ambiguous(text) else self.construct_yaml_int(node)

    def construct_finite_float(self, node: yaml.ScalarNode) -> float | str:
        text = self.construct_scalar(node)
        return text if _is_ambiguous(text) or _is_too_large(text) else self.construct_yaml_float(node)


_UniqueKeyLoader.add_constructor("tag:yaml.org,2002:int", _UniqueKeyLoader.construct_decimal_int)
_UniqueKeyLoader.add_constructor("tag:yaml.org,2002:float", _UniqueKeyLoader.construct_finite_float)


def _load_yaml(path: Path, configs: Mapping[str, Path]) -> Any:
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _UniqueKeyLoader)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such configuration; give {', '.join(configs)} or a file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except yaml.MarkedYAMLError as error:
        line_note = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(f"{path}{line_note}: not valid YAML ({error.problem}); fix the line") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # no text, impossible dates, deep nesting
        raise InputError(f"{path}: not valid YAML ({error}); fix the file") from error


def apply_values(default: Config, values: Any, path: Path, prefix: str = "") -> Config:
    """Apply values that were read from a file to a dataclass; see `apply_yaml`.

    Args:
      default: instance of a frozen dataclass.
      values: mapping of names to values.
      path: file that the values come from, for messages.
      prefix: dotted key of the dataclass in the file, with a final dot.

    Raises:
      InputError: see `apply_yaml`.
    """
    if not isinstance(values, dict):
        mapping_name = f"{prefix.rstrip('.')} " if prefix else ""
        raise InputError(f"{path}: {mapping_name}holds {_describe_value(values)}; give a mapping of names to values")

    field_types = typing.get_type_hints(type(default))
    field_names = [config_field.name for config_field in dataclasses.fields(default)]
    changed_fields = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        _check_key(name, key, field_names, path, prefix)

        # Nested dataclasses are changed field by field.
        current_value = getattr(default, name)
        if dataclasses.is_dataclass(current_value):
            changed_fields[name] = apply_values(current_value, value, path, f"{key}.")
            continue
        try:
            changed_fields[name] = _convert(value, field_types[name])
        except _MismatchError as error:
            expected_type = _describe_type(field_types[name])
            raise InputError(
                f"{path}: {key} must be {expected_type}, but is {_describe_value(value)}; change the value"
            ) from error
        except InputError as error:
            raise InputError(f"{path}: {key}: {error}") from error
    return dataclasses.replace(default, **changed_fields)


def _check_key(name: Any, key: str, field_names: list[str], path: Path, prefix: str) -> None:
    """Refuse a key that is no field, and name the most likely one."""
    for old_name, new_name in RENAMED_SETTINGS.items():
        if f".{key}".endswith(f".{old_name}"):
            raise InputError(f"{path}: key {key} was renamed; use {new_name}")
    # A key that was never known is probably a slip.
    if name not in field_names:
        close_names = difflib.get_close_matches(str(name), field_names, n=1)
        if close_names:
            advice = f"did you mean {prefix}{close_names[0]}?"
        else:
            advice = f"known here are {', '.join(field_names)}"
        raise InputError(f"{path}: unknown key {key}; {advice}")


class _MismatchError(Exception):
    """Error for a value that does not fit its annotation."""


def _convert(value: Any, annotation: Any) -> Any:
    """Convert a value to the annotated type, or raise `_MismatchError`."""
    type_origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if type_origin in (Union, types.UnionType):
        for argument_type in arguments:
            try:
                return _convert(value, argument_type)
            except _MismatchError:
                continue
    elif type_origin is Literal:
        # The types must agree too, because True == 1.
        if any(type(value) is type(literal_option) and value == literal_option for literal_option in arguments):
            return value
    elif type_origin is tuple:
        return _convert_tuple(value, arguments)
    elif type_origin is dict:
        return _convert_dict(value, arguments)
    elif annotation is float:
        return _convert_float(value)
    elif annotation is Any:
        return value
    elif annotation is Path:
        return expand_home(_convert(value, str))
    elif annotation in (bool, int, str, types.NoneType):
        if type(value) is annotation:
            return value
    else:
        raise TypeError(f"config fields of type {annotation!r} cannot be read from YAML")
    raise _MismatchError


def _convert_tuple(value: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _MismatchError
    # `tuple[X, ...]` takes lists of any length.
    if arguments[1:] == (Ellipsis,):
        arguments = arguments[:1] * len(value)
    if len(value) != len(arguments):
        raise _MismatchError
    return tuple(_convert(yaml_item, argument_type) for yaml_item, argument_type in zip(value, arguments, strict=True))


def _convert_dict(value: Any, arguments: tuple[Any, ...]) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise _MismatchError
    key_type, item_type = arguments
    return {_convert(key, key_type): _convert(yaml_item, item_type) for key, yaml_item in value.items()}


def _convert_float(value: Any) -> float:
    # YAML reads some notations, such as 1e-3, as text.
    if type(value) not in (int, float, str) or _is_ambiguous(value) or _is_too_large(value):
        raise _MismatchError
    try:
        float_value = float(value)
    except ValueError:
        raise _MismatchError from None
    if math.isnan(float_value):
        raise _MismatchError
    return float_value


def _is_ambiguous(value: Any) -> bool:
    """Return True for the text of a number that YAML 1.1 does not read as decimal."""
    return isinstance(value, str) and _AMBIGUOUS_NUMBER.fullmatch(value) is not None


def _is_too_large(value: Any) -> bool:
    """Return True for a number beyond the range of floats; infinity itself has a name."""
    try:
        return math.isinf(float(value)) and isinstance(value, str) and "inf" not in value.lower()
    except OverflowError:
        return True
    except (TypeError, ValueError):
        return False


def _describe_type(annotation: Any) -> str:
    """Describe an annotation: `float or null`, `one of 'a', 'b'`."""
    type_origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if type_origin in (Union, types.UnionType):
        return " or ".join(map(_describe_type, arguments))
    if type_origin is Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if type_origin is tuple and arguments[1:] == (Ellipsis,):
        return f"a list of {_describe_type(arguments[0])}"
    if type_origin is tuple:
        return f"a list [{', '.join(map(_describe_type, arguments))}]"
    if type_origin is dict:
        return f"a mapping of {_describe_type(arguments[0])} to {_describe_type(arguments[1])}"
    # Other types have their own name, such as `float`.
    type_names: dict[Any, str] = {Path: "a path", Any: "anything", types.NoneType: "null"}
    return type_names.get(annotation) or annotation.__name__


def _describe_value(value: Any) -> str:
    if value is None:
        return "null"
    if _is_ambiguous(value):
        return f"{value}, which YAML 1.1 reads as {yaml.safe_load(value)}"
    if type(value) in (int, str) and _is_too_large(value):
        return f"{reprlib.repr(value)}, which is too large"
    return f"{reprlib.repr(value)} ({type(value).__name__})"
