"""The report command: tables, curves and replays of a run on one HTML page."""

from rich.console import Console

from jaxnav.cli.console import parse_arguments, refuse_folder, refuse_unwritable, run_command
from jaxnav.report.config import ReportConfig

DESCRIPTION = "Show a training run on one HTML page: tables, curves and replays of episodes."


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(_write_report, lambda: parse_arguments(ReportConfig, arguments, "jaxnav report", DESCRIPTION))


def _write_report(config: ReportConfig, console: Console) -> None:
    """Measure the run and write the page."""
    from jaxnav.viz import require_plotting_packages

    require_plotting_packages()
    from jaxnav.report.make import make_report
    from jaxnav.runs.run import Run
    from jaxnav.store.files import write_atomic

    # Check the options before anything is measured.
    target = config.out or config.run / "report.html"
    refuse_folder(target, "--out")

    run = Run.open(config.run)
    reference_run = None if config.reference is None else Run.open(config.reference)
    page = make_report(run, reference_run, config, console).encode(errors="backslashreplace")
    with refuse_unwritable(target, "--out"):
        write_atomic(target, page)
    console.print(f"{len(page) / 1e6:.1f} MB, written to {target}")
