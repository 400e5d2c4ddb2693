"""Removal in a mixed population: how much value of experience it keeps, and how much of the cost it recovers.

Half of the episodes are in scenes laid out as in training, half in shifted ones, and no agent knows which. A removal is
worth its gain over the whole mixture. A gap is worth its gain over controls: the gap of another episode of the mixture,
the mean gap of all episodes at the same time, and clocks.

`measure_mixture` evaluates the removals of a run and their controls. `PopulationMetrics` compares outcomes, at each
shift and over the mixture.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome, episode_metrics
from jaxnav.evaluation.report import Decoding, remaining_share
from jaxnav.evaluation.statistics import Clusters, Interval, mean_interval, paired_difference
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import GapName, estimators_by_gap, load_policies
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, concatenate_worlds
from jaxnav.scenes.worlds import WORLDS
from jaxnav.study.config import StudyConfig
from jaxnav.study.measure import (
    EvaluatedRun,
    TrialRunner,
    draw_study_episodes,
    mean_removal_weight,
    require_estimator_config,
)
from jaxnav.study.records import (
    ControlComparison,
    GapSchedule,
    IntervalsByShift,
    MixtureReport,
    RemovalReport,
    StdeOptions,
    Trial,
    TrialControl,
)

#: Gaps of the constant controls.
CONSTANT_GAPS = (0.25, 0.5, 0.75)
#: Times of the clocks, as shares of the world's second action budget: all experience is removed after, or until, that
#: time. They are below 1, because a later removal cannot change success within the budget.
CLOCK_TIMES = (0.1, 0.25, 0.5)
#: Name of the removal that knows the shift: all experience is removed at every shift but the first.
ORACLE_NAME = "told the shift"


class RemovalRule(NamedTuple):
    """A rule of soft removal.

    Attributes:
      gap: name of the layout gap.
      hold: True if the gap never falls within an episode.
      options: threshold and form of sTDE.
    """

    gap: GapName
    hold: bool
    options: StdeOptions

    def __str__(self) -> str:
        suffix = " held" if self.hold else ""
        return f"{self.gap}{suffix}, {self.options.form}, eps {self.options.epsilon:g}"


#: Soft removal by every gap, then switches that hand over for the rest of the episode.
REMOVAL_RULES = (
    RemovalRule("novelty", False, StdeOptions(0.5, "residual")),
    RemovalRule("novelty", False, StdeOptions(0.0, "paper")),
    RemovalRule("evidence", False, StdeOptions(0.0, "paper")),
    RemovalRule("learned", False, StdeOptions(0.0, "paper")),
    RemovalRule("overdue", False, StdeOptions(0.0, "paper")),
    RemovalRule("evidence", True, StdeOptions(0.5, "switch")),
    RemovalRule("overdue", True, StdeOptions(0.5, "switch")),
    RemovalRule("learned", True, StdeOptions(0.75, "switch")),
)
#: Controls of each form. A mean gap is not a switch, so `course` does not apply there.
CONTROLS_BY_FORM: Mapping[Form, tuple[TrialControl | GapSchedule, ...]] = {
    "residual": ("shuffled", "course"),
    "paper": ("shuffled", "course"),
    "switch": ("shuffled",),
}


def measure_mixture(
    run: RunConfig,
    without: RunConfig,
    decoding: Decoding,
    runner: TrialRunner,
    console: Console,
    rules: Sequence[RemovalRule] = REMOVAL_RULES,
    *,
    hand_over: bool = False,
) -> MixtureReport:
    """Evaluate removals and their controls in a mixed population.

    Args:
      run: a finished run with the layout arm.
      without: a finished run of agents that cannot know any layout, with as many seeds.
      decoding: rule that turns logits into actions.
      runner: runs the trials.
      console: prints progress.
      rules: rules of soft removal, in addition to TDE and clocks.
      hand_over: True if removal hands over to the agents of `without`; False if it leaves the run's own direct effect.

    Raises:
      InputError: a run is not finished, they differ in world, goals or number of seeds, cannot hand over, or see
        `draw_mixed_population`.
    """
    # Paired comparisons need the same episodes and as many training runs on both sides.
    for setting_name in ("world", "scenes", "worlds", "task", "seeds"):
        if getattr(run, setting_name) != getattr(without, setting_name):
            raise InputError(f"{run.run_dir} and {without.run_dir} differ in {setting_name}; train both alike")
    config = runner.config
    budgets = WORLDS[run.world].budgets
    shifts = (config.shifts[0], config.shifts[-1])

    # Both runs meet the same episodes.
    world, episodes, shift_index = draw_mixed_population(run, shifts, config, console)
    unaware_run = EvaluatedRun(load_policies(without, ("baseline",)), world, episodes)
    policies = load_policies(run, ("layout",))
    if hand_over:
        policies = policies.with_handover_to(unaware_run.policies)
    evaluated_run = EvaluatedRun(policies, world, episodes)
    estimator = require_estimator_config(policies)

    # References and clocks are evaluated once, for all rules.
    (unaware_outcome,) = runner.run_trials(unaware_run, None, [Trial("baseline", decoding)])
    console.print("TDE and clocks")
    clocks = clock_trials(decoding, budgets[-1])
    plain_trials = [Trial("layout", decoding), Trial("tde", decoding), *clocks.values()]
    plain_outcome, tde_outcome, *clock_outcomes = runner.run_trials(evaluated_run, estimator, plain_trials)
    outcome_by_clock = dict(zip(clocks, clock_outcomes, strict=True))

    # Hard removal, the oracle and the clocks need no estimate of the shift from the views of an episode.
    metrics = PopulationMetrics(episodes, shift_index, budgets)
    references = _References(
        metrics=metrics,
        unaware=metrics.percent_metrics(unaware_outcome),
        agent=metrics.percent_metrics(plain_outcome),
    )
    clock_reports = list(itertools.starmap(references.report_removal, outcome_by_clock.items()))
    reports = [
        references.report_removal("TDE", tde_outcome),
        references.report_removal(ORACLE_NAME, metrics.oracle_removal(plain_outcome, tde_outcome)),
        *clock_reports,
    ]

    # Every rule is compared with its own controls and with the best clock.
    score_name = f"sr@{budgets[-1]}"
    best_clock = max(clock_reports, key=lambda report: report.mixture[score_name].mean).name
    for rule in rules:
        console.print(str(rule))
        rule_estimator = dataclasses.replace(estimators_by_gap(estimator)[rule.gap], hold=rule.hold)
        controls = CONTROLS_BY_FORM[rule.options.form]
        trial = Trial("stde", decoding, *rule.options)
        control_trials = []
        for control in controls:
            control_trials.append(dataclasses.replace(trial, control=control))
        rule_outcome, *control_outcomes = runner.run_trials(evaluated_run, rule_estimator, [trial, *control_trials])
        compared_outcomes = dict(zip(controls, control_outcomes, strict=True)) | {
            best_clock: outcome_by_clock[best_clock]
        }
        reports.append(references.report_removal(str(rule), rule_outcome, compared_outcomes))

    # Scenes and episodes are counted per shift, and lengths are those without removal.
    plain_lengths = metrics.by_shift(np.asarray(plain_outcome.length))
    return MixtureReport(
        run=run.run_dir.name,
        heir=without.run_dir.name if hand_over else None,
        decoding=decoding,
        world=world.scenes[0].world,
        shifts=shifts,
        scenes=len(episodes.scenes) // len(shifts),
        episodes=len(episodes.goal) // len(shifts),
        length=tuple(float(np.median(lengths)) for lengths in plain_lengths),
        without=metrics.means(references.unaware),
        agent=metrics.means(references.agent),
        lead=metrics.differences(references.unaware, references.agent, same_runs=False),
        removals=tuple(reports),
    )


def clock_trials(decoding: Decoding, budget: int) -> dict[str, Trial]:
    """List the removals that depend on nothing in the episode, by name.

    They are constant gaps, and removal of all experience after or until a time, as a share of an action budget.
    """
    # A constant gap removes the same share of experience at every step.
    trials_by_name = {}
    for constant_gap in CONSTANT_GAPS:
        trials_by_name[f"constant {constant_gap:g}"] = Trial(
            "stde", decoding, 0.0, "paper", "constant", weight=constant_gap
        )

    # A clock removes all experience on one side of a step.
    for control in ("after", "until"):
        for time_share in CLOCK_TIMES:
            clock_step = round(time_share * budget)
            trials_by_name[f"{control} step {clock_step}"] = Trial("stde", decoding, 0.0, "paper", control, clock_step)
    return trials_by_name


class MixedPopulation(NamedTuple):
    """Episodes of several shifts in one world.

    Attributes:
      world: the scenes of all shifts, concatenated.
      episodes: equally many episodes at each shift.
      shift: int [E], index of each episode's shift.
    """

    world: CompiledWorld
    episodes: EpisodeList
    shift: np.ndarray


def draw_mixed_population(
    run: RunConfig, shifts: Sequence[float], config: StudyConfig, console: Console
) -> MixedPopulation:
    """Draw episodes at every shift.

    Args:
      run: the run whose scenes are used.
      shifts: layout shifts.
      config: split of the scenes, number of episodes at each shift, and the seed of their draw.
      console: prints progress.

    Raises:
      InputError: see `compile_evaluation_world` and `concatenate_worlds`.
    """
    # All worlds are compiled before any episode is drawn; a study has one bank in each.
    worlds = []
    for shift in shifts:
        worlds.append(compile_evaluation_world(run, config.split, None, shift, console))

    # The episodes of each shift follow each other, as the poses of the concatenated bank do.
    episode_lists = []
    num_episodes = []
    num_poses = []
    for world in worlds:
        episodes = draw_study_episodes(world, config)
        episode_lists.append(episodes)
        num_episodes.append(len(episodes.pose))
        num_poses.append(len(world.banks[0].rows))

    return MixedPopulation(
        world=concatenate_worlds(worlds),
        episodes=join_end_to_end(episode_lists, num_poses),
        shift=np.repeat(np.arange(len(shifts)), num_episodes),
    )


def join_end_to_end(lists: Sequence[EpisodeList], num_poses: Sequence[int]) -> EpisodeList:
    """Join the episode lists of banks that were concatenated into one bank.

    Args:
      lists: one list per bank.
      num_poses: number of poses of each bank.
    """
    # Poses of a bank follow those of the banks before it.
    first_poses = np.cumsum([0, *num_poses[:-1]])
    joined_poses = []
    for episodes, first_pose in zip(lists, first_poses, strict=True):
        joined_poses.append(episodes.pose + first_pose)
    return join_episode_lists(lists)._replace(pose=np.concatenate(joined_poses).astype(np.int32))


#: Results [S, E] by name of the metric.
MetricValues = Mapping[str, np.ndarray]


class EpisodeSubset(NamedTuple):
    """The episodes of one shift.

    Attributes:
      mask: bool [E].
      scenes: clusters of these episodes.
    """

    mask: np.ndarray
    scenes: Clusters


class PopulationMetrics:
    """Metrics of outcomes in a mixed population, and their differences.

    Args:
      episodes: episodes of the population.
      shift: int [E], index of each episode's shift.
      budgets: action budgets N of the additional metrics `sr@N`.
    """

    def __init__(self, episodes: EpisodeList, shift: np.ndarray, budgets: Sequence[int]) -> None:
        self.metric_names = ("sr", "spl", *(f"sr@{budget}" for budget in budgets))
        self._episodes = episodes
        self._budgets = budgets
        self._clusters = episodes.clusters()

        # Each shift has clusters of its own, and so intervals of its own.
        self._subsets = []
        for index in range(shift.max() + 1):
            mask = shift == index
            self._subsets.append(EpisodeSubset(mask, episodes.take(mask).clusters()))

    def percent_metrics(self, outcome: EpisodeOutcome) -> MetricValues:
        """Compute the metrics of an outcome in percent, [S, E]."""
        metrics = episode_metrics(outcome, self._episodes.best_length, self._budgets)
        return {name: 100.0 * metrics[name] for name in self.metric_names}

    def oracle_removal(self, plain: EpisodeOutcome, hard: EpisodeOutcome) -> EpisodeOutcome:
        """Combine outcomes into hard removal at all shifts but the first."""
        is_first_shift = self._subsets[0].mask
        return jax.tree.map(lambda plain_leaf, hard_leaf: np.where(is_first_shift, plain_leaf, hard_leaf), plain, hard)

    def removal_weights(self, outcome: EpisodeOutcome) -> tuple[float, ...]:
        """Average the weight of the removed logits at each shift."""
        weights = []
        for subset in self._subsets:
            # The mean needs only the choices and their weights, both [S, E].
            subset_outcome = outcome._replace(
                choices=outcome.choices[:, subset.mask], mean_weight=outcome.mean_weight[:, subset.mask]
            )
            weights.append(mean_removal_weight(subset_outcome))
        return tuple(weights)

    def by_shift(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Split values [..., E] by shift."""
        return tuple(values[..., subset.mask] for subset in self._subsets)

    def means(self, values: MetricValues) -> dict[str, IntervalsByShift]:
        """Average each metric at each shift."""
        return self._for_each_shift(mean_interval, values)

    def differences(
        self, reference: MetricValues, compared: MetricValues, *, same_runs: bool
    ) -> dict[str, IntervalsByShift]:
        """Compute `compared - reference` for each metric at each shift."""

        def difference(reference: np.ndarray, compared: np.ndarray, scenes: Clusters) -> Interval:
            return paired_difference(reference, compared, scenes, same_runs=same_runs)

        return self._for_each_shift(difference, reference, compared)

    def remaining_shares(
        self, unaware: MetricValues, agent: MetricValues, removed: MetricValues
    ) -> dict[str, IntervalsByShift]:
        """Compute the share of the lead that remains after removal, for each metric at each shift."""
        return self._for_each_shift(remaining_share, unaware, agent, removed)

    def overall_differences(self, reference: MetricValues, compared: MetricValues) -> dict[str, Interval]:
        """Compute `compared - reference` of the same policies over all episodes, for each metric."""
        differences = {}
        for name in self.metric_names:
            differences[name] = paired_difference(reference[name], compared[name], self._clusters, same_runs=True)
        return differences

    def _for_each_shift(self, statistic: Callable[..., Interval], *sides: MetricValues) -> dict[str, IntervalsByShift]:
        """Compute a statistic of the results [S, E] of several sides, for each metric at each shift."""
        # Metric by metric, with the clusters of each shift.
        intervals_by_metric = {}
        for name in self.metric_names:
            intervals = []
            for subset in self._subsets:
                side_results = [side[name][:, subset.mask] for side in sides]
                intervals.append(statistic(*side_results, subset.scenes))
            intervals_by_metric[name] = tuple(intervals)
        return intervals_by_metric


