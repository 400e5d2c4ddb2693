"""Removal in a mixed population: how much value of experience it keeps, and how much of the cost it recovers.

Half of the episodes are in scenes with the training layout, half in shifted scenes, and no agent knows which. A removal
is worth its gain over the whole mixture. A gap is worth its gain over controls: the gap of another episode of the
mixture, the mean gap of all episodes at the same time, evidence of permuted categories, and removals that follow no
gap.

`measure_removals` evaluates the removals of a run and their controls, whichever decision remains: the own one of the
run, that of layout-blind agents, or that of the network without experience. `PopulationMetrics` compares outcomes, at
each shift and over the mixture.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import numpy as np

from jaxnav.choices import Decoding, Form, GapName
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome, episode_metrics
from jaxnav.evaluation.report import remaining_share
from jaxnav.evaluation.statistics import Clusters, Interval, mean_interval, paired_difference
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import AgentRun, matches_any
from jaxnav.experiments.scores import require_layout_blind_run
from jaxnav.experiments.table import ResultRow
from jaxnav.experiments.trials import (
    EvaluatedRun,
    GapSchedule,
    StdeOptions,
    Trial,
    TrialControl,
    TrialRunner,
    mean_removal_weight,
    require_estimator_config,
)
from jaxnav.layout import EstimatorConfig
from jaxnav.runs.policies import EVIDENCE_GAPS, estimators_by_gap, load_policies
from jaxnav.runs.worlds import CompiledWorld, concatenate_worlds
from jaxnav.scenes.worlds import WORLDS

NamedRemoval = TypeVar("NamedRemoval")

#: Decision that remains once experience is removed: that of the run's counterfactual logits, of the layout-blind
#: agents, or of the same network under do(Z = 0).
RemainingDecision = Literal["own", "layout-blind", "without experience"]

#: Variants of the agents that removals are compared with.
LAYOUT_BLIND = "layout-blind agents"
WITHOUT_REMOVAL = "without removal"
#: Gaps of the constant controls.
CONSTANT_GAPS = (0.25, 0.5, 0.75)
#: Times of the clocks, as shares of the world's second action budget: all experience is removed after, or until, that
#: time. They are below 1, because a later removal cannot change success within the budget.
CLOCK_TIMES = (0.1, 0.25, 0.5)
#: Name of the removal that is given the shift: all experience is removed at every shift but the first.
ORACLE_NAME = "oracle removal"


#: Controls of complete removal: the removed logits are counterfactual logits with a part of another episode.
HARD_CONTROLS: Mapping[str, TrialControl] = {
    "TDE, other categories of another episode": "other_categories",
    "TDE, experience of another episode": "other_experience",
    "TDE, memory of another episode": "other_memory",
}


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


#: Soft removal by every gap, then switches, which with `held` hand over for the rest of the episode. Runs that lack the
#: evidence of a gap leave out its rules.
REMOVAL_RULES = (
    RemovalRule("novelty", False, StdeOptions(0.5, "residual")),
    RemovalRule("novelty", False, StdeOptions(0.0, "paper")),
    RemovalRule("evidence", False, StdeOptions(0.0, "paper")),
    RemovalRule("learned", False, StdeOptions(0.0, "paper")),
    RemovalRule("surprise", False, StdeOptions(0.0, "paper")),
    RemovalRule("surprise", False, StdeOptions(0.0, "mixture")),
    RemovalRule("overdue", False, StdeOptions(0.0, "paper")),
    RemovalRule("evidence", True, StdeOptions(0.5, "switch")),
    RemovalRule("overdue", True, StdeOptions(0.5, "switch")),
    RemovalRule("surprise", False, StdeOptions(0.5, "switch")),
    RemovalRule("learned", True, StdeOptions(0.75, "switch")),
)
#: Controls of each form. A mean gap is not a switch, so `course` does not apply there.
CONTROLS_BY_FORM: Mapping[Form, tuple[TrialControl | GapSchedule, ...]] = {
    "residual": ("shuffled", "course"),
    "paper": ("shuffled", "course"),
    "mixture": ("shuffled", "course"),
    "switch": ("shuffled",),
}
#: Control whose evidence has permuted categories, for the gaps that read evidence.
PERMUTED_CONTROL = "permuted evidence"


class RemovalOutcomes(NamedTuple):
    """Outcomes of a run and its removals on the E episodes of a mixed population; outcomes have leaves [S, E].

    Attributes:
      reference: outcome of the agents without experience: layout-blind ones or, where scores are a sum, the run itself
        after complete removal.
      plain: outcome of the run without removal.
      hard: outcome of complete removal.
      fixed: outcomes of the removals that follow no gap, by name.
      hard_controls: outcomes of the controls of complete removal, by name.
      rules: outcomes of soft removal, by rule.
      rule_controls: outcomes of the controls of each rule, by rule and control.
    """

    reference: EpisodeOutcome
    plain: EpisodeOutcome
    hard: EpisodeOutcome
    fixed: dict[str, EpisodeOutcome]
    hard_controls: dict[str, EpisodeOutcome]
    rules: dict[str, EpisodeOutcome]
    rule_controls: dict[str, dict[str, EpisodeOutcome]]


def measure_removals(
    bench: Bench,
    run: AgentRun,
    decoding: Decoding,
    remaining: RemainingDecision,
    rules: Sequence[RemovalRule] = REMOVAL_RULES,
) -> Iterator[ResultRow]:
    """Evaluate removals of experience and their controls on a mixed population.

    Args:
      bench: trains the runs and compiles their worlds.
      run: the run, with the layout arm.
      decoding: rule that turns logits into actions.
      remaining: decision that remains once experience is removed.
      rules: rules of soft removal, in addition to TDE and removals that follow no gap.

    Raises:
      InputError: there are no layout-blind agents, or they differ in world, goals or number of seeds; runs whose scores
        are a sum need none. Or a run without experience dropout shall leave the decision without experience.
    """
    budgets = WORLDS[run.config.world].budgets
    shifts = (bench.config.shifts[0], bench.config.shifts[-1])

    # Each fold has its own scenes and policies. Training run s of the dataset joins seed s of all folds.
    populations = []
    fold_outcomes = []
    for fold_run in run.fold_runs:
        population = draw_mixed_population(bench, fold_run, shifts, num_folds=len(run.fold_runs))
        populations.append(population)
        fold_outcomes.append(_run_removals(bench, fold_run, population, decoding, rules, remaining))
    episodes = join_episode_lists([population.episodes for population in populations])
    shift_index = np.concatenate([population.shift_index for population in populations])
    outcomes = RemovalOutcomes(*map(_join_outcomes, zip(*fold_outcomes, strict=True)))

    # Values of the agents themselves.
    metrics = PopulationMetrics(episodes, shift_index, budgets)
    run_names = {
        "own": run.agent,
        "layout-blind": f"{run.agent}, handed over to {bench.config.reference_agent}",
        "without experience": f"{run.agent}, without experience",
    }
    report = _RemovalReport(
        fields={"world": run.world, "run": run_names[remaining], "decoding": decoding},
        shifts=shifts,
        metrics=metrics,
        reference=metrics.percent_metrics(outcomes.reference),
        agent=metrics.percent_metrics(outcomes.plain),
        same_runs=remaining == "own" and run.config.policy_method.has_additive_scores,
        num_scenes=len(episodes.scenes) // len(shifts),
    )
    yield from report.agent_rows()
    plain_lengths = metrics.by_shift(np.asarray(outcomes.plain.length))
    for shift, lengths in zip(shifts, plain_lengths, strict=True):
        yield report.row("length", Interval(float(np.median(lengths))), variant=WITHOUT_REMOVAL, shift=shift)

    # Hard removal, the oracle and the removals that follow no gap need no estimate of the shift from the views.
    yield from report.removal_rows("CDE" if remaining == "without experience" else "TDE", outcomes.hard)
    yield from report.removal_rows(ORACLE_NAME, metrics.oracle_removal(outcomes.plain, outcomes.hard))
    for name, outcome in (outcomes.fixed | outcomes.hard_controls).items():
        yield from report.removal_rows(name, outcome)

    # Every rule is compared with its own controls and with the best removal that follows no gap. The latter is chosen
    # on these very episodes, so the comparison favours the control.
    best_fixed = {}
    if outcomes.fixed:
        best_name = max(outcomes.fixed, key=lambda name: report.mixture_gain(outcomes.fixed[name], budgets[-1]))
        best_fixed = {best_name: outcomes.fixed[best_name]}
    for name, outcome in outcomes.rules.items():
        yield from report.removal_rows(name, outcome, outcomes.rule_controls[name] | best_fixed)


def _join_outcomes(parts: Sequence[Any]) -> Any:
    """Join the outcomes of folds along their episodes.

    Of dictionaries of outcomes, the names that all folds have are kept: a fold may lack the evidence of a gap.
    """
    if isinstance(parts[0], dict):
        joined = {}
        for name in parts[0]:
            if all(name in part for part in parts):
                joined[name] = _join_outcomes([part[name] for part in parts])
        return joined
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)


class _ResumableTrials:
    """Runs trials of a run, unless an interrupted call finished them.

    Args:
      bench: keeps the outcomes of a part that is not finished.
      run_name: name of the run, which is part of the names of kept outcomes.
    """

    def __init__(self, bench: Bench, run_name: str) -> None:
        self._bench = bench
        self._run_name = run_name
        self._runner = TrialRunner(bench.config.seed)

    def run(
        self, name: str, evaluated_run: EvaluatedRun, estimator: EstimatorConfig | None, trials: Iterable[Trial]
    ) -> dict[Trial, EpisodeOutcome]:
        """Run trials under a name that is unique in the part."""
        distinct_trials = list(dict.fromkeys(trials))

        def measure() -> list[EpisodeOutcome]:
            outcomes = self._runner.run_trials(evaluated_run, estimator, distinct_trials)
            return [outcomes[trial] for trial in distinct_trials]

        outcomes = self._bench.recall_outcomes(f"{self._run_name}: {name}", measure)
        return dict(zip(distinct_trials, outcomes, strict=True))


def _run_removals(
    bench: Bench,
    run: AgentRun,
    population: "MixedPopulation",
    decoding: Decoding,
    rules: Sequence[RemovalRule],
    remaining: RemainingDecision,
) -> RemovalOutcomes:
    """Run the removals of a run and their controls in a mixed population; see `measure_removals`."""
    # Where scores are a sum, complete removal leaves an agent without any experience, and no other agent is needed.
    # Else the layout-blind agents meet the same episodes, in as many training runs.
    world, episodes, _ = population
    layout_blind = None
    if not (remaining == "own" and run.config.policy_method.has_additive_scores):
        layout_blind_run = require_layout_blind_run(bench, run)
        bench.train(layout_blind_run)
        layout_blind = EvaluatedRun(load_policies(layout_blind_run.config, ("baseline",)), world, episodes)

    # Policies of the run, with the decision that removal leaves.
    bench.train(run)
    policies = load_policies(run.config, ("layout",))
    match remaining:
        case "layout-blind":
            assert layout_blind is not None
            policies = policies.with_handover_to(layout_blind.policies)
        case "without experience":
            policies = policies.with_own_fallback()
    evaluated_run = EvaluatedRun(policies, world, episodes)
    estimator = require_estimator_config(policies)
    trials = _ResumableTrials(bench, run.name)

    # References and removals that follow no gap are evaluated once, for all rules.
    bench.console.print("complete removal and removals that follow no gap")
    all_fixed_trials = list_fixed_trials(decoding, WORLDS[run.config.world].budgets[-1])
    fixed_trials = select_removals(all_fixed_trials, bench.config.removals)
    plain_trial = Trial("layout", decoding)
    hard_trial = Trial("tde", decoding)
    outcomes = trials.run("plain", evaluated_run, estimator, [plain_trial, hard_trial, *fixed_trials.values()])
    reference_outcome = outcomes[hard_trial]
    if layout_blind is not None:
        baseline_trial = Trial("baseline", decoding)
        reference_outcome = trials.run("layout-blind", layout_blind, None, [baseline_trial])[baseline_trial]

    hard_controls = {}
    if remaining == "own":
        hard_controls = _run_hard_controls(bench, trials, evaluated_run, estimator, decoding)
    rule_outcomes, rule_controls = _run_rules(bench, trials, evaluated_run, estimator, decoding, rules)
    return RemovalOutcomes(
        reference=reference_outcome,
        plain=outcomes[plain_trial],
        hard=outcomes[hard_trial],
        fixed={name: outcomes[trial] for name, trial in fixed_trials.items()},
        hard_controls=hard_controls,
        rules=rule_outcomes,
        rule_controls=rule_controls,
    )


def _run_hard_controls(
    bench: Bench,
    trials: _ResumableTrials,
    evaluated_run: EvaluatedRun,
    estimator: EstimatorConfig,
    decoding: Decoding,
) -> dict[str, EpisodeOutcome]:
    """Run complete removal of counterfactual logits that know nothing of a part of this episode."""
    control_trials = {}
    for name, control in select_removals(HARD_CONTROLS, bench.config.removals).items():
        control_trials[name] = Trial("tde", decoding, control=control)
    control_outcomes = trials.run("controls", evaluated_run, estimator, control_trials.values())
    hard_controls = {name: control_outcomes[trial] for name, trial in control_trials.items()}

    # A counterfactual memory of its own is compared with the factual one.
    policies = evaluated_run.policies
    if policies.spec.counterfactual_memory == "own":
        factual_run = evaluated_run._replace(policies=policies.with_counterfactual_memory("factual"))
        hard_trial = Trial("tde", decoding)
        factual_outcomes = trials.run("factual memory", factual_run, estimator, [hard_trial])
        hard_controls["TDE, factual memory"] = factual_outcomes[hard_trial]
    return hard_controls


def _run_rules(
    bench: Bench,
    trials: _ResumableTrials,
    evaluated_run: EvaluatedRun,
    estimator: EstimatorConfig,
    decoding: Decoding,
    rules: Sequence[RemovalRule],
) -> tuple[dict[str, EpisodeOutcome], dict[str, dict[str, EpisodeOutcome]]]:
    """Run soft removal by each gap, with the controls of its form; rules of unsupported gaps are left out.

    Returns:
      The outcome of each rule by its name, and those of its controls.
    """
    policies = evaluated_run.policies
    permuted_run = evaluated_run._replace(policies=policies.with_permuted_evidence(bench.config.seed))
    rule_outcomes = {}
    rule_controls = {}
    for name, rule in select_removals({str(rule): rule for rule in rules}, bench.config.removals).items():
        if not policies.supports_gap(rule.gap):
            bench.console.print(f"{rule}: left out, for the run has no evidence for this gap; train it again")
            continue
        bench.console.print(name)
        rule_estimator = dataclasses.replace(estimators_by_gap(estimator)[rule.gap], hold=rule.hold)
        trial = Trial("stde", decoding, *rule.options)
        controls: dict[str, Trial] = {}
        for control in CONTROLS_BY_FORM[rule.options.form]:
            controls[control] = dataclasses.replace(trial, control=control)
        trial_outcomes = trials.run(name, evaluated_run, rule_estimator, [trial, *controls.values()])
        rule_outcomes[name] = trial_outcomes[trial]
        rule_controls[name] = {control: trial_outcomes[control_trial] for control, control_trial in controls.items()}
        if rule.gap in EVIDENCE_GAPS:
            permuted_outcomes = trials.run(f"{name}, permuted", permuted_run, rule_estimator, [trial])
            rule_controls[name][PERMUTED_CONTROL] = permuted_outcomes[trial]
    return rule_outcomes, rule_controls


def list_removal_names() -> list[str]:
    """List the names of the removals that `removals` can select; those of clocks depend on the world's budget."""
    fixed_names = []
    for world in WORLDS.values():
        fixed_names += list_fixed_trials("sample", world.budgets[-1])
    return [*map(str, REMOVAL_RULES), *dict.fromkeys(fixed_names), *HARD_CONTROLS]


