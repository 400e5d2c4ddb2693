"""Curves by step, and the course of the layout gap."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.codec import INLINE

#: Whether a belief is updated by what is seen (eq. 4), or left at the prior.
Belief = Literal["updated", "frozen"]


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """Hold a statistic by step with its 95 % interval.

    Attributes:
      mean, low, high: float64 [..., T]; NaN where it is undefined.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, intervals: Sequence[Interval]) -> "Curve":
        """Return the curve of one interval for each step."""
        return cls(*np.array([(each.mean, each.low, each.high) for each in intervals], np.float64).T)

    def line(self, *index: int) -> "Curve":
        """Return one of several curves, leaves [T]."""
        return Curve(self.mean[index], self.low[index], self.high[index])

    def at(self, step: int) -> Interval:
        """Return the interval of one step, of leaves [T]."""
        return Interval(float(self.mean[step]), float(self.low[step]), float(self.high[step]))


@dataclasses.dataclass(frozen=True)
class GapLine:
    """Hold the mean gap at one shift."""

    shift: float
    belief: Belief
    curve: Curve = dataclasses.field(metadata=INLINE)


@dataclasses.dataclass(frozen=True)
class GapPanel:
    """Hold the mean gap of one layout setting."""

    setting: str
    lines: tuple[GapLine, ...]


@dataclasses.dataclass(frozen=True)
class AucLine:
    """Hold the AUC of the gap of one layout setting."""

    setting: str
    curve: Curve = dataclasses.field(metadata=INLINE)


@dataclasses.dataclass(frozen=True)
class AucPanel:
    """Hold the AUC of the gap against the first shift."""

    shift: float
    lines: tuple[AucLine, ...]

    def curve(self, setting: str) -> Curve:
        """Return the curve of a layout setting."""
        return next(line.curve for line in self.lines if line.setting == setting)


@dataclasses.dataclass(frozen=True, eq=False)
class GapCourse:
    """Hold the layout gap D step by step.

    Attributes:
      steps: [T].
      running: float64 [shifts, T], share of the episodes that still run.
      panels: mean gap (Fig. 6b), one for each layout setting.
      auc: one for each shift but the first.
    """

    steps: tuple[int, ...]
    running: np.ndarray
    panels: tuple[GapPanel, ...]
    auc: tuple[AucPanel, ...]

    def gap(self, setting: str, shift: float, belief: Belief) -> Curve:
        """Return the mean gap of a layout setting."""
        lines = next(panel.lines for panel in self.panels if panel.setting == setting)
        return next(line.curve for line in lines if (line.shift, line.belief) == (shift, belief))

    def at_shifts(self, *shifts: float) -> "GapCourse":
        """Return the course with the panels' lines at some shifts."""
        panels = (
            GapPanel(panel.setting, tuple(line for line in panel.lines if line.shift in shifts))
            for panel in self.panels
        )
        return dataclasses.replace(self, panels=tuple(panels))
