"""Outcomes of trials, and their rows."""

from collections.abc import Mapping

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.statistics import Bootstrap
from jaxnav.study.bootstrap import scene_draws
from jaxnav.study.intervals import Effect, Estimate
from jaxnav.study.records import Difference, Metric, TrialRow
from jaxnav.study.trials import Gap, Trial, Variant

SCALES: Mapping[Metric, float] = {"sr": 100.0, "spl": 100.0, "dts": 1.0}


def mean_weight(outcome: Outcome) -> float:
    """Return the weight of the subtracted logits, averaged over steps."""
    length = np.asarray(outcome.length, np.float64)
    return float((np.asarray(outcome.weight, np.float64) * length).sum() / length.sum())


class TrialOutcomes:
    """Hold the outcomes of trials on the same episodes.

    Args:
      outcomes: of each trial, leaves [S, E].
      episodes: the E episodes.
    """

    def __init__(self, outcomes: Mapping[Trial, Outcome], episodes: EpisodeList) -> None:
        self._outcomes, self._episodes = outcomes, episodes
        self._metrics = {trial: episode_metrics(each, episodes.best_length) for trial, each in outcomes.items()}

    def success(self, trial: Trial) -> np.ndarray:
        """Return the success of a trial, float64 [S, E]."""
        return self._metrics[trial]["sr"]

    def rows(self, seed: int, gap: Gap) -> list[TrialRow]:
        """Return a row for each trial.

        Resamples of the intervals draw training seeds, and scenes within room types with all their episodes. The
        layout's weights are compared with the baseline, all others with the layout's weights.

        Args:
          seed: of the resamples.
          gap: of the rows.
        """
        generator = np.random.default_rng(seed)
        (scenes,) = scene_draws([self._episodes], generator)
        drawn = scenes[:, 1:].T.astype(np.float64)
        num_seeds = len(next(iter(self._outcomes.values())).length)
        bootstrap = Bootstrap(drawn / drawn.sum(axis=1, keepdims=True), num_seeds, generator)
        return [self._row(trial, gap, bootstrap) for trial in self._outcomes]

    def _row(self, trial: Trial, gap: Gap, bootstrap: Bootstrap) -> TrialRow:
        return TrialRow(
            gap=gap,
            trial=trial,
            mean_weight=mean_weight(self._outcomes[trial]),
            difference=self._difference(trial, bootstrap),
            **{metric: self._estimate(trial, metric, bootstrap) for metric in SCALES},
        )

    def _values(self, trial: Trial, metric: Metric) -> np.ndarray:
        return SCALES[metric] * self._metrics[trial][metric]

    def _estimate(self, trial: Trial, metric: Metric, bootstrap: Bootstrap) -> Estimate:
        values = self._values(trial, metric)
        return Estimate.of(bootstrap.summary(values), values)

    def _difference(self, trial: Trial, bootstrap: Bootstrap) -> Difference | None:
        to: Variant = "baseline" if trial.variant == "layout" else "layout"
        other = Trial(to, trial.decoding)
        if trial.variant == "baseline" or other not in self._outcomes:
            return None
        same_seeds = trial.variant != "layout"
        effects = {
            metric: Effect.of(
                bootstrap.difference(self._values(other, metric), self._values(trial, metric), same_seeds)
            )
            for metric in SCALES
        }
        return Difference(to, **effects)
