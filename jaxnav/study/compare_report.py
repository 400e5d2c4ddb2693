"""Results of a comparison as records."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from jaxnav.evaluation.report import UNTRAINED, Decoding
from jaxnav.evaluation.statistics import Clusters, Interval, paired_difference, scene_clusters, summary
from jaxnav.scenes.scene import floor_plan
from jaxnav.study.codec import OPTIONAL
from jaxnav.study.records import Metric

#: Agents whose training is none; those of `evaluate` and frontier search.
REFERENCES = (*UNTRAINED, "frontier")
SCALE: Mapping[Metric, float] = {"sr": 100.0, "spl": 100.0, "dts": 1.0}


@dataclasses.dataclass(frozen=True, eq=False)
class Line:
    """Hold how one agent did, scene by scene.

    Attributes:
      variant: as in an evaluation, or `frontier`.
      decoding: of actions.
      sr, spl: float64 [S, N], sums over the episodes of each scene, by training run; an episode gives 0 to 1.
      dts: float64 [S, N], the same in metres.
    """

    variant: str
    decoding: Decoding
    sr: np.ndarray
    spl: np.ndarray
    dts: np.ndarray


@dataclasses.dataclass(frozen=True)
class Training:
    """Hold what the training of a run took.

    Attributes:
      budget: environment steps of each policy, by what they are for.
      wall_s: seconds of the run, all its arms and seeds together.
      course: val success in percent before the last quarter and at the end; None where it was not measured.
      notes: what the reader must be told of the run.
    """

    budget: Mapping[str, int]
    wall_s: float
    course: tuple[float, ...] | None
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Scores:
    """Hold the results of a run, or of agents without training.

    Episodes of a scene weigh alike, so sums by scene tell all that means and intervals of the episodes need.

    Attributes:
      scenes, rooms: [N], names of the scenes that were drawn, and of their room types.
      episodes: int [N], of each scene, at least 1.
      lines: one for each agent and decoding.
      training: of the run; None without training.
    """

    scenes: tuple[str, ...]
    rooms: tuple[str, ...]
    episodes: np.ndarray
    lines: tuple[Line, ...]
    training: Training | None = dataclasses.field(default=None, metadata=OPTIONAL)

    def line(self, variant: str, decoding: Decoding) -> Line | None:
        """Return the line of an agent, if it is there.

        Agents without training have one line, whatever the decoding.
        """
        for line in self.lines:
            if line.variant == variant and (variant in REFERENCES or line.decoding == decoding):
                return line
        return None

    def clusters(self) -> Clusters:
        """Return the floor plans of the episodes, scene by scene."""
        plans = np.array([floor_plan(name) for name in self.scenes])
        return scene_clusters(np.repeat(plans, self.episodes), np.repeat(self.rooms, self.episodes))

    def summary(self, line: Line, metric: Metric) -> Interval:
        """Return a metric of an agent; SR and SPL in percent."""
        return summary(self._values(line, metric), self.clusters(), trained=line.variant not in REFERENCES)

    def difference(self, line: Line, other: "Scores", reference: Line, metric: Metric) -> Interval:
        """Return a metric of an agent less that of a reference.

        Args:
          line: of the agent.
          other: results of the reference, in the same episodes; these results where both are the same networks.
          reference: its line.
          metric: SR and SPL are in percentage points.
        """
        a, b = other._values(reference, metric), self._values(line, metric)
        untrained = reference.variant in REFERENCES  # no other networks than those of the agent
        same = self is other and (untrained or "baseline" not in (line.variant, reference.variant))
        return paired_difference(a, b, self.clusters(), same_runs=same)

    def _values(self, line: Line, metric: Metric) -> np.ndarray:
        """Give the first episode of each scene its sum and the others 0, [S, E].

        Means and intervals are those of the episodes, and whole numbers stay exact.
        """
        sums = SCALE[metric] * getattr(line, metric)
        values = np.zeros((len(sums), self.episodes.sum()))
        values[:, np.cumsum(self.episodes) - self.episodes] = sums
        return values
