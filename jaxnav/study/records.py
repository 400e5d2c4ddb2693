"""Rows of the tables; success and gain by layout similarity.

SR, SPL, gains and their differences are in percent or percentage points, DTS in metres, unless stated. JSON holds the
same fields, see `codec`.
"""

import dataclasses
from typing import Literal

import numpy as np

from jaxnav.causal import Form
from jaxnav.evaluation.statistics import Interval
from jaxnav.runs.policies import Gap
from jaxnav.study.codec import INLINE, OPTIONAL
from jaxnav.study.trials import Trial, Variant

Metric = Literal["sr", "spl", "dts"]


@dataclasses.dataclass(frozen=True)
class Difference:
    """Hold the paired differences of a trial to another variant."""

    to: Variant
    sr: Interval
    spl: Interval
    dts: Interval


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrialRow:
    """Hold the metrics of one trial.

    Attributes:
      gap: of sTDE; `novelty` where there is none.
      trial: what is evaluated.
      mean_weight: mean over all choices of the weight of the subtracted logits.
      sr, spl, dts: metrics.
      difference: of `layout` to the baseline, of the others to `layout`; None where that was not evaluated.
    """

    gap: Gap
    trial: Trial = dataclasses.field(metadata=INLINE)
    mean_weight: float
    sr: Interval
    difference: Difference | None = dataclasses.field(default=None, metadata=OPTIONAL)
    spl: Interval
    dts: Interval

    def metric(self, name: Metric) -> Interval:
        """Return one of the metrics."""
        return getattr(self, name)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Condition:
    """Hold the trials of a run at one layout shift.

    Attributes:
      shift: of the layout.
      world: name of the world.
      scenes, episodes: their numbers.
      rows: one for each gap and trial.
      parameters: number of each policy.
      chosen: epsilon chosen on `val`; on `test` alone.
    """

    shift: float
    world: str
    scenes: int
    rows: tuple[TrialRow, ...]
    episodes: int
    parameters: int
    chosen: float | None = dataclasses.field(default=None, metadata=OPTIONAL)

    def has(self, trial: Trial, gap: Gap = "novelty") -> bool:
        """Return whether there is a row of a trial."""
        return any(row.gap == gap and row.trial == trial for row in self.rows)

    def row(self, trial: Trial, gap: Gap = "novelty") -> TrialRow:
        """Return the row of a trial.

        Raises:
          KeyError: there is none.
        """
        for row in self.rows:
            if row.gap == gap and row.trial == trial:
                return row
        raise KeyError(f"no row of {trial} with gap {gap} at shift {self.shift:g}")

    def effect(self, trial: Trial, gap: Gap = "novelty") -> Interval:
        """Return the difference in SR of a trial.

        Raises:
          KeyError: there is no such row, or nothing that it is compared with.
        """
        if (difference := self.row(trial, gap).difference) is None:
            raise KeyError(f"{trial} is compared with nothing at shift {self.shift:g}")
        return difference.sr

    def sweep(self, form: Form) -> dict[float, TrialRow]:
        """Return the rows of sTDE with best actions by epsilon."""
        return {
            epsilon: row
            for row in self.rows
            if (epsilon := row.trial.epsilon) is not None
            and (row.gap, row.trial) == ("novelty", Trial("stde", "argmax", epsilon, form))
        }


@dataclasses.dataclass(frozen=True, eq=False)
class SuccessBySimilarity:
    """Hold success against layout similarity (Fig. 4).

    There are P points, a goal category in a scene each.

    Attributes:
      category, scene: int [P], indices.
      episodes: int [P].
      similarity: float64 [P], in [0, 1].
      success: float64 [P], success rate over episodes and seeds, 0 to 1.
      left_out: number of points without a similarity, as scene or prior shows the category with no other.
      pearson, spearman: r of success and similarity.
    """

    category: np.ndarray
    scene: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    success: np.ndarray
    left_out: int
    pearson: Interval
    spearman: Interval


@dataclasses.dataclass(frozen=True, eq=False)
class GainBySimilarity:
    """Hold a variant's gain against layout similarity (Fig. 5).

    There are C goal categories, over the episodes whose point (category, scene) has a similarity.

    Attributes:
      category: int [C], indices, rising.
      episodes: int [C].
      similarity: float64 [C], mean over the category's episodes, in [0, 1].
      baseline: float64 [C], SR of the baseline.
      gain: float64 [C], SR of the variant less the baseline's.
      left_out: number of points (category, scene) without a similarity.
      slope: of gain on similarity, points per 0.1.
      pearson: r of gain and similarity.
      categories: [C], names.
    """

    category: np.ndarray
    episodes: np.ndarray
    similarity: np.ndarray
    baseline: np.ndarray
    gain: np.ndarray
    left_out: int
    slope: Interval
    pearson: Interval
    categories: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Gains:
    """Hold the gains of two variants on the baseline."""

    layout: GainBySimilarity
    stde: GainBySimilarity


@dataclasses.dataclass(frozen=True, eq=False)
class SceneEffects:
    """Hold the gain in SR of one variant on another, scene by scene.

    Attributes:
      scenes, rooms: [N] names of the scenes that were drawn, and of their room types.
      episodes: int [N], at least 1.
      gain: float64 [S, N], points, summed over the scene's episodes, by training run.
    """

    scenes: tuple[str, ...]
    rooms: tuple[str, ...]
    episodes: np.ndarray
    gain: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class FullCondition(Condition):
    """Hold every trial, and what depends on layout similarity.

    Attributes:
      similarity, gains: Figs. 4 and 5.
      effects: of sTDE at the paper's threshold on the layout's weights; None in results of version 0.1.
    """

    similarity: SuccessBySimilarity
    gains: Gains
    effects: SceneEffects | None = dataclasses.field(default=None, metadata=OPTIONAL)
