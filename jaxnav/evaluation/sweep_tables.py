"""Tables of a sweep: the metrics of sTDE at every threshold, and their differences to no removal.

`threshold_rows` computes the rows of one layout shift, `sweep_table` and `sweep_markdown` print them in a terminal and
in Markdown, and `sweep_notes` states what the columns and the intervals mean.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.report import METRIC_COLUMNS, to_report_units
from jaxnav.evaluation.statistics import MIN_SCENE_DEGREES, Interval, mean_interval, paired_difference

#: Metrics that are printed; files hold all metrics of `METRIC_COLUMNS`.
_PRINTED_METRICS = ("sr", "spl")


class ThresholdRow(NamedTuple):
    """Metrics at one threshold of sTDE and one layout shift.

    SR and SPL are in percent, their changes in percentage points, DTS is in metres.

    Attributes:
      shift: layout shift of the scenes.
      epsilon: threshold of sTDE; None for no removal.
      removed: mean weight of the removal in percent, averaged over the decisions of each episode, then over episodes.
      metrics: `sr`, `spl` and `dts`.
      changes: differences of the metrics to no removal, paired on episodes and seeds.
    """

    shift: float
    epsilon: float | None
    removed: float
    metrics: dict[str, Interval]
    changes: dict[str, Interval]

    def to_json(self) -> dict[str, Any]:
        """Convert to JSON."""
        row_data: dict[str, Any] = {"shift": self.shift, "epsilon": self.epsilon, "removed": self.removed}
        for name, interval in self.metrics.items():
            row_data[name] = interval.to_json()
        for name, interval in self.changes.items():
            row_data[f"{name}_change"] = interval.to_json()
        return row_data


def threshold_rows(
    epsilon: np.ndarray,
    metrics: Mapping[str, np.ndarray],
    reference_metrics: Mapping[str, np.ndarray],
    removal_weight: np.ndarray,
    episodes: EpisodeList,
    shift: float,
) -> list[ThresholdRow]:
    """Compute the rows of one layout shift, with one more row for no removal unless some epsilon is 1 or more.

    Intervals generalize to other training seeds and scenes; those of a single seed to other scenes only.

    Args:
      epsilon: float [X], thresholds.
      metrics: `sr`, `spl` and `dts`, each float [X, S, E].
      reference_metrics: the same metrics without removal, each float [S, E].
      removal_weight: float [X, S, E], mean weight of the removed logits in each episode.
      episodes: the E episodes.
      shift: layout shift of the scenes.
    """
    clusters = episodes.clusters()

    def make_row(threshold: float | None, row_metrics: Mapping[str, np.ndarray], weight: np.ndarray) -> ThresholdRow:
        # A single seed has no spread between seeds, so its interval covers the scenes alone.
        intervals = {}
        changes = {}
        for name in METRIC_COLUMNS:
            values = to_report_units(name, row_metrics[name])
            reference_values = to_report_units(name, reference_metrics[name])
            has_seeds = len(values) > 1
            intervals[name] = mean_interval(values, clusters, trained=has_seeds)
            changes[name] = paired_difference(reference_values, values, clusters, same_runs=True, trained=has_seeds)
        return ThresholdRow(shift, threshold, 100.0 * float(np.mean(weight)), intervals, changes)

    rows = []
    for index, threshold in enumerate(epsilon.tolist()):
        row_metrics = {name: values[index] for name, values in metrics.items()}
        rows.append(make_row(threshold, row_metrics, removal_weight[index]))
    if epsilon.max() < 1.0:
        rows.append(make_row(None, reference_metrics, np.zeros(())))
    return rows


def sweep_notes(num_seeds: int, episodes: EpisodeList) -> list[str]:
    """State what the intervals and columns of a sweep mean, one sentence or two per note.

    The first sentence of the first note states what the intervals cover.
    """
    # Floor plans are the units of the interval over scenes.
    num_plans = len(set(episodes.floor_plans))
    if episodes.clusters().degrees_of_freedom < MIN_SCENE_DEGREES:
        interval_note = f"No intervals: {num_plans} floor plans are too few. An interval needs at least three."
    elif num_seeds == 1:
        interval_note = (
            f"95 % intervals over {num_plans} floor plans. They hold for this policy alone: sweep a run with several "
            "seeds to cover other trainings too."
        )
    else:
        interval_note = f"95 % intervals over {num_seeds} training seeds and {num_plans} floor plans."
    return [
        interval_note,
        "Removed: mean weight s of the removal (eq. 2), averaged within each episode, then over episodes.",
        "Change: difference to no removal in percentage points, paired on episodes and seeds.",
    ]


def sweep_table(rows: Sequence[ThresholdRow]) -> Table:
    """Make the table of SR, SPL and their changes for a terminal, with a section for each layout shift."""
    table = Table("Threshold")
    for title in _number_titles():
        table.add_column(title, justify="right")
    for shift, shift_rows in _rows_by_shift(rows).items():
        table.add_section()
        table.add_row(f"shift {shift:g}", style="bold")
        for row in shift_rows:
            table.add_row(_threshold_text(row), *_number_cells(row))
    return table


def sweep_markdown(rows: Sequence[ThresholdRow], notes: Sequence[str]) -> str:
    """Make one table of all columns in Markdown, with the notes below, ending with a newline."""
    titles = ["Shift", "Threshold", *_number_titles()]
    table_lines = [titles, ["---:"] * len(titles)]
    for row in rows:
        table_lines.append([f"{row.shift:g}", _threshold_text(row), *_number_cells(row)])

    text_parts = []
    for cells in table_lines:
        text_parts.append(f"| {' | '.join(cells)} |\n")
    for note in notes:
        text_parts.append(f"\n{note}\n")
    return "".join(text_parts)


def _rows_by_shift(rows: Sequence[ThresholdRow]) -> dict[float, list[ThresholdRow]]:
    """Group rows by their layout shift, in order."""
    shift_rows: dict[float, list[ThresholdRow]] = {}
    for row in rows:
        shift_rows.setdefault(row.shift, []).append(row)
    return shift_rows


def _threshold_text(row: ThresholdRow) -> str:
    return "no removal" if row.epsilon is None else f"{row.epsilon:g}"


def _number_titles() -> list[str]:
    """Titles of all columns with numbers."""
    titles = [METRIC_COLUMNS[name][0] for name in _PRINTED_METRICS]
    change_titles = [f"Change in {name.upper()}" for name in _PRINTED_METRICS]
    return [*titles, "Removed (%)", *change_titles]


def _number_cells(row: ThresholdRow) -> list[str]:
    """Cells of all columns with numbers."""
    metric_cells = []
    change_cells = []
    for name in _PRINTED_METRICS:
        digits = METRIC_COLUMNS[name][1]
        metric_cells.append(f"{row.metrics[name]:.{digits}f}")
        # A row without removal has no difference to itself.
        change_cells.append("" if row.epsilon is None else f"{row.changes[name]:+.{digits}f}")
    return [*metric_cells, f"{row.removed:.1f}", *change_cells]
