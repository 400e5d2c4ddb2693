"""Command lines to settings."""

import argparse
from pathlib import Path

import tyro

from jaxnav.cli.config import RunConfig
from jaxnav.cli.overlay import apply_yaml


def parse_run(arguments: list[str]) -> RunConfig:
    """Settings of a training run: defaults, then the file of `--config`, then the other options.

    Raises:
      InputError: bad config file.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--config", type=Path)
    known, rest = first.parse_known_args(arguments)
    default = apply_yaml(RunConfig(), known.config) if known.config else RunConfig()
    return tyro.cli(
        RunConfig,
        default=default,
        args=rest,
        prog="train.py",
        description="Train a method with and without the layout estimator. "
        "`--config FILE` lays a YAML file over the defaults; the other options override it.",
    )
