"""Trials: ways to use the policies of a run at inference, with the controls of sTDE.

`measure_trials` evaluates all trials of a run at one layout shift: the variants, sTDE with every gap and threshold, and
controls of sTDE that keep one of its parts and replace the others. `measure_variants` evaluates the variants alone. A
`TrialRunner` evaluates trials in blocks, so that one compilation serves all of them.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.choices import DECODINGS, Decoding, Form, GapName
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator, episode_metrics
from jaxnav.evaluation.removal import GapSource, InferenceConfig, RemovedLogits
from jaxnav.evaluation.replacements import ReplacedPart
from jaxnav.evaluation.report import METRIC_COLUMNS, to_report_units
from jaxnav.evaluation.similarity import cooccurrence_counts
from jaxnav.evaluation.statistics import Interval, SharedDesign, mean_interval, paired_difference
from jaxnav.evaluation.variants import inference_grid, share_networks, table_row
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import AgentRun
from jaxnav.experiments.similarity import compute_similarity_points, gain_rows, success_rows
from jaxnav.experiments.table import ResultRow
from jaxnav.layout import EstimatorConfig
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.runs.config import ARMS
from jaxnav.runs.policies import Policies, estimators_by_gap, load_policies
from jaxnav.runs.worlds import CompiledWorld

#: Gaps that are independent of the episode: `course` is the mean gap of all episodes at that time; `after` and `until`
#: are 1 after or until a step, and 0 at other times.
GapSchedule = Literal["course", "after", "until"]
#: Modification of sTDE by a control. The gap: that of another episode (`shuffled`), or `constant`, such that the weight
#: is its mean at every step. The removed logits: `zeros`, `noise`, or counterfactual logits with a part of another
#: episode (`REPLACED_PARTS`). Scene and goal of the counterfactual decision: `random` instead of zero.
TrialControl = Literal[
    "shuffled", "constant", "zeros", "noise", "random", "other_categories", "other_experience", "other_memory"
]
#: Part of the counterfactual decision that a control takes from another episode.
REPLACED_PARTS: Mapping[str, ReplacedPart] = {
    "other_categories": ReplacedPart.OTHER_CATEGORIES,
    "other_experience": ReplacedPart.EXPERIENCE,
    "other_memory": ReplacedPart.MEMORY,
}
TrialVariant = Literal["baseline", "layout", "tde", "stde"]

GAPS: tuple[GapName, ...] = ("novelty", "evidence", "clock")
#: A step that no episode reaches.
NEVER = 2**30


class StdeOptions(NamedTuple):
    """Threshold and form of sTDE."""

    epsilon: float
    form: Form


SWEPT_FORMS: tuple[Form, ...] = ("residual", "paper")
#: The paper's threshold in the form `residual`, and no threshold in the paper's form; both are evaluated with all gaps
#: and controls.
RESIDUAL_HALF = StdeOptions(0.5, "residual")
PAPER_ZERO = StdeOptions(0.0, "paper")
#: Both, by their names on pages and in figures.
STDE_NAMES = {"sTDE (eps 0.5)": RESIDUAL_HALF, "sTDE (eps 0, paper's form)": PAPER_ZERO}
STDE_OPTIONS = tuple(STDE_NAMES.values())
#: Controls of sTDE, with argmax; zeros are sampled, because subtracting them cannot change the best action. The control
#: `constant` depends on the mean weight of the others and runs after them.
STDE_CONTROLS: tuple[tuple[TrialControl, Decoding], ...] = (
    ("shuffled", "argmax"),
    ("noise", "argmax"),
    ("random", "argmax"),
    ("zeros", "sample"),
)


@dataclasses.dataclass(frozen=True)
class Trial:
    """One way to use the policies of a run.

    Attributes:
      variant: `baseline`, `layout`, `tde` or `stde`.
      decoding: rule that turns logits into actions.
      epsilon, form: threshold and form of sTDE.
      control: modification of sTDE; None for sTDE itself.
      step: step of the schedules `after` and `until`.
      weight: weight of the control `constant`.
    """

    variant: TrialVariant
    decoding: Decoding = "argmax"
    epsilon: float | None = None
    form: Form | None = None
    control: TrialControl | GapSchedule | None = None
    step: int | None = None
    weight: float = 0.0

    def row_fields(self) -> dict[str, Any]:
        """Fields of a result that the trial determines."""
        return {
            "variant": self.variant,
            "decoding": self.decoding,
            "epsilon": self.epsilon,
            "form": self.form or "",
            "control": self.control or "",
        }

    def grid_entries(self, arms: Sequence[str], num_seeds: int) -> InferenceConfig:
        """Cells of the evaluation grid, leaves [S]; see `inference_grid`."""
        row = table_row(self.variant, self.epsilon, self.form, self.decoding)
        entries = inference_grid([row], arms, num_seeds)

        replaced = {}
        for name, value in self._control_settings().items():
            replaced[name] = jnp.broadcast_to(value, (num_seeds,))
        return entries.replace(**replaced)

    def _control_settings(self) -> dict[str, jax.Array]:
        """Fields of `InferenceConfig` that the control changes."""
        match self.control:
            case "shuffled":
                return {"gap_source": jnp.int32(GapSource.OTHER)}
            case "course":
                return {"gap_source": jnp.int32(GapSource.MEAN)}
            case "constant":
                return _given_gap(self.weight, 0, NEVER) | {"epsilon": jnp.float32(0.0)}
            case "after":
                return _given_gap(1.0, self._schedule_step, NEVER)
            case "until":
                return _given_gap(1.0, 0, self._schedule_step)
            case "zeros":
                return {"removed_source": jnp.int32(RemovedLogits.ZEROS)}
            case "noise":
                return {"removed_source": jnp.int32(RemovedLogits.NOISE)}
            case "random":
                return {"direct_noise": jnp.float32(1.0)}
            case "other_categories" | "other_experience" | "other_memory":
                part = REPLACED_PARTS[self.control]
                return {"replaced_part": jnp.int32(part), "replaces_factual": jnp.bool_(False)}
            case None:
                return {}

    @property
    def _schedule_step(self) -> int:
        if self.step is None:
            raise ValueError(f"{self.control}: give its step")
        return self.step


def _given_gap(gap: float, begin: int, end: int) -> dict[str, jax.Array]:
    """Settings for a constant gap from step `begin` to before step `end`."""
    return {
        "gap_source": jnp.int32(GapSource.GIVEN),
        "given_gap": jnp.float32(gap),
        "gap_begin": jnp.int32(begin),
        "gap_end": jnp.int32(end),
    }


def trial_grid(trials: Sequence[Trial], arms: Sequence[str], num_seeds: int) -> InferenceConfig:
    """Cells of the evaluation grid for all trials, leaves [T S]."""
    entries = [trial.grid_entries(arms, num_seeds) for trial in trials]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *entries)


# Running trials


class EvaluatedRun(NamedTuple):
    """The policies of a run and the episodes to evaluate them in.

    Attributes:
      policies: policies of the run.
      compiled_world: the scenes at one layout shift.
      episodes: episodes in these scenes.
    """

    policies: Policies
    compiled_world: CompiledWorld
    episodes: EpisodeList


class TrialRunner:
    """Runs trials in blocks of equal size, so that a compilation serves all of them.

    Args:
      seed: seed of the sampled actions.
    """

    BLOCK_SIZE = 2

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._evaluators: dict[tuple[AgentLoop, tuple[ReplacedPart, ...]], Evaluator] = {}

    def run_trials(
        self, evaluated_run: EvaluatedRun, estimator: EstimatorConfig | None, trials: Iterable[Trial]
    ) -> dict[Trial, EpisodeOutcome]:
        """Run distinct trials with one layout estimator; outcomes have leaves [S, E].

        Raises:
          InputError: the method cannot act in the scenes.
        """
        # An evaluator compiles once, so trials with the same agent loop and replaced parts share it.
        policies, world, episodes = evaluated_run
        num_seeds = policies.num_seeds
        agent_loop = policies._replace(estimator_config=estimator).make_agent_loop(world)
        distinct_trials = list(dict.fromkeys(trials))
        controls = {trial.control for trial in distinct_trials}
        replaced_parts = tuple(part for control, part in REPLACED_PARTS.items() if control in controls)
        evaluator = self._evaluators.setdefault(
            (agent_loop, replaced_parts), Evaluator(agent_loop, replaced_parts=replaced_parts)
        )
        env_params = world.make_env_params(0)
        outcomes: dict[Trial, EpisodeOutcome] = {}
        for start in range(0, len(distinct_trials), self.BLOCK_SIZE):
            # The last block repeats its last trial up to the full size.
            block = distinct_trials[start : start + self.BLOCK_SIZE]
            padded_block = block + block[-1:] * (self.BLOCK_SIZE - len(block))
            block_outcome = evaluator(
                trial_grid(padded_block, policies.arms, num_seeds),
                policies.params,
                [(episodes, env_params)],
                policies.knowledge,
                jax.random.key(self.seed),
            )

            # Results of the repeated trials are dropped.
            for index, trial in enumerate(block):
                outcomes[trial] = _rows_of_trial(block_outcome, index, num_seeds)
        return outcomes


def _rows_of_trial(outcome: EpisodeOutcome, index: int, num_seeds: int) -> EpisodeOutcome:
    """Cut the outcome of one trial, leaves [S, E], out of that of a block, leaves [block size * S, E]."""
    return jax.tree.map(lambda leaf: leaf[index * num_seeds : (index + 1) * num_seeds], outcome)


def require_estimator_config(policies: Policies) -> EstimatorConfig:
    """Return the layout estimator's configuration of policies.

    Raises:
      InputError: none of the policies uses the layout.
    """
    if policies.estimator_config is None:
        raise InputError("needs policies with the layout; train a run with the arm `layout`")
    return policies.estimator_config


def mean_removal_weight(outcome: EpisodeOutcome) -> float:
    """Average the weight of the subtracted logits over all decisions; 0 without any decision."""
    num_decisions = int(np.asarray(outcome.num_decisions).sum())
    return float(np.asarray(outcome.total_weight, np.float64).sum() / max(num_decisions, 1))


# Measurements


def measure_variants(bench: Bench, run: AgentRun, shift: float) -> Iterator[ResultRow]:
    """Evaluate the variants of a run, and sTDE with best actions and the gap of eq. 5, at one shift."""
    evaluated_run = prepare_run(bench, run, shift)
    runner = TrialRunner(bench.config.seed)
    trials = _plain_trials(("argmax",), with_baseline="baseline" in run.config.arms)
    trials += [Trial("stde", "argmax", *options) for options in STDE_OPTIONS]
    estimator = estimators_by_gap(require_estimator_config(evaluated_run.policies))["novelty"]
    outcomes = TrialOutcomes(runner.run_trials(evaluated_run, estimator, trials), evaluated_run.episodes)
    fields = {"world": run.world, "run": run.agent, "shift": shift}
    for gap in ("", "novelty"):
        yield from outcomes.trial_rows(fields, gap)
    yield from _size_rows(fields, evaluated_run)


def measure_trials(bench: Bench, run: AgentRun, shift: float) -> Iterator[ResultRow]:
    """Evaluate all trials of a run at one shift, and relate its success to layout similarity."""
    # On `test`, only the threshold that was chosen on `val` is evaluated, beside those that were fixed beforehand
    # (`STDE_OPTIONS`). Without a chosen one, nothing is trained.
    is_test = bench.config.split == "test"
    swept_thresholds = (bench.chosen_epsilon(run),) if is_test else bench.config.epsilon
    thresholds = {*swept_thresholds, *(options.epsilon for options in STDE_OPTIONS)}

    evaluated_run = prepare_run(bench, run, shift)
    policies, _, episodes = evaluated_run
    runner = TrialRunner(bench.config.seed)
    estimators = estimators_by_gap(require_estimator_config(policies))
    fields = {"world": run.world, "run": run.agent, "shift": shift}

    # Trials without sTDE serve as references of all others, whatever the gap.
    plain_trials = _plain_trials(DECODINGS, with_baseline="baseline" in run.config.arms)
    plain_outcomes = runner.run_trials(evaluated_run, estimators["novelty"], plain_trials)
    plain = TrialOutcomes(plain_outcomes, episodes)
    yield from plain.trial_rows(fields, "")

    # sTDE with every gap, compared with the same outcomes without sTDE.
    for gap in GAPS:
        stde_outcomes = _run_stde_trials(evaluated_run, gap, estimators[gap], runner, sorted(thresholds))
        outcomes = TrialOutcomes(plain_outcomes | stde_outcomes, episodes)
        yield from outcomes.trial_rows(fields, gap)

        # Gains over the baseline are related to similarity for the gap of the paper.
        if gap == "novelty" and "baseline" in run.config.arms:
            yield from _similarity_rows(fields, evaluated_run, outcomes)
    yield from _size_rows(fields, evaluated_run)


def measure_growth(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Compare the gain of sTDE over the layout weights between the first shift and the last.

    Both shifts share scenes and training runs, so the jackknife leaves out a scene or a run of both at once.
    """
    trials = (Trial("layout"), Trial("stde", "argmax", *RESIDUAL_HALF))
    runner = TrialRunner(bench.config.seed)
    shifts = (bench.config.shifts[0], bench.config.shifts[-1])
    conditions = []
    sums = []
    for shift in shifts:
        evaluated_run = prepare_run(bench, run, shift)
        estimator = estimators_by_gap(require_estimator_config(evaluated_run.policies))["novelty"]
        outcomes = TrialOutcomes(runner.run_trials(evaluated_run, estimator, trials), evaluated_run.episodes)
        episode_gain = 100.0 * (outcomes.success(trials[1]) - outcomes.success(trials[0]))  # [S, E]
        conditions.append(_scene_names(evaluated_run.episodes))
        sums.append(sum_by_scene(episode_gain, evaluated_run.episodes))

    # Sums [S, N] and counts [N] by scene become leave-one-out means, whose difference has an interval.
    design = SharedDesign.from_conditions(conditions, len(sums[0].values))
    means = []
    for scene_sums, (names, _) in zip(sums, conditions, strict=True):
        means.append(design.jackknife_means(scene_sums.values, scene_sums.counts, names))
    yield ResultRow(
        world=run.world,
        run=run.agent,
        **trials[1].row_fields(),
        gap="novelty",
        reference="layout",
        metric="sr growth",
        value=design.interval(means[1] - means[0]),
        scenes=len(conditions[0][0]),
    )