class _References(NamedTuple):
    """Results that every removal is compared with.

    Attributes:
      metrics: computes and compares metrics.
      unaware: results of the agent without experience.
      agent: results of the agent with experience, without removal.
    """

    metrics: PopulationMetrics
    unaware: MetricValues
    agent: MetricValues

    def report_removal(
        self, name: str, outcome: EpisodeOutcome, controls: Mapping[str, EpisodeOutcome] | None = None
    ) -> RemovalReport:
        """Report the outcome of one removal.

        Args:
          name: name of the removal.
          outcome: its outcome.
          controls: outcomes of its controls, by name; None for a removal that is a control itself.
        """
        # The gain over each control is measured over the whole mixture.
        metrics = self.metrics
        removed = metrics.percent_metrics(outcome)
        compared_controls = {}
        for control_name, control_outcome in (controls or {}).items():
            control_metrics = metrics.percent_metrics(control_outcome)
            compared_controls[control_name] = ControlComparison(
                weight=metrics.removal_weights(control_outcome),
                gained=metrics.overall_differences(control_metrics, removed),
            )

        # The removal uses the networks of the agent, so both are paired by run.
        return RemovalReport(
            name=name,
            weight=metrics.removal_weights(outcome),
            change=metrics.differences(self.agent, removed, same_runs=True),
            mixture=metrics.overall_differences(self.agent, removed),
            left=metrics.remaining_shares(self.unaware, self.agent, removed),
            compared=compared_controls or None,
        )
