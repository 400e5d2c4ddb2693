"""Command lines to settings."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from jaxnav.errors import InputError
from jaxnav.runs.overlay import RENAMED, apply_yaml

Config = TypeVar("Config")

_REGISTRY = ConstructorRegistry()


def parse(default: Config, arguments: list[str] | None, prog: str, description: str) -> Config:
    """Return the settings of a command.

    They are `default`, then the file of `--config`, then the other options.

    Raises:
      InputError: bad config file, or an option that has been renamed.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--config", type=Path)
    known, rest = first.parse_known_args(arguments)
    _refuse_renamed(rest)
    return tyro.cli(
        type(default),
        default=apply_yaml(default, known.config) if known.config else default,
        args=rest,
        prog=prog,
        description=f"{description} `--config FILE` lays a YAML file over the defaults; the other options override it.",
        registry=_REGISTRY,
    )


def _refuse_renamed(arguments: Sequence[str]) -> None:
    """Refuse the option of a renamed setting, with the new one."""
    for option in (argument.partition("=")[0] for argument in arguments if argument.startswith("--")):
        setting = option.removeprefix("--").replace("-", "_")
        for old, new in RENAMED.items():
            if f".{setting}".endswith(f".{old}"):
                group, _, name = f"{setting.removesuffix(old)}{new}".rpartition(".")
                raise InputError(f"{option}: unknown option; it is --{group.replace('_', '-')} {name} N now")


@_REGISTRY.primitive_rule
def _mapping(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[dict[str, int]] | None:
    """Make a mapping one option, also where the config file fills it."""
    if info.type != dict[str, int]:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME INT [NAME INT ...]]",
        instance_from_str=_pairs,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda pairs: [word for pair in pairs.items() for word in map(str, pair)],
    )


def _pairs(words: Sequence[str]) -> dict[str, int]:
    if len(words) % 2:
        raise ValueError("give a whole number after each name")
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))
