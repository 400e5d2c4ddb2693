"""Evaluation of the trials of a study.

A trial is one way to use the policies of a run at inference. `measure_condition` evaluates all trials of a run at one
layout shift: a `TrialRunner` loads the run and runs the trials, and `TrialOutcomes` turns their outcomes into rows with
intervals.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator, episode_metrics
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.similarity import cooccurrence_counts
from jaxnav.evaluation.statistics import Interval, mean_interval, paired_difference
from jaxnav.layout import EstimatorConfig
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.runs.config import ARMS, RunConfig
from jaxnav.runs.policies import GapName, Policies, estimators_by_gap, load_policies
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world
from jaxnav.study.config import StudyConfig
from jaxnav.study.records import (
    METRIC_SCALE,
    PAPER_THRESHOLD,
    STDE_OPTIONS,
    SWEPT_FORMS,
    Condition,
    FullCondition,
    GainBySimilarity,
    Gains,
    PairedDifference,
    SceneEffects,
    StudyMetric,
    SuccessBySimilarity,
    Trial,
    TrialControl,
    TrialRow,
    TrialVariant,
    trial_grid,
)
from jaxnav.study.results import load_condition
from jaxnav.study.similarity import (
    compute_similarity_points,
    relate_gain_to_similarity,
    relate_success_to_similarity,
)

DECODINGS: tuple[Decoding, ...] = ("argmax", "sample")
GAPS: tuple[GapName, ...] = ("novelty", "evidence", "clock")
#: Controls of sTDE, with argmax; zeros are sampled, because subtracting them cannot change the best action. The control
#: `constant` depends on the mean weight of the others and runs after them.
STDE_CONTROLS: tuple[tuple[TrialControl, Decoding], ...] = (
    ("shuffled", "argmax"),
    ("noise", "argmax"),
    ("random", "argmax"),
    ("zeros", "sample"),
)


class EvaluatedRun(NamedTuple):
    """The policies of a run and the episodes to evaluate them in.

    Attributes:
      policies: policies of the run.
      world: the scenes at one layout shift.
      episodes: episodes in these scenes.
    """

    policies: Policies
    world: CompiledWorld
    episodes: EpisodeList

    @property
    def num_parameters(self) -> int:
        """Number of parameters of each policy."""
        return sum(leaf[0].size for leaf in jax.tree.leaves(self.policies.params))


class TrialRunner:
    """Runs trials in blocks of equal size, so that a compilation serves all of them."""

    BLOCK_SIZE = 2

    def __init__(self, config: StudyConfig) -> None:
        self.config = config
        self._evaluators: dict[AgentLoop, Evaluator] = {}

    def prepare_run(self, run: RunConfig, shift: float, console: Console) -> EvaluatedRun:
        """Load the policies of a run and draw its episodes at a shift.

        If a run has only the layout arm, its policies also serve as those of the baseline arm.

        Raises:
          InputError: the run is not finished, or its scenes fill more than one shard.
        """
        # A run of the layout arm alone has no baseline of its own; both arms then hold the same networks.
        world = compile_evaluation_world(run, self.config.split, None, shift, console)
        policies = load_policies(run, run.arms)
        if "baseline" not in run.arms:
            duplicated_params = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), policies.params)
            policies = policies._replace(params=duplicated_params, arms=ARMS)
        return EvaluatedRun(policies, world, draw_study_episodes(world, self.config))

    def run_trials_with_gap(
        self, evaluated_run: EvaluatedRun, gap: GapName, trials: Iterable[Trial]
    ) -> dict[Trial, EpisodeOutcome]:
        """Run distinct trials with one layout gap; outcomes have leaves [S, E]."""
        distinct_trials = list(dict.fromkeys(trials))
        estimator = estimators_by_gap(require_estimator_config(evaluated_run.policies))[gap]
        outcomes = self.run_trials(evaluated_run, estimator, distinct_trials)
        return dict(zip(distinct_trials, outcomes, strict=True))

    def run_trials(
        self, evaluated_run: EvaluatedRun, estimator: EstimatorConfig | None, trials: Sequence[Trial]
    ) -> list[EpisodeOutcome]:
        """Run trials with one layout estimator; outcomes have leaves [S, E].

        Raises:
          InputError: the method cannot act in the scenes.
        """
        # An evaluator compiles once, so trials with the same agent loop share it.
        policies, world, episodes = evaluated_run
        num_seeds = policies.num_seeds
        agent_loop = policies._replace(estimator_config=estimator).make_agent_loop(world)
        evaluator = self._evaluators.setdefault(agent_loop, Evaluator(agent_loop))
        env_params = world.make_env_params(0)

        outcomes: list[EpisodeOutcome] = []
        for start in range(0, len(trials), self.BLOCK_SIZE):
            # The last block repeats its last trial up to the full size.
            block = list(trials[start : start + self.BLOCK_SIZE])
            padded_block = block + block[-1:] * (self.BLOCK_SIZE - len(block))
            block_outcome = evaluator(
                trial_grid(padded_block, policies.arms, num_seeds),
                policies.params,
                [(episodes, env_params)],
                policies.knowledge,
                jax.random.key(self.config.seed),
            )

            # Results of the repeated trials are dropped.
            for index in range(len(block)):
                outcomes.append(_rows_of_trial(block_outcome, index, num_seeds))
        return outcomes


def _rows_of_trial(outcome: EpisodeOutcome, index: int, num_seeds: int) -> EpisodeOutcome:
    """Cut the outcome of one trial, leaves [S, E], out of that of a block, leaves [block size * S, E]."""
    return jax.tree.map(lambda leaf: leaf[index * num_seeds : (index + 1) * num_seeds], outcome)


def draw_study_episodes(world: CompiledWorld, config: StudyConfig) -> EpisodeList:
    """Draw the episodes of a study in one world.

    Raises:
      InputError: the scenes fill more than one shard.
    """
    if len(world.banks) > 1:
        raise InputError("study: takes as many scenes of a split as fit into one shard; give more --shard-scenes")
    return draw_episodes(world.banks[0], config.episodes, config.seed)


def require_estimator_config(policies: Policies) -> EstimatorConfig:
    """Return the layout estimator's configuration of policies.

    Raises:
      InputError: none of the policies uses the layout.
    """
    if policies.estimator_config is None:
        raise InputError("study: needs policies with the layout; train a run with the arm `layout`")
    return policies.estimator_config


def mean_removal_weight(outcome: EpisodeOutcome) -> float:
    """Average the weight of the subtracted logits over all choices; 0 without any choice."""
    num_choices = np.asarray(outcome.choices, np.float64)
    mean_weight = np.asarray(outcome.mean_weight, np.float64)
    return float((mean_weight * num_choices).sum() / max(num_choices.sum(), 1.0))


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

    def trial_rows(self, gap: GapName) -> list[TrialRow]:
        """Make one row for each trial, with this gap for sTDE.

        The layout variant is compared with the baseline, every other variant with the layout variant.
        """
        rows = []
        for trial, outcome in self._outcomes.items():
            row = TrialRow(
                gap=gap,
                trial=trial,
                mean_weight=mean_removal_weight(outcome),
                difference=self._difference(trial),
                sr=self._mean(trial, "sr"),
                spl=self._mean(trial, "spl"),
                dts=self._mean(trial, "dts"),
            )
            rows.append(row)
        return rows

    def scene_effects(self, trial: Trial, reference: Trial) -> SceneEffects:
        """Sum the gain in SR of a trial over a reference, scene by scene."""
        # Gain in percentage points, float64 [S, E], and the scene of every episode; scenes without episodes are not
        # listed.
        episode_gain = 100.0 * (self.success(trial) - self.success(reference))
        episodes = self._episodes
        drawn_scenes, first_episode, scene_index, num_episodes = np.unique(
            episodes.scene, return_index=True, return_inverse=True, return_counts=True
        )

        # Sums by training run and scene, [S, N].
        gain_sums = []
        for run_gain in episode_gain:
            gain_sums.append(np.bincount(scene_index, run_gain))

        return SceneEffects(
            scenes=tuple(episodes.scenes[scene] for scene in drawn_scenes),
            rooms=tuple(episodes.rooms[room] for room in episodes.room[first_episode]),
            episodes=num_episodes,
            gain=np.stack(gain_sums),
        )

    def _values(self, trial: Trial, metric: StudyMetric) -> np.ndarray:
        """Results [S, E] of a trial in percent, or metres."""
        return METRIC_SCALE[metric] * self._metrics[trial][metric]

    def _mean(self, trial: Trial, metric: StudyMetric) -> Interval:
        return mean_interval(self._values(trial, metric), self._clusters)

    def _difference(self, trial: Trial) -> PairedDifference | None:
        """Compare a trial with its reference; None for the baseline, or if the reference was not run."""
        # Both sides use the same decoding rule.
        reference_variant: TrialVariant = "baseline" if trial.variant == "layout" else "layout"
        reference = Trial(reference_variant, trial.decoding)
        if trial.variant == "baseline" or reference not in self._outcomes:
            return None

        # The baseline was trained separately; all other variants use the networks of the layout arm.
        same_runs = trial.variant != "layout"

        def difference(metric: StudyMetric) -> Interval:
            reference_values = self._values(reference, metric)
            return paired_difference(reference_values, self._values(trial, metric), self._clusters, same_runs=same_runs)

        return PairedDifference(reference_variant, difference("sr"), difference("spl"), difference("dts"))


def measure_condition(
    run: RunConfig, all_trials: bool, shift: float, runner: TrialRunner, console: Console
) -> Condition:
    """Evaluate the trials of a run at one shift.

    Args:
      run: a finished run.
      all_trials: True to run all trials, and to relate results to layout similarity; False for the trials of Table 1
        with argmax.
      shift: layout shift.
      runner: runs the trials.
      console: prints progress.

    Raises:
      InputError: epsilon was not chosen on `val`, or see `TrialRunner.prepare_run`.
    """
    # Trials without sTDE serve as references of all others.
    evaluated_run = runner.prepare_run(run, shift, console)
    plain_trials = _plain_trials(DECODINGS if all_trials else ("argmax",), with_baseline="baseline" in run.arms)
    plain_outcomes = runner.run_trials_with_gap(evaluated_run, "novelty", plain_trials)
    if all_trials:
        return _measure_full_condition(evaluated_run, shift, runner, plain_outcomes)

    # Table 1 needs sTDE with best actions only, and none of its controls.
    stde_trials = [Trial("stde", "argmax", *options) for options in STDE_OPTIONS.values()]
    stde_outcomes = runner.run_trials_with_gap(evaluated_run, "novelty", stde_trials)
    outcomes = TrialOutcomes(plain_outcomes | stde_outcomes, evaluated_run.episodes)
    return Condition(
        shift=shift,
        world=evaluated_run.world.scenes[0].world,
        scenes=len(evaluated_run.episodes.scenes),
        rows=tuple(outcomes.trial_rows("novelty")),
        episodes=len(evaluated_run.episodes.goal),
        parameters=evaluated_run.num_parameters,
    )


def best_val_epsilon(config: StudyConfig) -> float:
    """Look up the epsilon with the greatest SR on `val`.

    The choice is made at the first shift, with the gap of eq. 5 in the residual form.

    Raises:
      InputError: the study has not been done on `val`.
    """
    condition_path = config.results / "val" / f"main-shift{config.shifts[0]:g}.json"
    if not condition_path.exists():
        raise InputError(f"{condition_path}: is missing; run the study with --split val first, epsilon is chosen there")

    # With equal success, the first epsilon is chosen.
    rows_by_epsilon = load_condition(condition_path).rows_by_epsilon("residual")
    return max(rows_by_epsilon, key=lambda epsilon: rows_by_epsilon[epsilon].sr.mean)


def _measure_full_condition(
    evaluated_run: EvaluatedRun, shift: float, runner: TrialRunner, plain_outcomes: dict[Trial, EpisodeOutcome]
) -> FullCondition:
    """Evaluate sTDE and its controls with all gaps, and combine them with the outcomes without sTDE."""
    config = runner.config
    episodes = evaluated_run.episodes

    # On `test`, only the epsilon chosen on `val` is evaluated.
    if config.split == "test":
        chosen_epsilon = best_val_epsilon(config)
        epsilons = {chosen_epsilon}
    else:
        chosen_epsilon = None
        epsilons = set(config.epsilon)
        for options in STDE_OPTIONS.values():
            epsilons.add(options.epsilon)

    # Every gap is compared with the same outcomes without sTDE.
    outcomes_by_gap = {}
    for gap in GAPS:
        stde_outcomes = _run_stde_trials(evaluated_run, gap, runner, sorted(epsilons))
        outcomes_by_gap[gap] = TrialOutcomes(plain_outcomes | stde_outcomes, episodes)

    # The gap has no effect without sTDE, so those rows are listed once.
    novelty_outcomes = outcomes_by_gap["novelty"]
    trial_rows = novelty_outcomes.trial_rows("novelty")
    for gap in GAPS[1:]:
        for row in outcomes_by_gap[gap].trial_rows(gap):
            if row.trial.variant == "stde":
                trial_rows.append(row)

    # Similarity and effects by scene are reported for the gap of the paper.
    success_relation, gains = _relate_to_similarity(evaluated_run, novelty_outcomes)
    return FullCondition(
        shift=shift,
        world=evaluated_run.world.scenes[0].world,
        scenes=len(episodes.scenes),
        rows=tuple(trial_rows),
        episodes=len(episodes.goal),
        parameters=evaluated_run.num_parameters,
        chosen=chosen_epsilon,
        similarity=success_relation,
        gains=gains,
        effects=novelty_outcomes.scene_effects(Trial("stde", "argmax", *PAPER_THRESHOLD), Trial("layout")),
    )


def _plain_trials(decodings: Sequence[Decoding], with_baseline: bool) -> list[Trial]:
    """List the trials without sTDE."""
    variants: tuple[TrialVariant, ...] = ("baseline", "layout", "tde") if with_baseline else ("layout", "tde")
    plain_trials = []
    for variant, decoding in itertools.product(variants, decodings):
        plain_trials.append(Trial(variant, decoding))
    return plain_trials


def _run_stde_trials(
    evaluated_run: EvaluatedRun, gap: GapName, runner: TrialRunner, epsilons: Sequence[float]
) -> dict[Trial, EpisodeOutcome]:
    """Run sTDE and its controls with one gap.

    The gap `novelty` also sweeps the epsilons; the gap `clock` is a control itself and has no others.
    """
    # sTDE itself, then the sweep of epsilon with best actions.
    all_options = STDE_OPTIONS.values()
    stde_trials = []
    for options, decoding in itertools.product(all_options, DECODINGS):
        stde_trials.append(Trial("stde", decoding, *options))
    if gap == "novelty":
        for form, epsilon in itertools.product(SWEPT_FORMS, epsilons):
            stde_trials.append(Trial("stde", "argmax", epsilon, form))
    if gap == "clock":
        return runner.run_trials_with_gap(evaluated_run, gap, stde_trials)

    # Controls that do not depend on the outcomes of others run together with sTDE.
    for options, (control, decoding) in itertools.product(all_options, STDE_CONTROLS):
        stde_trials.append(Trial("stde", decoding, *options, control))
    stde_outcomes = runner.run_trials_with_gap(evaluated_run, gap, stde_trials)

    # The control `constant` removes as much as sTDE does on average.
    constant_trials = []
    for options in all_options:
        weight = mean_removal_weight(stde_outcomes[Trial("stde", "argmax", *options)])
        constant_trials.append(Trial("stde", "argmax", *options, "constant", weight=weight))
    return stde_outcomes | runner.run_trials_with_gap(evaluated_run, gap, constant_trials)


def _relate_to_similarity(evaluated_run: EvaluatedRun, outcomes: TrialOutcomes) -> tuple[SuccessBySimilarity, Gains]:
    """Relate the success of the baseline, and gains over it, to layout similarity."""
    # Priors [N, K, K] of the room type of each scene.
    policies, world, episodes = evaluated_run
    bank = world.banks[0]
    room = np.asarray(world.make_env_params(0).room)[: len(bank.names)]
    prior = np.asarray(policies.prior_counts, np.float64)[room]

    # Points are scenes and goal categories with their similarity.
    points = compute_similarity_points(episodes, cooccurrence_counts(bank), prior)
    baseline_success = outcomes.success(Trial("baseline"))

    def gain(trial: Trial) -> GainBySimilarity:
        return relate_gain_to_similarity(points, baseline_success, outcomes.success(trial), world.env.categories)

    gains = Gains(layout=gain(Trial("layout")), stde=gain(Trial("stde", "argmax", *PAPER_THRESHOLD)))
    return relate_success_to_similarity(points, baseline_success), gains