def select_removals(removals: Mapping[str, NamedRemoval], patterns: tuple[str, ...]) -> dict[str, NamedRemoval]:
    """Select the removals whose names match one of several patterns."""
    return {name: removal for name, removal in removals.items() if matches_any(name, patterns)}


def list_fixed_trials(decoding: Decoding, budget: int) -> dict[str, Trial]:
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
            trials_by_name[f"{control} step {clock_step}"] = Trial(
                "stde", decoding, epsilon=0.0, form="paper", control=control, step=clock_step
            )
    return trials_by_name


class MixedPopulation(NamedTuple):
    """Episodes of several shifts in one world.

    Attributes:
      compiled_world: the scenes of all shifts, concatenated.
      episodes: equally many episodes at each shift.
      shift_index: int [E], index of each episode's shift.
    """

    compiled_world: CompiledWorld
    episodes: EpisodeList
    shift_index: np.ndarray


def draw_mixed_population(bench: Bench, run: AgentRun, shifts: Sequence[float], num_folds: int = 1) -> MixedPopulation:
    """Draw episodes in the scenes of a run, equally many at every shift; folds share the experiment's episodes."""
    # All worlds are compiled before any episode is drawn; each has one bank.
    worlds = [bench.compile_world(run, shift) for shift in shifts]

    # The episodes of each shift follow each other, as the poses of the concatenated bank do.
    episode_lists = []
    num_episodes = []
    num_poses = []
    for world in worlds:
        episodes = bench.draw_episodes(world, num_folds)
        episode_lists.append(episodes)
        num_episodes.append(len(episodes.pose))
        num_poses.append(len(world.banks[0].rows))

    return MixedPopulation(
        compiled_world=concatenate_worlds(worlds),
        episodes=join_end_to_end(episode_lists, num_poses),
        shift_index=np.repeat(np.arange(len(shifts)), num_episodes),
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
      shift_index: int [E], index of each episode's shift.
      budgets: action budgets N of the additional metrics `sr@N`.
    """

    def __init__(self, episodes: EpisodeList, shift_index: np.ndarray, budgets: Sequence[int]) -> None:
        self.metric_names = ("sr", "spl", *(f"sr@{budget}" for budget in budgets))
        self._episodes = episodes
        self._budgets = budgets
        self._clusters = episodes.clusters()

        # Each shift has clusters of its own, and so intervals of its own.
        self._subsets = []
        for index in range(shift_index.max() + 1):
            mask = shift_index == index
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
            # The mean needs only the decisions and their weights, both [S, E].
            subset_outcome = outcome._replace(
                num_decisions=outcome.num_decisions[:, subset.mask], total_weight=outcome.total_weight[:, subset.mask]
            )
            weights.append(mean_removal_weight(subset_outcome))
        return tuple(weights)

    def by_shift(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Split values [..., E] by shift."""
        return tuple(values[..., subset.mask] for subset in self._subsets)

    def means(self, values: MetricValues) -> dict[str, tuple[Interval, ...]]:
        """Average each metric at each shift."""
        return self._for_each_shift(mean_interval, values)

    def differences(
        self, reference: MetricValues, compared: MetricValues, *, same_runs: bool
    ) -> dict[str, tuple[Interval, ...]]:
        """Compute `compared - reference` for each metric at each shift."""

        def difference(reference: np.ndarray, compared: np.ndarray, scenes: Clusters) -> Interval:
            return paired_difference(reference, compared, scenes, same_runs=same_runs)

        return self._for_each_shift(difference, reference, compared)

    def remaining_shares(
        self, reference: MetricValues, agent: MetricValues, removed: MetricValues, *, same_runs: bool
    ) -> dict[str, tuple[Interval, ...]]:
        """Compute the share of the lead that remains after removal, for each metric at each shift."""
        statistic = functools.partial(remaining_share, same_runs=same_runs)
        return self._for_each_shift(statistic, reference, agent, removed)

    def overall_differences(self, reference: MetricValues, compared: MetricValues) -> dict[str, Interval]:
        """Compute `compared - reference` of the same policies over all episodes, for each metric."""
        differences = {}
        for name in self.metric_names:
            differences[name] = paired_difference(reference[name], compared[name], self._clusters, same_runs=True)
        return differences

    def _for_each_shift(
        self, statistic: Callable[..., Interval], *sides: MetricValues
    ) -> dict[str, tuple[Interval, ...]]:
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


class _RemovalReport(NamedTuple):
    """Makes the rows of a mixed population.

    Attributes:
      fields: fields of all rows.
      shifts: layout shifts of the population.
      metrics: computes and compares metrics.
      reference: results of the agents without experience.
      agent: results of the agent with experience, without removal.
      same_runs: True if both agents are the same training runs.
      num_scenes: number of scenes at each shift.
    """

    fields: Mapping[str, Any]
    shifts: tuple[float, ...]
    metrics: PopulationMetrics
    reference: MetricValues
    agent: MetricValues
    same_runs: bool
    num_scenes: int

    def row(self, metric: str, value: Interval, **fields: Any) -> ResultRow:
        """Make one row."""
        return ResultRow(**{**self.fields, **fields}, metric=metric, value=value, scenes=self.num_scenes)

    def agent_rows(self) -> Iterator[ResultRow]:
        """Make the rows of both agents without removal, and of the lead of one over the other."""
        lead = self.metrics.differences(self.reference, self.agent, same_runs=self.same_runs)
        yield from self._shift_rows(self.metrics.means(self.reference), variant=LAYOUT_BLIND)
        yield from self._shift_rows(self.metrics.means(self.agent), variant=WITHOUT_REMOVAL)
        yield from self._shift_rows(lead, variant=WITHOUT_REMOVAL, reference=LAYOUT_BLIND)

    def removal_rows(
        self, name: str, outcome: EpisodeOutcome, controls: Mapping[str, EpisodeOutcome] | None = None
    ) -> Iterator[ResultRow]:
        """Make the rows of one removal: its weight, its change at each shift and over the mixture, and what it keeps.

        Args:
          name: name of the removal.
          outcome: its outcome.
          controls: outcomes of its controls, by name; None for a removal that is a control itself.
        """
        # The removal uses the networks of the agent, so both are paired by run.
        metrics = self.metrics
        removed = metrics.percent_metrics(outcome)
        fields = {"variant": name, "reference": WITHOUT_REMOVAL}
        yield from self._weight_rows(outcome, variant=name)
        yield from self._shift_rows(metrics.differences(self.agent, removed, same_runs=True), **fields)
        for metric, difference in metrics.overall_differences(self.agent, removed).items():
            yield self.row(metric, difference, **fields)

        # The share of the lead that remains, of a value or a cost.
        shares = metrics.remaining_shares(self.reference, self.agent, removed, same_runs=self.same_runs)
        share_rows = {f"{metric} remaining": by_shift for metric, by_shift in shares.items()}
        yield from self._shift_rows(share_rows, variant=name)

        # The gain over each control is measured over the whole mixture.
        for control, control_outcome in (controls or {}).items():
            control_metrics = metrics.percent_metrics(control_outcome)
            yield from self._weight_rows(control_outcome, variant=name, control=control)
            for metric, gain in metrics.overall_differences(control_metrics, removed).items():
                yield self.row(metric, gain, variant=name, control=control, reference="control")

    def mixture_gain(self, outcome: EpisodeOutcome, budget: int) -> float:
        """Gain of a removal in success within a budget, over the mixture."""
        removed = self.metrics.percent_metrics(outcome)
        return self.metrics.overall_differences(self.agent, removed)[f"sr@{budget}"].mean

    def _weight_rows(self, outcome: EpisodeOutcome, **fields: Any) -> Iterator[ResultRow]:
        for shift, weight in zip(self.shifts, self.metrics.removal_weights(outcome), strict=True):
            yield self.row("weight", Interval(weight), shift=shift, **fields)

    def _shift_rows(self, by_metric: Mapping[str, tuple[Interval, ...]], **fields: Any) -> Iterator[ResultRow]:
        for metric, intervals in by_metric.items():
            for shift, interval in zip(self.shifts, intervals, strict=True):
                yield self.row(metric, interval, shift=shift, **fields)
