"""What the layout shift changes, from measures scene by scene."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.study.bootstrap import stratified_draws
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
from jaxnav.study.intervals import percentile_interval


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


def compare(shifts: Sequence[float], totals: Sequence[Totals], seed: int) -> InstrumentReport:
    """Compare all shifts with the first.

    Intervals are 95 % bootstrap ones. A resample draws scenes within each room type and training seeds; a drawn scene
    is there at all shifts, with its twins, and so is a drawn seed.

    Args:
      shifts: layout shifts, rising.
      totals: measures at each.
      seed: of the resamples.

    Raises:
      InputError: a measure of difficulty is 0 at the first shift.
    """
    means = _means(totals, seed)
    table = tuple(
        MeasuredShift(
            shift=shift,
            scenes=len(at_shift.names),
            episodes=int(at_shift.weights["frontier_sr"].sum()),
            measures={measure: percentile_interval(means[measure][i]) for measure in MEASURES},
        )
        for i, (shift, at_shift) in enumerate(zip(shifts, totals, strict=True))
    )
    matched = tuple(change for measure in MATCHED for change in _changes(measure, shifts, means[measure]))
    losses = []
    for measure in BASELINES:
        loss = percentile_interval(means[measure][0] - means[measure][-1])
        losses.append(Change(measure, shifts[0], shifts[-1], loss, holds=loss.mean >= LOSS and loss.low > 0))
    return InstrumentReport(shifts=table, matched=matched, discriminating=tuple(losses))


def _means(totals: Sequence[Totals], seed: int) -> dict[Measure, list[np.ndarray]]:
    """Return means [1 + R] by measure and shift."""
    names = sorted({name for at_shift in totals for name in at_shift.names})
    rooms = {name: room for at_shift in totals for name, room in zip(at_shift.names, at_shift.rooms, strict=True)}
    seeds = len(totals[0].values[BASELINES[0]])
    generator = np.random.default_rng(seed)
    scene_draws = stratified_draws(np.array([rooms[name] for name in names]), generator)
    seed_draws = stratified_draws(np.zeros(seeds), generator).T / seeds

    def mean(measure: Measure, at_shift: Totals) -> np.ndarray:
        values = at_shift.values[measure]
        scenes = np.ascontiguousarray(scene_draws[np.searchsorted(names, at_shift.names)].T)
        sums = scenes @ values.T
        return (sums * (seed_draws if len(values) > 1 else 1.0)).sum(axis=1) / (scenes @ at_shift.weights[measure])

    return {measure: [mean(measure, at_shift) for at_shift in totals] for measure in MEASURES}


def _changes(measure: Measure, shifts: Sequence[float], means: Sequence[np.ndarray]) -> list[Change]:
    """Return the changes in percent from the first shift."""
    first, *others = means
    if not first[0]:
        raise InputError(f"{measure} is 0 at shift {shifts[0]:g}: nothing to compare with; give more --episodes")
    changes = []
    for shift, mean in zip(shifts[1:], others, strict=True):
        change = percentile_interval(100.0 * (mean - first) / first[0])
        changes.append(Change(measure, shifts[0], shift, change, holds=abs(change.mean) <= TOLERANCE))
    return changes
