"""Command lines to settings."""

import argparse
from pathlib import Path
from typing import TypeVar

import tyro

from jaxnav.runs.overlay import apply_yaml

Config = TypeVar("Config")


def parse(default: Config, arguments: list[str] | None, prog: str, description: str) -> Config:
    """Parse the settings of a command.

    `default`, then the file of `--config`, then the other options.

    Raises:
      InputError: bad config file.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--config", type=Path)
    known, rest = first.parse_known_args(arguments)
    return tyro.cli(
        type(default),
        default=apply_yaml(default, known.config) if known.config else default,
        args=rest,
        prog=prog,
        description=f"{description} `--config FILE` lays a YAML file over the defaults; the other options override it.",
    )
