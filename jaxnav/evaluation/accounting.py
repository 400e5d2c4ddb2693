"""The accounting of experience: what it is worth, what it costs, and what a removal leaves of either.

The lead of an agent is its result minus that of an agent which cannot know any layout, on the same episodes. Where the
layout holds the lead is the value of experience; where it is shifted, a negative lead is the cost.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.statistics import Clusters, Interval, jackknife, paired_difference, training_runs


class Entry(NamedTuple):
    """Hold the lead of a row of an evaluation, in a metric.

    Attributes:
      variant: the row, as tables name it.
      decoding: how actions are taken.
      metric: `sr`, `spl` or `sr@N`.
      lead: over the agent without experience, in percentage points.
      left: share of the lead without removal that is left with it, in percent; None for rows that remove nothing. Of a
        value it is what is kept; 100 less it is what is recovered of a cost.
    """

    variant: str
    decoding: Decoding
    metric: str
    lead: Interval
    left: Interval | None

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        left = None if self.left is None else self.left.to_json()
        return self._asdict() | {"lead": self.lead.to_json(), "left": left}


def share_left(without: np.ndarray, agent: np.ndarray, removed: np.ndarray, scenes: Clusters) -> Interval:
    """Return the share of a lead that removal leaves.

    It is (removed - without) / (agent - without), of means over the same episodes.

    Args:
      without: bool, int or float [S, E], results of the agent without experience.
      agent: [S, E], of the agent with experience; trained apart.
      removed: [S, E], of the same policies as `agent`, with removal.
      scenes: of the E episodes.

    Returns:
      In percent, with its interval; NaN where the interval of the lead holds 0, for nothing is then to be divided.
    """
    lead = paired_difference(without, agent, scenes)
    if not lead.bounded or lead.low <= 0.0 <= lead.high:
        return Interval(float("nan"))
    runs = training_runs(2, len(agent))

    def replicates(results: np.ndarray) -> np.ndarray:
        signed = np.concatenate([-np.asarray(without, np.float64), np.asarray(results, np.float64)])
        return runs.weights.T @ signed @ scenes.weights

    return jackknife(100.0 * replicates(removed) / replicates(agent), scenes, runs)


def accounting_table(entries: Sequence[Entry]) -> Table:
    """Make the table of leads for a terminal.

    A line for every row of the evaluation, `mean [95 % interval]`.
    """
    metrics = list(dict.fromkeys(entry.metric for entry in entries))
    table = Table("Variant", "decoding", *(_title(metric) for metric in metrics), "left of SR (%)")
    lines: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        lines.setdefault((entry.variant, entry.decoding), []).append(entry)
    for names, group in lines.items():
        left = next(entry.left for entry in group if entry.metric == "sr")
        table.add_row(*map(Text, (*names, *(f"{e.lead:+.1f}" for e in group), "" if left is None else f"{left:.0f}")))
    return table


def _title(metric: str) -> str:
    name, _, budget = metric.partition("@")
    return f"{name.upper()} within {budget}" if budget else name.upper()
