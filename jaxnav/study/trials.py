"""The trials of the study: every way of using the policies at inference that its tables compare."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.inference import Branch, Inference
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.report import Decoding, Form
from jaxnav.evaluation.statistics import Bootstrap
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.study.association import scene_draws

#: What is changed about sTDE to learn what it owes its effect to: the weight is its own mean at every step, or that of
#: another episode; zeros or noise are taken out instead of logits; the intervention is random instead of zero.
Control = Literal["constant", "shuffled", "zeros", "noise", "random"]
#: The uses of sTDE that all is run for: the paper's threshold, and no threshold, in the paper's form.
USES: tuple[tuple[float, Form], ...] = ((0.5, "residual"), (0.0, "paper"))
METRICS = {"sr": 100.0, "spl": 100.0, "dts": 1.0}


@dataclasses.dataclass(frozen=True)
class Trial:
    """One row of a table of the study.

    Attributes:
      variant: `baseline`, `layout`, `tde` or `stde`.
      decoding: of actions.
      epsilon, form: of sTDE.
      control: what is changed about it.
      weight: the constant weight of `constant`.
    """

    variant: Literal["baseline", "layout", "tde", "stde"]
    decoding: Decoding
    epsilon: float | None = None
    form: Form | None = None
    control: Control | None = None
    weight: float = 0.0

    def cells(self, num_seeds: int) -> Inference:
        """The cells of the grid, leaves [S]; parameters are stacked as by `inference_grid`."""
        cells = inference_grid([table_row(self.variant, self.epsilon, self.form, self.decoding)], num_seeds)
        match self.control:
            case "constant":
                changes = {"always": jnp.float32(self.weight), "epsilon": jnp.float32(jnp.inf)}
            case "shuffled":
                changes = {"shuffled": jnp.bool_(True)}
            case "zeros":
                changes = {"branch": jnp.int32(Branch.ZEROS)}
            case "noise":
                changes = {"branch": jnp.int32(Branch.NOISE)}
            case "random":
                changes = {"intervention": jnp.float32(1.0)}
            case None:
                changes = {}
        return cells.replace(**{name: jnp.broadcast_to(value, (num_seeds,)) for name, value in changes.items()})


def trial_grid(trials: Sequence[Trial], num_seeds: int) -> Inference:
    """The cells of all trials, leaves [T S]."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(trial.cells(num_seeds) for trial in trials))


def mean_weight(outcome: Outcome) -> float:
    """Mean over all steps of the weight of what is taken out."""
    length = np.asarray(outcome.length, np.float64)
    return float((np.asarray(outcome.weight, np.float64) * length).sum() / length.sum())


class Results:
    """What trials on the same episodes say.

    Attributes:
      outcomes: of each trial, leaves [S, E].
    """

    def __init__(self, outcomes: Mapping[Trial, Outcome], episodes: EpisodeList) -> None:
        self.outcomes, self._episodes = outcomes, episodes
        self._metrics = {trial: episode_metrics(own, episodes.best_length) for trial, own in outcomes.items()}

    def success(self, trial: Trial) -> np.ndarray:
        """Success of a trial, float64 [S, E]."""
        return self._metrics[trial]["sr"]

    def rows(self, seed: int) -> list[dict[str, Any]]:
        """A row of JSON per trial: metrics, and their difference to the layout's weights (theirs: to the baseline).

        SR and SPL are in percent, DTS in metres. Resamples of the intervals draw seeds, and scenes within room types
        with all their episodes. Trials without the row that they would be compared with have no difference.
        """
        generator = np.random.default_rng(seed)
        (scenes,) = scene_draws([self._episodes], generator)
        drawn = scenes[:, 1:].T.astype(np.float64)
        num_seeds = len(next(iter(self.outcomes.values())).length)
        bootstrap = Bootstrap(drawn / drawn.sum(axis=1, keepdims=True), num_seeds, generator)
        return [self._row(trial, bootstrap) for trial in self.outcomes]

    def _row(self, trial: Trial, bootstrap: Bootstrap) -> dict[str, Any]:
        against = Trial("baseline" if trial.variant == "layout" else "layout", trial.decoding)
        row: dict[str, Any] = dataclasses.asdict(trial) | {"mean_weight": mean_weight(self.outcomes[trial])}
        for metric, scale in METRICS.items():
            own = scale * self._metrics[trial][metric]
            row[metric] = bootstrap.summary(own)._asdict() | {"seeds": own.mean(axis=1).tolist()}
            if trial.variant != "baseline" and against in self.outcomes:
                other = scale * self._metrics[against][metric]
                difference = bootstrap.difference(other, own, same_seeds=trial.variant != "layout")
                row.setdefault("difference", {"to": against.variant})[metric] = difference._asdict()
        return row