def prepare_run(bench: Bench, run: AgentRun, shift: float) -> EvaluatedRun:
    """Load the policies of a run and draw its episodes at a shift.

    The policies of a run with the layout arm alone stand at the places of both arms, so that those of the layout arm
    have the same index, and with it the same random numbers, as in an evaluation.

    Raises:
      InputError: the scenes fill more than one shard.
    """
    bench.train(run)
    compiled_world = bench.compile_world(run, shift)
    policies = load_policies(run.config, run.config.arms)
    if "baseline" not in run.config.arms:
        duplicated_params = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), policies.params)
        policies = policies._replace(params=duplicated_params, arms=ARMS)
    return EvaluatedRun(policies, compiled_world, bench.draw_episodes(compiled_world))


def _plain_trials(decodings: Sequence[Decoding], with_baseline: bool) -> list[Trial]:
    """List the trials without sTDE."""
    variants: tuple[TrialVariant, ...] = ("baseline", "layout", "tde") if with_baseline else ("layout", "tde")
    return [Trial(variant, decoding) for variant, decoding in itertools.product(variants, decodings)]


def _run_stde_trials(
    evaluated_run: EvaluatedRun,
    gap: GapName,
    estimator: EstimatorConfig,
    runner: TrialRunner,
    thresholds: Sequence[float],
) -> dict[Trial, EpisodeOutcome]:
    """Run sTDE and its controls with one gap.

    The gap `novelty` also sweeps the thresholds; the gap `clock` is a control itself and has no others.
    """
    # sTDE itself, then the sweep of epsilon with best actions.
    trials = [Trial("stde", decoding, *options) for options, decoding in itertools.product(STDE_OPTIONS, DECODINGS)]
    if gap == "novelty":
        for form, epsilon in itertools.product(SWEPT_FORMS, thresholds):
            trials.append(Trial("stde", "argmax", epsilon, form))
    if gap == "clock":
        return runner.run_trials(evaluated_run, estimator, trials)

    # Controls that do not depend on the outcomes of others run together with sTDE.
    for options, (control, decoding) in itertools.product(STDE_OPTIONS, STDE_CONTROLS):
        trials.append(Trial("stde", decoding, *options, control))
    outcomes = runner.run_trials(evaluated_run, estimator, trials)

    # The control `constant` removes as much as sTDE does on average.
    constant_trials = []
    for options in STDE_OPTIONS:
        weight = mean_removal_weight(outcomes[Trial("stde", "argmax", *options)])
        constant_trials.append(Trial("stde", "argmax", *options, "constant", weight=weight))
    return outcomes | runner.run_trials(evaluated_run, estimator, constant_trials)


