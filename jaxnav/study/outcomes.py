"""Outcomes of trials, and their rows."""

from collections.abc import Mapping

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.statistics import paired_difference, summary
from jaxnav.runs.policies import Gap
from jaxnav.study.records import Difference, Metric, SceneEffects, TrialRow
from jaxnav.study.trials import Trial, Variant

SCALES: Mapping[Metric, float] = {"sr": 100.0, "spl": 100.0, "dts": 1.0}


def mean_weight(outcome: Outcome) -> float:
    """Return the weight of the subtracted logits, averaged over choices; 0 where none counted."""
    choices = np.asarray(outcome.choices, np.float64)
    return float((np.asarray(outcome.weight, np.float64) * choices).sum() / max(choices.sum(), 1.0))


class TrialOutcomes:
    """Hold the outcomes of trials on the same episodes.

    Args:
      outcomes: of each trial, leaves [S, E].
      episodes: the E episodes.
    """

    def __init__(self, outcomes: Mapping[Trial, Outcome], episodes: EpisodeList) -> None:
        self._outcomes, self._episodes, self._scenes = outcomes, episodes, episodes.clusters()
        self._metrics = {trial: episode_metrics(each, episodes.best_length) for trial, each in outcomes.items()}

    def success(self, trial: Trial) -> np.ndarray:
        """Return the success of a trial, float64 [S, E]."""
        return self._metrics[trial]["sr"]

    def rows(self, gap: Gap) -> list[TrialRow]:
        """Return a row for each trial, sTDE with this gap.

        The layout's weights are compared with the baseline, all others with the layout's weights.
        """
        return [
            TrialRow(
                gap=gap,
                trial=trial,
                mean_weight=mean_weight(outcome),
                difference=self._difference(trial),
                **{metric: summary(self._values(trial, metric), self._scenes) for metric in SCALES},
            )
            for trial, outcome in self._outcomes.items()
        ]

    def effects(self, trial: Trial, reference: Trial) -> SceneEffects:
        """Return the gain in SR of a trial on another, scene by scene."""
        gain = 100.0 * (self.success(trial) - self.success(reference))
        episodes = self._episodes
        drawn, first, scene, count = np.unique(
            episodes.scene, return_index=True, return_inverse=True, return_counts=True
        )
        return SceneEffects(
            scenes=tuple(episodes.scenes[i] for i in drawn),
            rooms=tuple(episodes.rooms[room] for room in episodes.room[first]),
            episodes=count,
            gain=np.stack([np.bincount(scene, row) for row in gain]),
        )

    def _values(self, trial: Trial, metric: Metric) -> np.ndarray:
        return SCALES[metric] * self._metrics[trial][metric]

    def _difference(self, trial: Trial) -> Difference | None:
        to: Variant = "baseline" if trial.variant == "layout" else "layout"
        other = Trial(to, trial.decoding)
        if trial.variant == "baseline" or other not in self._outcomes:
            return None
        same_runs = trial.variant != "layout"
        effects = {
            metric: paired_difference(
                self._values(other, metric), self._values(trial, metric), self._scenes, same_runs=same_runs
            )
            for metric in SCALES
        }
        return Difference(to, **effects)
