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
    "layout_gap",
    "layout_similarity",
    "baseline_argmax_sr",
    "baseline_sample_sr",
]
#: Rows of the table: name and decimals.
MEASURES: Mapping[Measure, tuple[str, int]] = {
    "best_length": ("Shortest path L* (actions)", 2),
    "random_sr": ("Random SR (%)", 2),
    "frontier_sr": ("Frontier search SR (%)", 1),
    "frontier_steps": ("Frontier search, actions", 1),
    "layout_gap": ("Layout gap to the prior, KL (nats)", 3),
    "layout_similarity": ("Layout similarity to the prior, cosine", 3),
    "baseline_argmax_sr": ("Baseline SR, argmax (%)", 1),
    "baseline_sample_sr": ("Baseline SR, sampled (%)", 1),
}
#: Measures of difficulty, which the shift must not change.
MATCHED: tuple[Measure, ...] = ("best_length", "random_sr", "frontier_sr")
BASELINES: tuple[Measure, ...] = ("baseline_argmax_sr", "baseline_sample_sr")
#: Difficulty is matched where it changes by at most so many percent; the baseline must lose at least so many points.
TOLERANCE, LOSS = 5.0, 8.0


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
      discriminating: losses of the baseline, in points, from the first shift to the last.
    """

    run: Mapping[str, Any] | None = dataclasses.field(default=None, metadata=OPTIONAL)
    shifts: tuple[MeasuredShift, ...]
    matched: tuple[Change, ...]
    discriminating: tuple[Change, ...]


def console_table(report: InstrumentReport) -> Table:
    """Return a table with a column for each shift."""
    table = Table("Layout shift", *(f"{column.shift:g}" for column in report.shifts))
    table.add_row("Scenes", *(str(column.scenes) for column in report.shifts))
    table.add_row("Episodes", *(str(column.episodes) for column in report.shifts))
    for title, *cells in table_cells(report):
        table.add_row(*map(Text, (title, *cells)))  # Text: brackets are not markup
    return table


def table_cells(report: InstrumentReport) -> list[tuple[str, ...]]:
    """Return title and intervals of each measure."""
    return [
        (title, *(f"{column.measures[measure]:.{digits}f}" for column in report.shifts))
        for measure, (title, digits) in MEASURES.items()
    ]


def verdicts(report: InstrumentReport) -> list[str]:
    """Return line by line whether the shift is an instrument."""

    def line(change: Change, what: str) -> str:
        return f"  {'yes' if change.holds else 'NO':3}  {MEASURES[change.measure][0]}, {what}"

    return [
        f"Difficulty matched (within {TOLERANCE:g} % of shift {report.shifts[0].shift:g})?",
        *(line(each, f"shift {each.end:g}: {each.change:+.1f} %") for each in report.matched),
        f"Discriminating (at least {LOSS:g} points lost, the interval clear of 0)?",
        *(
            line(each, f"shift {each.start:g} to {each.end:g}: {each.change:.1f} points lost")
            for each in report.discriminating
        ),
    ]