def _size_rows(fields: Mapping[str, Any], evaluated_run: EvaluatedRun) -> Iterator[ResultRow]:
    """Number of parameters of each policy."""
    num_parameters = sum(leaf[0].size for leaf in jax.tree.leaves(evaluated_run.policies.params))
    yield ResultRow(**fields, metric="parameters", value=Interval(float(num_parameters)))


class TrialOutcomes:
    """Outcomes of several trials on the same episodes.

    Args:
      outcomes: outcome of each trial, leaves [S, E].
      episodes: the E episodes.
    """

    def __init__(self, outcomes: Mapping[Trial, EpisodeOutcome], episodes: EpisodeList) -> None:
        self._outcomes = outcomes
        self._episodes = episodes
        self._clusters = episodes.clusters()
        self._metrics = {}
        for trial, outcome in outcomes.items():
            self._metrics[trial] = episode_metrics(outcome, episodes.best_length)

    def success(self, trial: Trial) -> np.ndarray:
        """Success of a trial, float64 [S, E]."""
        return self._metrics[trial]["sr"]

    def trial_rows(self, fields: Mapping[str, Any], gap: str) -> Iterator[ResultRow]:
        """Make the rows of every trial with a gap.

        Rows without sTDE do not depend on the gap and are made for the gap "" only. The layout variant is compared with
        the baseline, every other variant with the layout variant.
        """
        for trial, outcome in self._outcomes.items():
            if (trial.variant == "stde") != bool(gap):
                continue
            trial_fields = {**fields, **trial.row_fields(), "gap": gap}
            trial_fields["scenes"] = self._episodes.num_drawn_scenes
            yield ResultRow(**trial_fields, metric="weight", value=Interval(mean_removal_weight(outcome)))
            for metric in METRIC_COLUMNS:
                interval = mean_interval(self._values(trial, metric), self._clusters)
                yield ResultRow(**trial_fields, metric=metric, value=interval)

            # Both sides use the same decoding rule.
            reference = Trial("baseline" if trial.variant == "layout" else "layout", trial.decoding)
            if trial.variant == "baseline" or reference not in self._outcomes:
                continue
            difference = paired_difference(
                self._values(reference, "sr"),
                self._values(trial, "sr"),
                self._clusters,
                same_runs=share_networks(trial.variant, reference.variant),
            )
            yield ResultRow(**trial_fields, reference=reference.variant, metric="sr", value=difference)

    def _values(self, trial: Trial, metric: str) -> np.ndarray:
        """Results [S, E] of a trial in percent, or metres."""
        return to_report_units(metric, self._metrics[trial][metric])


