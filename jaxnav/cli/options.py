"""Command lines to settings."""

import argparse
import dataclasses
import typing
from collections.abc import Callable, Sequence
from typing import Annotated, Any, TypeVar

import tyro
import yaml
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from jaxnav.cli.console import command_line
from jaxnav.errors import InputError
from jaxnav.runs.overlay import CONFIGS, RENAMED, apply_yaml, from_text

Config = TypeVar("Config")

_REGISTRY = ConstructorRegistry()

_CONFIG = tyro.conf.arg(
    metavar="NAME|FILE.yaml",
    help=f"settings to lay over the defaults: a packaged configuration ({', '.join(CONFIGS)}) or a YAML file; "
    "the other options override them.",
)


def parse(
    default: Config,
    arguments: list[str] | None,
    prog: str,
    description: str,
    check: Callable[[Config], Config] = lambda config: config,
) -> Config:
    """Return the settings of a command.

    They are `default`, then the configuration of `--config`, then the other options, checked by `check`.

    Raises:
      InputError: bad configuration, or an option that has been renamed; names the configuration.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    first = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    first.add_argument("--config")
    known, rest = first.parse_known_args(arguments)
    _refuse_renamed(rest)
    if known.config is not None:
        default = apply_yaml(default, known.config)
    config = parse_options(type(default), rest, prog, description, default)
    try:
        return check(config)
    except InputError as error:
        raise InputError(f"{known.config}: {error}" if known.config else str(error)) from error


def parse_options(
    kind: type[Config], arguments: list[str] | None, prog: str, description: str, default: Config | None = None
) -> Config:
    """Parse the options of a command, with `--config` in its help.

    Args:
      kind: dataclass of the settings; what has no default is positional.
      arguments: the options, without `--config`; None for those of the process.
      prog: the command, as the help names it.
      description: of the command, for its help.
      default: the settings without any option; None for those of the dataclass.
    """
    config = ("config", Annotated[str | None, _CONFIG], None)
    settings = ("settings", Annotated[kind, tyro.conf.arg(name="")])
    fields = [settings, config] if default is None else [config, (*settings, default)]
    options = dataclasses.make_dataclass("Options", fields)
    positional = (tyro.conf.PositionalRequiredArgs,)
    return command_line(options, arguments, prog, description, registry=_REGISTRY, config=positional).settings


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


@_REGISTRY.primitive_rule
def _nested(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[dict[str, Any]] | None:
    """Make any other mapping one option, whose value is YAML."""
    if typing.get_origin(info.type) is not dict or info.type == dict[str, int]:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="YAML",
        instance_from_str=lambda words: from_text(words[0], info.type),
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [
            yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6).strip()
        ],
    )


def _pairs(words: Sequence[str]) -> dict[str, int]:
    if len(words) % 2:
        raise ValueError("give a whole number after each name")
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))
