"""What the layout shift changes, from measures scene by scene."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.study.design import Design
from jaxnav.study.instrument_report import (
    BASELINES,
    LOSS,
    MATCHED,
    MEASURES,
    TOLERANCE,
    Change,
    InstrumentReport,
    Measure,
    MeasuredShift,
)


class Totals(NamedTuple):
    """Hold what is measured in N scenes at one shift.

    Attributes:
      values: float64 [S, N], sums over the scene's episodes by seed; S = 1 where there are no seeds.
      weights: float64 [N], numbers of episodes; a mean is sum of values / sum of weights.
      rooms: [N] room types.
      names: [N] of the scenes.
    """

    values: Mapping[Measure, np.ndarray]
    weights: Mapping[Measure, np.ndarray]
    rooms: tuple[str, ...]
    names: tuple[str, ...]


def compare(shifts: Sequence[float], totals: Sequence[Totals]) -> InstrumentReport:
    """Compare all shifts with the first.

    Args:
      shifts: layout shifts, rising.
      totals: measures at each; all share training runs, and scenes of equal floor plan.

    Raises:
      InputError: a measure of difficulty is 0 at the first shift.
    """
    design = Design.of([(each.names, each.rooms) for each in totals], len(totals[0].values[BASELINES[0]]))
    means = {
        measure: [
            design.means(each.values[measure], each.weights[measure], each.names, trained=measure in BASELINES)
            for each in totals
        ]
        for measure in MEASURES
    }
    table = tuple(
        MeasuredShift(
            shift=shift,
            scenes=len(at_shift.names),
            episodes=int(at_shift.weights["frontier_sr"].sum()),
            measures={measure: design.interval(means[measure][i]) for measure in MEASURES},
        )
        for i, (shift, at_shift) in enumerate(zip(shifts, totals, strict=True))
    )
    matched = tuple(change for measure in MATCHED for change in _changes(measure, shifts, means[measure], design))
    losses = []
    for measure in BASELINES:
        loss = design.interval(means[measure][0] - means[measure][-1])
        losses.append(Change(measure, shifts[0], shifts[-1], loss, holds=loss.mean >= LOSS and loss.low > 0))
    return InstrumentReport(shifts=table, matched=matched, discriminating=tuple(losses))


def _changes(measure: Measure, shifts: Sequence[float], means: Sequence[np.ndarray], design: Design) -> list[Change]:
    """Return the changes in percent from the first shift."""
    first, *others = means
    if not first.flat[0]:
        raise InputError(f"{measure} is 0 at shift {shifts[0]:g}: nothing to compare with; give more --episodes")
    changes = []
    for shift, mean in zip(shifts[1:], others, strict=True):
        change = design.interval(100.0 * (mean - first) / first)
        changes.append(Change(measure, shifts[0], shift, change, holds=abs(change.mean) <= TOLERANCE))
    return changes