class SceneSums(NamedTuple):
    """Sums over the episodes of N scenes: values float64 [S, N], and the number of episodes, int [N]."""

    values: np.ndarray
    counts: np.ndarray


def sum_by_scene(values: np.ndarray, episodes: EpisodeList) -> SceneSums:
    """Sum values [S, E] over the episodes of each scene; scenes without episodes are not listed."""
    drawn_scenes, scene_index, counts = np.unique(episodes.scene, return_inverse=True, return_counts=True)
    sums = np.zeros((len(values), len(drawn_scenes)))
    for run_index, run_values in enumerate(values):
        sums[run_index] = np.bincount(scene_index, run_values)
    return SceneSums(sums, counts)


def _scene_names(episodes: EpisodeList) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the drawn scenes, and of their room types."""
    drawn_scenes, first_episodes = np.unique(episodes.scene, return_index=True)
    names = tuple(episodes.scenes[scene] for scene in drawn_scenes)
    rooms = tuple(episodes.rooms[room] for room in episodes.room[first_episodes])
    return names, rooms


def _similarity_rows(
    fields: Mapping[str, Any], evaluated_run: EvaluatedRun, outcomes: TrialOutcomes
) -> Iterator[ResultRow]:
    """Relate the success of the baseline, and gains over it, to layout similarity."""
    # Priors [N, K, K] of the room type of each scene.
    policies, world, episodes = evaluated_run
    bank = world.banks[0]
    room = np.asarray(world.make_env_params(0).room)[: len(bank.names)]
    prior = np.asarray(policies.prior_counts, np.float64)[room]

    # Points are scenes and goal categories with their similarity.
    points = compute_similarity_points(episodes, cooccurrence_counts(bank), prior)
    baseline_success = outcomes.success(Trial("baseline"))
    yield from success_rows(fields, points, baseline_success)
    trial = Trial("stde", "argmax", *RESIDUAL_HALF)
    trial_fields = {**fields, **trial.row_fields()}
    yield from gain_rows(trial_fields, points, baseline_success, outcomes.success(trial), world.env.categories)
