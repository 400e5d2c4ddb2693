"""The report command: tables, curves and replays of a run on one HTML page."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.runs.run import Run
from jaxnav.store.files import write_atomic
from jaxnav.viz import require_plotting_packages


@dataclasses.dataclass(frozen=True)
class ReportConfig:
    """Configure the report of a training run.

    Attributes:
      run: the run directory.
      beside: that of agents which cannot know any layout, for the accounting of experience; trained in the same world,
        with as many seeds, by `--method anonymous`.
      split: scenes to evaluate on.
      shift: layout shifts, from 0 to 1.
      episodes: in the fixed list, at each shift, as of `eval`.
      epsilon: thresholds of sTDE in the curves.
      threshold: of sTDE in the tables and the replays.
      replays: episodes that can be replayed, in all; those in which the agents differ first.
      seed: of the episode list and the sampled actions.
      out: where to write the page; default: report.html in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    beside: Path | None = None
    split: Literal["train", "val", "test"] = "val"
    shift: tuple[float, ...] = (0.0, 1.0)
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    threshold: float = 0.5
    replays: int = 60
    seed: int = 0
    out: Path | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    config = parse_arguments(ReportConfig, arguments, "jaxnav report", "Show a training run on one page.")
    return run_command(lambda console: _write_report(config, console))


def _write_report(config: ReportConfig, console: Console) -> None:
    """Measure the run and write the page."""
    require_plotting_packages()
    from jaxnav.report.make import make_report
    from jaxnav.report.measure import ReportOptions

    # Check the options before anything is measured.
    target = config.out or config.run / "report.html"
    if target.is_dir():
        raise InputError(f"--out {target}: is a folder; give the name of a file to write")

    run = Run.open(config.run)
    reference_run = None if config.beside is None else Run.open(config.beside)

    # `ReportOptions` has some of the fields of `ReportConfig`.
    option_names = [field.name for field in dataclasses.fields(ReportOptions)]
    options = ReportOptions(**{name: getattr(config, name) for name in option_names})
    page = make_report(run, reference_run, options, console).encode()

    try:
        write_atomic(target, page)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); give another --out") from error
    console.print(f"{len(page) / 1e6:.1f} MB, written to {target}")
