"""The study command: run an experiment, from training to its pages."""

import sys

from rich.console import Console

from jaxnav.cli.console import escape_control_chars, parse_config, run_command
from jaxnav.errors import InputError
from jaxnav.experiments.config import EXPERIMENTS, ExperimentConfig
from jaxnav.experiments.driver import check_measurements, run_experiment

DESCRIPTION = (
    f"Run an experiment: {', '.join(EXPERIMENTS)}, or a YAML file. Trains and measures what is missing, and writes its "
    "pages. The experiments account, mixture, handover and instrument measure a finished run: give --run RUN, and "
    "--reference RUN for a run of layout-blind agents."
)


def main(arguments: list[str] | None = None, prog: str = "jaxnav study") -> int:
    """Run the command and return its exit code."""
    return run_command(lambda console: _run_study(arguments, prog, console))


def _run_study(arguments: list[str] | None, prog: str, console: Console) -> None:
    config = parse_study(arguments, prog)
    pages = run_experiment(config, console)

    # Pages about a single run are short, and printed too.
    if config.run is not None:
        print(escape_control_chars("\n".join(pages), keep="\n"))


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
    if words and not words[0].startswith("-"):
        words = ["--config", *words]
    return parse_config(ExperimentConfig(), words, prog, DESCRIPTION, check_measurements, EXPERIMENTS)
