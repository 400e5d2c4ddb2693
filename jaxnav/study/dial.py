"""What the layout shift changes, from measures scene by scene."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.design import Design
from jaxnav.study.instrument_report import (
    BASELINES,
    BY_CATEGORY,
    LEAST_LOSS,
    LOSS,
    MATCHED,
    TOLERANCE,
    WITHOUT,
    Change,
    InstrumentReport,
    Measure,
    MeasuredShift,
)

TRAINED = BASELINES + WITHOUT


class Totals(NamedTuple):
    """Hold what is measured in N scenes at one shift.

    Attributes:
      values: float64 [S, N], sums over the scene's episodes by seed; S = 1 where there are no seeds.
      weights: float64 [N], numbers of episodes; a mean is sum of values / sum of weights.
      categories: float64 [N, K], means by goal category of what is measured by category; NaN where there is none.
      rooms: [N] room types.
      names: [N] of the scenes.
    """

    values: Mapping[Measure, np.ndarray]
    weights: Mapping[Measure, np.ndarray]
    categories: Mapping[Measure, np.ndarray]
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
    measured = list(totals[0].values)
    means = {
        measure: [
            design.means(each.values[measure], each.weights[measure], each.names, trained=measure in TRAINED)
            for each in totals
        ]
        for measure in measured
    }
    table = tuple(
        MeasuredShift(
            shift=shift,
            scenes=len(at_shift.names),
            episodes=int(at_shift.weights["frontier_sr"].sum()),
            measures={measure: design.interval(means[measure][i]) for measure in measured},
        )
        for i, (shift, at_shift) in enumerate(zip(shifts, totals, strict=True))
    )
    matched = tuple(change for measure in MATCHED for change in _changes(measure, shifts, means[measure], design))
    categories = tuple(change for measure in BY_CATEGORY for change in _by_category(measure, shifts, totals, design))

    def lost(measure: Measure) -> Interval:
        sign = -1.0 if measure.endswith("wrong") else 1.0
        return design.interval(sign * (means[measure][0] - means[measure][-1]))

    losses = {measure: lost(measure) for measure in TRAINED if measure in measured}
    ends = shifts[0], shifts[-1]
    return InstrumentReport(
        shifts=table,
        matched=matched,
        categories=categories,
        discriminating=tuple(
            Change(name, *ends, losses[name], losses[name].mean >= LOSS and losses[name].low > 0) for name in BASELINES
        ),
        without=tuple(Change(name, *ends, losses[name], losses[name].mean < LEAST_LOSS) for name in WITHOUT)
        if WITHOUT[0] in measured
        else None,
    )


def _by_category(measure: Measure, shifts: Sequence[float], totals: Sequence[Totals], design: Design) -> list[Change]:
    """Return the mean size of the changes of the categories.

    A category weighs as many scenes as have it at the first shift. A few scenes with a category change by chance, so
    that the mean is above 0 where nothing changes.
    """
    means, counts = [], ~np.isnan(totals[0].categories[measure])
    for each in totals:
        values = each.categories[measure].T  # [K, N]
        means.append(
            np.stack(
                [
                    design.means(np.nan_to_num(row)[None], 1.0 - np.isnan(row), each.names, trained=False)
                    for row in values
                ]
            )
        )
    first, *others = means
    changes = []
    for shift, mean in zip(shifts[1:], others, strict=True):
        size = np.abs(mean - first)  # [K, 1 + C]
        weight = counts.sum(axis=0)[:, None] * ~np.isnan(size)
        change = design.interval(np.nansum(weight * np.nan_to_num(size), axis=0) / weight.sum(axis=0))
        changes.append(Change(measure, shifts[0], shift, change, holds=change.mean <= TOLERANCE))
    return changes


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
