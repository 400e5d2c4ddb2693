"""Report of the instrument: what the layout shift changes."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from rich.table import Table
from rich.text import Text

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.codec import INLINE, OPTIONAL, key

Measure = Literal[
    "best_length",
    "random_sr",
    "frontier_sr",
    "frontier_steps",
    "start_distance",
    "goal_detected",
    "done_succeeds",
    "layout_gap",
    "layout_similarity",
    "baseline_argmax_sr",
    "baseline_sample_sr",
    "without_argmax_sr",
    "without_sample_sr",
    "without_argmax_wrong",
    "without_sample_wrong",
]
#: Rows of the table: name and decimals.
MEASURES: Mapping[Measure, tuple[str, int]] = {
    "best_length": ("Shortest path L* (actions)", 2),
    "random_sr": ("Random SR (%)", 2),
    "frontier_sr": ("Frontier search SR (%)", 1),
    "frontier_steps": ("Frontier search, actions", 1),
    "start_distance": ("Distance to the goal at the start (m)", 2),
    "goal_detected": ("Goal detected where it is in view (%)", 1),
    "done_succeeds": ("Done succeeds where the goal is detected (%)", 1),
    "layout_gap": ("Layout gap to the prior, KL (nats)", 3),
    "layout_similarity": ("Layout similarity to the prior, cosine", 3),
    "baseline_argmax_sr": ("Baseline SR, argmax (%)", 1),
    "baseline_sample_sr": ("Baseline SR, sampled (%)", 1),
    "without_argmax_sr": ("SR without experience, argmax (%)", 1),
    "without_sample_sr": ("SR without experience, sampled (%)", 1),
    "without_argmax_wrong": ("Wrong Done without experience, argmax (%)", 1),
    "without_sample_wrong": ("Wrong Done without experience, sampled (%)", 1),
}
#: Measures of difficulty, which the shift must not change.
MATCHED: tuple[Measure, ...] = ("best_length", "random_sr", "frontier_sr", "start_distance")
#: Measures that the shift must not change in any category, though they may differ between categories.
BY_CATEGORY: tuple[Measure, ...] = ("goal_detected", "done_succeeds")
BASELINES: tuple[Measure, ...] = ("baseline_argmax_sr", "baseline_sample_sr")
#: Measures of agents that cannot know any layout, and so must not be misled.
WITHOUT: tuple[Measure, ...] = (
    "without_argmax_sr",
    "without_sample_sr",
    "without_argmax_wrong",
    "without_sample_wrong",
)
#: Difficulty is matched where it changes by at most so many percent, in the mean over categories by at most so many
#: points; the baseline must lose at least so many points, agents without experience fewer than so many.
TOLERANCE, LOSS, LEAST_LOSS = 5.0, 8.0, 2.0


@dataclasses.dataclass(frozen=True)
class MeasuredShift:
    """Hold the measures of the instrument at one shift."""

    shift: float
    scenes: int
    episodes: int
    measures: Mapping[Measure, Interval] = dataclasses.field(metadata=INLINE)


@dataclasses.dataclass(frozen=True)
class Change:
    """Hold the change of a measure between two shifts.

    Attributes:
      measure: what changes.
      start, end: the shifts.
      change: its size.
      holds: whether it is as an instrument needs it.
    """

    measure: Measure
    start: float = dataclasses.field(metadata=key("from"))
    end: float = dataclasses.field(metadata=key("to"))
    change: Interval = dataclasses.field(metadata=INLINE)
    holds: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class InstrumentReport:
    """Hold what the layout shift changes.

    Attributes:
      run: settings of the run as JSON.
      shifts: measures at each shift.
      matched: changes of difficulty, in percent, from the first shift to each other.
      categories: changes of what is measured by category, in points: means of their sizes over the categories.
      discriminating: losses of the baseline, in points, from the first shift to the last.
      without: losses of agents without experience, in points; a wrong Done more is a loss, too.
    """

    run: Mapping[str, Any] | None = dataclasses.field(default=None, metadata=OPTIONAL)
    shifts: tuple[MeasuredShift, ...]
    matched: tuple[Change, ...]
    categories: tuple[Change, ...] | None = dataclasses.field(default=None, metadata=OPTIONAL)
    discriminating: tuple[Change, ...]
    without: tuple[Change, ...] | None = dataclasses.field(default=None, metadata=OPTIONAL)


def console_table(report: InstrumentReport) -> Table:
    """Return a table with a column for each shift."""
    table = Table("Layout shift", *(f"{column.shift:g}" for column in report.shifts))
    table.add_row("Scenes", *(str(column.scenes) for column in report.shifts))
    table.add_row("Episodes", *(str(column.episodes) for column in report.shifts))
    for title, *cells in table_cells(report):
        table.add_row(*map(Text, (title, *cells)))  # Text: brackets are not markup
    return table


def table_cells(report: InstrumentReport) -> list[tuple[str, ...]]:
    """Return title and intervals of each measure that is there."""
    return [
        (title, *(f"{column.measures[measure]:.{digits}f}" for column in report.shifts))
        for measure, (title, digits) in MEASURES.items()
        if measure in report.shifts[0].measures
    ]


def verdicts(report: InstrumentReport) -> list[str]:
    """Return line by line whether the shift is an instrument."""

    def line(change: Change, what: str) -> str:
        return f"  {'yes' if change.holds else 'NO':3}  {MEASURES[change.measure][0]}, {what}"

    def losses(changes: tuple[Change, ...]) -> list[str]:
        return [line(each, f"shift {each.start:g} to {each.end:g}: {each.change:.1f} points lost") for each in changes]

    lines = [
        f"Difficulty matched (within {TOLERANCE:g} % of shift {report.shifts[0].shift:g})?",
        *(line(each, f"shift {each.end:g}: {each.change:+.1f} %") for each in report.matched),
    ]
    if report.categories is not None:
        lines.append(f"Categories matched (change at most {TOLERANCE:g} points in the mean over categories)?")
        lines += [line(each, f"shift {each.end:g}: {each.change:.1f} points") for each in report.categories]
    lines.append(f"Discriminating (at least {LOSS:g} points lost, the interval clear of 0)?")
    lines += losses(report.discriminating)
    if report.without is not None:
        lines.append(f"No loss without experience (fewer than {LEAST_LOSS:g} points)?")
        lines += losses(report.without)
    return lines
