"""The report of a run."""

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.report.gather import Options, measure
from jaxnav.report.page import render
from jaxnav.report.sections import make_sections
from jaxnav.runs.directory import Run


def make_report(run: Run, beside: Run | None, options: Options, console: Console) -> str:
    """Measure a run and return its page as HTML.

    Args:
      run: a finished run.
      beside: a finished run of agents that cannot know any layout, in the same world; None for none.
      options: what to measure.
      console: tells of progress.

    Raises:
      InputError: no finished run, an impossible option, or runs that cannot be compared.
    """
    _check(run, beside, options)
    by_shift = {shift: measure(run, beside, shift, options, console) for shift in dict.fromkeys(options.shift)}
    report = next(iter(by_shift.values())).results.report
    about, first = report["run"], report["rows"][0]
    facts = {
        "Run": run.config.run_dir.name,
        "Method": run.config.method,
        "Decision": run.config.decision,
        "World": f"{first['world']}, {options.split}",
        "Training runs": f"{run.config.seeds} of each arm",
        "Steps": f"{about['steps_per_policy']:,} a policy",
        "Episodes": f"{first['episodes']:,} at each shift",
        "Made with": ", ".join(f"{name} {report['versions'][name]}" for name in ("jaxnav", "jax")),
    }
    title = f"{run.config.method.upper()} in {first['world']}"
    sections = make_sections(run, by_shift, options.threshold)
    return render(title, facts, sections, [each.replays for each in by_shift.values()])


def _check(run: Run, beside: Run | None, options: Options) -> None:
    """Refuse in a second what would fail after minutes."""
    if not options.shift:
        raise InputError("--shift: give at least one number")
    if options.replays < len(options.shift):
        raise InputError(f"--replays {options.replays}: give at least {len(options.shift)}, one for each shift")
    run.policies()
    if beside is not None:
        beside.policies()
        if beside.config.task != run.config.task:
            raise InputError("--beside: has another task or detector than the run; train both with equal settings")
