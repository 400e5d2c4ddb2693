"""The study command: run an experiment, from training to its pages."""

import argparse
import dataclasses
import sys
from pathlib import Path

from rich.console import Console

from jaxnav.cli.console import parse_config, run_command
from jaxnav.errors import InputError
from jaxnav.experiments.config import EXPERIMENTS, ExperimentConfig
from jaxnav.plain_console import escape_control_chars

DESCRIPTION = (
    "Run an experiment: train and measure everything that has no results yet, and write its pages. `jaxnav study NAME` "
    "needs no option, except for account, cde, handover, instrument and mixture, which measure a finished run: give "
    "--run RUN, and --reference RUN with a run of layout-blind agents (--method anonymous). `jaxnav list experiments` "
    "describes the names, and how much each one trains. `jaxnav study NAME --config quick` runs the smaller experiment "
    "NAME_quick, where there is one, and `--config VERSION` any NAME_VERSION. The options change an "
    "experiment; their defaults are shown for the experiment that you give: jaxnav study table2 --help."
)


def main(arguments: list[str] | None = None, prog: str = "jaxnav study") -> int:
    """Run the command and return its exit code."""
    return run_command(_run_study, lambda: parse_study(arguments, prog))


def _run_study(config: ExperimentConfig, console: Console) -> None:
    """Run the experiment, and print the results of its pages; pages about a single run are short and printed whole."""
    from jaxnav.experiments.driver import run_experiment
    from jaxnav.experiments.pages import result_sections

    for page in run_experiment(config, console):
        text = page if config.run is not None else result_sections(page)
        if text:
            print(escape_control_chars(text, keep="\n"))


def parse_study(arguments: list[str] | None, prog: str = "jaxnav study") -> ExperimentConfig:
    """Return the settings of an experiment from the defaults, the named experiment and the options.

    Args:
      arguments: name or file of the experiment, then options; None for those of the process.
      prog: name of the command in its help.

    Raises:
      InputError: an unknown experiment or a bad setting.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words:
        raise InputError(f"give an experiment: {', '.join(EXPERIMENTS)}, or a YAML file")
    words = _select_version(words)
    config = parse_config(ExperimentConfig(), words, prog, DESCRIPTION, _check, EXPERIMENTS, is_positional=True)

    # Pages stay beside other results, so that those of the stored ones are not replaced.
    options = {word.partition("=")[0] for word in words}
    if "--results" in options and "--pages" not in options:
        pages = {str(config.results / Path(document).name): template for document, template in config.pages.items()}
        config = dataclasses.replace(config, pages=pages)
    return config


def _select_version(words: list[str]) -> list[str]:
    """Replace `NAME --config VERSION` by the experiment `NAME_VERSION`.

    Raises:
      InputError: there is no such experiment.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config")
    namespace, other_words = parser.parse_known_args(words)
    if namespace.config is None or not other_words or other_words[0].startswith("-"):
        return words

    # Any packaged experiment NAME_... counts as another version of NAME.
    experiment, *options = other_words
    name = f"{experiment}_{namespace.config}"
    if name not in EXPERIMENTS:
        versions = [other.removeprefix(f"{experiment}_") for other in EXPERIMENTS if other.startswith(f"{experiment}_")]
        mend = f"choose from {', '.join(versions)}" if versions else f"{experiment} has no other version; omit --config"
        raise InputError(f"--config {namespace.config}: is unknown; {mend}")
    return [name, *options]


def _check(config: ExperimentConfig) -> ExperimentConfig:
    """Check the settings, and fill in those that follow from others."""
    from jaxnav.experiments.driver import check_measurements

    return check_measurements(config)
