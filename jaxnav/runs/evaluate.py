"""Evaluation of runs, policies and agents on fixed episodes.

`evaluate` measures every variant of the run's policies (baseline, layout weights, complete removal of experience, and
soft removal at every epsilon) and returns `Results` with a report of the tables. `measure_leads` compares results with
those of layout-blind agents, and `replay_episodes` plays episodes step by step.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.baselines.shortest_path import run_oracle
from jaxnav.choices import (
    DEFAULT_COSTS,
    DEFAULT_EPSILONS,
    DEFAULT_REMOVALS,
    Costs,
    CounterfactualMemory,
    EstimatorName,
    Form,
    Removal,
    ShiftKind,
)
from jaxnav.errors import InputError, check_choice
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator, start_states
from jaxnav.evaluation.notes import budget_note, convergence_note, decision_share_notes, evaluation_notes
from jaxnav.evaluation.playback import EpisodeTrace, play_episodes
from jaxnav.evaluation.removal import InferenceConfig
from jaxnav.evaluation.report import (
    ExperienceLead,
    build_difference,
    build_report,
    remaining_share,
    row_label,
)
from jaxnav.evaluation.statistics import paired_difference
from jaxnav.evaluation.variants import (
    EvaluationRow,
    Replacement,
    inference_grid,
    replacement_grid,
    share_networks,
    table_row,
    table_rows,
)
from jaxnav.plain_console import PlainConsole, to_plain_console
from jaxnav.policies.methods import method_label
from jaxnav.progress import show_activity
from jaxnav.runs.config import RunConfig
from jaxnav.runs.evaluate_agents import evaluate_agents
from jaxnav.runs.policies import (
    Policies,
)
from jaxnav.runs.results import Results, build_result_rows
from jaxnav.runs.run import run_settings
from jaxnav.runs.share_report import (
    build_decision_shares,
    count_shares,
    limit_room_episodes,
    list_cost_replacements,
    measure_costs,
    rows_with_shares,
)
from jaxnav.runs.subjects import AgentSubject, PolicySubject, find_subject
from jaxnav.runs.worlds import (
    CompiledWorld,
    compile_evaluation_world,
    draw_episode_lists,
    evaluation_shift,
    prefetch_env_params,
)
from jaxnav.scenes.worlds import WORLDS
from jaxnav.store.files import expand_home


def evaluate(
    subject: Any,
    *,
    split: str = "val",
    scenes: str | Path | None = None,
    world: str | None = None,
    shift: float | None = None,
    shift_by: ShiftKind = "size",
    episodes: int = 1000,
    epsilon: float | Sequence[float] | np.ndarray = DEFAULT_EPSILONS,
    form: Form | Sequence[Form] | None = None,
    setting: EstimatorName | None = None,
    hold: bool = False,
    removal: Removal | Sequence[Removal] = DEFAULT_REMOVALS,
    counterfactual_memory: CounterfactualMemory | None = None,
    inner_steps: int | None = None,
    costs: Costs = DEFAULT_COSTS,
    seed: int = 0,
    compiled: CompiledWorld | None = None,
    console: Console | None = None,
) -> Results:
    """Evaluate a run, a policy or an agent of your own on fixed episodes.

    All subjects meet the same episodes. The results of a run have a row for each of its variants; those of an agent
    stand beside Random, frontier search and the shortest path.

    Args:
      subject: one of
        a finished run, or its directory;
        an exported policy: a `LoadedPolicy`, its folder, or the name of a packaged one, such as `rooms-org`;
        an agent: an object with `init` and `act`, an object with `predict`, or a function of a batch of observations;
        a list of agents, one for each training seed;
        `package.module:AGENT`, which names any of them.
        `docs/evaluate_your_agent.md` describes agents and their observations.
      split: split of the scenes.
      scenes: scene file to read in place of the generated scenes, or of those of the run.
      world: generated world; None for `rooms` or the world of the run or policy, whose categories and rules remain.
      shift: layout shift, from 0 to 1; None for the run's, and 0 with `scenes` or `world`.
      shift_by: categories that exchange their places: neighbours in size (`size`), or the ones whose exchange misleads
        most (`context`); see `exchange_places`.
      episodes: number of fixed episodes, balanced over room types and scenes.
      epsilon: thresholds of soft removal, or one of them.
      form: forms, or one form, in which soft removal combines the logits; None for the form of the run's layout
        estimator with sTDE, and for a - s (a - a0) with sCDE.
      setting, hold: layout estimator to use in place of the run's; see `Policies.with_estimator`.
      removal: quantities, or one quantity, that a complete removal leaves: `tde`, the total direct effect (eq. 1), with
        the variants `tde` and `stde`; `cde`, the decision of the same network under do(Z = 0), with the variants `cde`
        and `scde`, which take a compiled call of their own; see `Policies.with_own_fallback`.
      counterfactual_memory: memory from which the counterfactual branch decides; see
        `Policies.with_counterfactual_memory`.
      inner_steps: limit of adaptation steps in an episode; see `Policies.with_inner_steps`.
      costs: parts of the decisions that are replaced throughout episodes to measure their cost: `categories` for other
        categories within experience, on a quarter of the episodes; `all` for every part, on all episodes; or `none`.
      seed: seed of the episode list and the sampled actions, from 0 to 2**32 - 1.
      compiled: result of `compile_evaluation_world` for the same arguments; None compiles it.
      console: console for progress; None for silence.

    Raises:
      InputError: the run is not finished, the subject is no agent or returns wrong actions, or an argument is
        impossible.
    """
    check_seed(seed)
    check_choice("--costs", costs, get_args(Costs))
    console = to_plain_console(console)
    epsilons = np.atleast_1d(np.asarray(epsilon, float)).tolist()
    forms = (form,) if isinstance(form, str) else form
    removals = (removal,) if isinstance(removal, str) else tuple(removal)
    scenes = None if scenes is None else expand_home(scenes)
    found_subject = find_subject(subject)
    if isinstance(found_subject, AgentSubject):
        policy_options = {
            "epsilon": tuple(epsilons) != DEFAULT_EPSILONS,
            "form": form is not None,
            "setting": setting is not None,
            "hold": hold,
            "removal": removals != DEFAULT_REMOVALS,
            "counterfactual_memory": counterfactual_memory is not None,
            "inner_steps": inner_steps is not None,
            "costs": costs != DEFAULT_COSTS,
        }
        _refuse_policy_options(found_subject.name, policy_options)
        return evaluate_agents(
            found_subject,
            split=split,
            scenes=scenes,
            world=world,
            shift=shift,
            shift_by=shift_by,
            num_episodes=episodes,
            seed=seed,
            compiled=compiled,
            console=console,
        )

    # Policies with the options of the evaluation.
    config = found_subject.config
    policies = found_subject.policies.with_estimator(setting, hold).with_inner_steps(inner_steps)
    policies = policies.with_counterfactual_memory(counterfactual_memory)
    if "cde" in removals:
        policies.with_own_fallback()  # refuses policies that cannot act without experience

    # Run the rows of the table: variants, thresholds and forms, with best and with sampled actions.
    default_form = "residual" if policies.estimator_config is None else policies.estimator_config.form
    rows = table_rows(epsilons, forms, policies.arms, removals, default_form)
    compiled = compiled or compile_evaluation_world(config, split, scenes, shift, console, world, shift_by)
    applied_shift = evaluation_shift(config, scenes or world, shift)
    # A single policy has no other training seeds, so its intervals are over scenes alone.
    is_trained = found_subject.run is not None
    table = _evaluate_table(rows, costs, policies, compiled, episodes, applied_shift, seed, console, trained=is_trained)
    results = Results(
        table.rows, table.outcome, table.episodes, compiled.env.categories, WORLDS[config.world].budgets, {}
    )

    # Report the table, with the settings of run and evaluation.
    evaluation_settings = {
        "evaluation_source": str(scenes or world or config.scene_source),
        "evaluation_shift": applied_shift,
        "evaluation_shift_by": shift_by,
        "evaluation_seed": seed,
        "evaluation_setting": setting,
        "evaluation_hold": hold,
        "evaluation_inner_steps": inner_steps,
        "evaluation_counterfactual_memory": policies.spec.counterfactual_memory,
    }
    names = {"method": method_label(config.method), "world": compiled.scenes[0].world, "split": split}
    report = build_report(
        build_result_rows(results, names, trained=is_trained),
        _build_differences(results, trained=is_trained),
        _build_notes(found_subject, policies, results, table.decision_shares),
        table.compilations,
        _subject_settings(found_subject, policies) | evaluation_settings,
        table.decision_shares,
    )
    return results._replace(report=report)


class _EvaluatedTable(NamedTuple):
    """Rows of an evaluation and their results.

    Attributes:
      rows: R rows, with that of the shortest path.
      outcome: results, leaves [R, S, E].
      episodes: the E episodes.
      decision_shares: entries of the report, see `build_decision_shares`.
      compilations: number of compiled programs.
    """

    rows: list[EvaluationRow]
    outcome: EpisodeOutcome
    episodes: EpisodeList
    decision_shares: list[dict[str, Any]]
    compilations: int


def _evaluate_table(
    all_rows: list[EvaluationRow],
    costs: Costs,
    policies: Policies,
    compiled: CompiledWorld,
    num_episodes: int,
    shift: float,
    seed: int,
    console: PlainConsole,
    *,
    trained: bool,
) -> _EvaluatedTable:
    """Run all rows, the replacements of parts of their decisions, and the shortest path, on the same episodes.

    Without `trained`, decision shares have intervals over scenes alone.
    """
    # Rows that hand over to the policy itself are run apart.
    grid_rows = [row for row in all_rows if not row.uses_own_fallback]
    with show_activity(console, describe_evaluation(num_episodes, shift)):
        # Replacements are further rows of the same grid. The oracle reads the tables of every bank once more.
        episode_lists = draw_episode_lists(compiled, num_episodes, seed)
        replacements = list_cost_replacements(grid_rows, costs)
        max_room_episodes = limit_room_episodes(episode_lists, costs)
        outcome, replaced_outcome, compilations = _evaluate_with_replacements(
            grid_rows, replacements, max_room_episodes, policies, compiled, episode_lists, seed
        )
        env_params = prefetch_env_params(compiled, range(len(compiled.banks)))
        oracle_outcome = run_oracle(compiled.banks, episode_lists, env_params, compiled.env)

        # Decision shares come last: two compilations at once raise the peak of memory, and save three seconds at most.
        share_rows = rows_with_shares(grid_rows)
        share_counts, probed_episodes = count_shares(share_rows, policies, compiled, episode_lists, seed)
    costs_by_replacement = measure_costs(
        grid_rows, outcome, replacements, replaced_outcome, episode_lists, max_room_episodes, trained=trained
    )
    decision_shares = build_decision_shares(
        share_rows, share_counts, probed_episodes, costs_by_replacement, trained=trained
    )

    # The table ends with the shortest path; hand-overs stand in the order of `all_rows`.
    finished_rows = [*grid_rows, table_row("oracle", None, None, "argmax")]
    finished_outcome = _append_row(outcome, oracle_outcome)
    if any(row.uses_own_fallback for row in all_rows):
        with show_activity(console, "evaluating removals that leave the policy without experience"):
            finished_rows, finished_outcome, num_compilations = _add_fallback_rows(
                all_rows, finished_rows, finished_outcome, policies, compiled, num_episodes, seed
            )
        compilations += num_compilations
    all_episodes = join_episode_lists(episode_lists)
    return _EvaluatedTable(finished_rows, finished_outcome, all_episodes, decision_shares, compilations)


def _build_notes(
    subject: PolicySubject, policies: Policies, results: Results, decision_shares: list[dict[str, Any]]
) -> list[str]:
    """Notes below the table: limits of the evaluation, decision shares, and the budget and convergence of a run."""
    has_experience = not policies.spec.method.experience.is_empty
    notes = evaluation_notes(
        results.rows,
        results.metrics()["sr"],
        results.episodes,
        has_room_prior=policies.has_room_priors,
        has_experience=has_experience,
        is_run=subject.run is not None,
    )
    if has_experience:
        notes += decision_share_notes(decision_shares)
    if subject.run is not None:
        notes += [budget_note(_steps_by_purpose(subject.config, policies)), *convergence_note(subject.run.log())]
    return notes


def _subject_settings(subject: PolicySubject, policies: Policies) -> dict[str, Any]:
    """Settings of a run with its budget, or the few that are known of a single policy."""
    config = subject.config
    if subject.run is None:
        return {"subject": subject.name, "method": config.method, "world": config.world, "seeds": 1}
    return run_settings(config) | {
        "steps_per_policy": config.total_updates * config.steps_per_update,
        "prior_steps": policies.prior_steps,
        "budget": _steps_by_purpose(config, policies),
    }


def _steps_by_purpose(config: RunConfig, policies: Policies) -> dict[str, int]:
    """Environment steps of a run by purpose, with those that its exploration really took."""
    return config.steps_by_purpose | {"exploration": policies.prior_steps}


def _refuse_policy_options(name: str, is_given: dict[str, bool]) -> None:
    """Refuse options that apply to the experience of policies, of which other agents have none.

    Args:
      name: name of the agent.
      is_given: which options are given, by name.
    """
    for option, is_option_given in is_given.items():
        if is_option_given:
            raise InputError(
                f"--{option.replace('_', '-')}: {name} is an agent whose experience jaxnav cannot remove; omit the "
                "option, or give a run or a policy"
            )


def evaluate_rows(
    rows: Sequence[EvaluationRow],
    policies: Policies,
    compiled_world: CompiledWorld,
    num_episodes: int,
    seed: int,
    evaluator: Evaluator | None = None,
) -> tuple[list[EpisodeList], EpisodeOutcome, int]:
    """Run rows of a table in one compiled call.

    Args:
      rows: R rows, whose arms must be among those of the policies.
      policies: policies with S seeds of each arm.
      compiled_world: compiled scenes.
      num_episodes: number of episodes in all banks together.
      seed: seed of the episode lists and the sampled actions.
      evaluator: evaluator with an agent loop of these policies, to share its compilations; None makes one.

    Returns:
      The episodes of each bank, the outcomes with leaves [R, S, E], and the number of compilations of the evaluator.
    """
    episode_lists = draw_episode_lists(compiled_world, num_episodes, seed)
    evaluator = evaluator or Evaluator(policies.make_agent_loop(compiled_world), has_controls=False)
    grid = inference_grid(rows, policies.arms, policies.num_seeds)
    outcome = _evaluate_grid(evaluator, grid, policies, compiled_world, episode_lists, seed)
    return episode_lists, outcome, evaluator.compilations


def _evaluate_with_replacements(
    rows: Sequence[EvaluationRow],
    replacements: Sequence[Replacement],
    max_room_episodes: int,
    policies: Policies,
    compiled_world: CompiledWorld,
    episode_lists: Sequence[EpisodeList],
    seed: int,
) -> tuple[EpisodeOutcome, EpisodeOutcome, int]:
    """Run R rows and C replacements in one compiled call.

    Returns:
      Outcomes with leaves [R, S, E] and [C, S, E], and the number of compilations.
    """
    grids = [inference_grid(rows, policies.arms, policies.num_seeds)]
    if replacements:
        grids.append(replacement_grid(replacements, policies.arms, policies.num_seeds, max_room_episodes))
    grid = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *grids)

    # Only the parts that are replaced are compiled.
    parts = tuple(sorted({replacement.part for replacement in replacements}))
    evaluator = Evaluator(policies.make_agent_loop(compiled_world), has_controls=False, replaced_parts=parts)
    outcome = _evaluate_grid(evaluator, grid, policies, compiled_world, episode_lists, seed)
    row_outcome = jax.tree.map(lambda leaf: leaf[: len(rows)], outcome)
    replaced_outcome = jax.tree.map(lambda leaf: leaf[len(rows) :], outcome)
    return row_outcome, replaced_outcome, evaluator.compilations


def _evaluate_grid(
    evaluator: Evaluator,
    grid: InferenceConfig,
    policies: Policies,
    compiled_world: CompiledWorld,
    episode_lists: Sequence[EpisodeList],
    seed: int,
) -> EpisodeOutcome:
    """Run a grid of rows and seeds, leaves [R S], over all banks; returns outcomes with leaves [R, S, E]."""
    # While one bank is evaluated, a thread reads the next.
    env_params = prefetch_env_params(compiled_world, range(len(compiled_world.banks)))
    outcome = evaluator(
        grid,
        policies.params,
        zip(episode_lists, env_params, strict=True),
        policies.knowledge,
        jax.random.key(seed),
    )
    return jax.tree.map(lambda leaf: leaf.reshape(-1, policies.num_seeds, leaf.shape[-1]), outcome)


def _add_fallback_rows(
    all_rows: Sequence[EvaluationRow],
    rows: Sequence[EvaluationRow],
    outcome: EpisodeOutcome,
    policies: Policies,
    compiled_world: CompiledWorld,
    num_episodes: int,
    seed: int,
) -> tuple[list[EvaluationRow], EpisodeOutcome, int]:
    """Run the rows of a table that hand over to the policy itself, and add them to the others.

    Args:
      all_rows: rows in the order of the table, without the oracle.
      rows: rows that were run, with the oracle at the end.
      outcome: outcomes of `rows`, leaves [R, S, E].
      policies, compiled_world, num_episodes, seed: as in `evaluate_rows`.

    Returns:
      All rows in order, their outcomes, and the number of further compilations.
    """
    # Policies that hand over carry a second memory, so these rows are compiled apart.
    fallback_rows = [row for row in all_rows if row.uses_own_fallback]
    _, fallback_outcome, compilations = evaluate_rows(
        fallback_rows, policies.with_own_fallback(), compiled_world, num_episodes, seed
    )

    # Put all rows into the order of the table.
    run_order = [*rows, *fallback_rows]
    table_order = [*all_rows, rows[-1]]
    row_order = np.array([run_order.index(row) for row in table_order])
    outcome = jax.tree.map(
        lambda leaf, fallback_leaf: np.concatenate([leaf, fallback_leaf])[row_order], outcome, fallback_outcome
    )
    return table_order, outcome, compilations


def check_seed(seed: int) -> None:
    """Check that a seed fits NumPy's generators.

    Raises:
      InputError: the seed is negative or has more than 32 bits.
    """
    if not 0 <= seed < 2**32:
        raise InputError(f"--seed {seed}: give a whole number from 0 to 2**32 - 1")


def describe_evaluation(num_episodes: int, shift: float) -> str:
    """Words for the console while episodes are evaluated."""
    return f"evaluating {num_episodes:,} episodes at shift {shift:g}"


def _append_row(outcome: EpisodeOutcome, row_outcome: EpisodeOutcome) -> EpisodeOutcome:
    """Append a row with leaves [E], equal for all seeds, to outcomes with leaves [R, S, E]."""

    def append_leaf(leaf: np.ndarray, row_leaf: np.ndarray) -> np.ndarray:
        seed_rows = np.broadcast_to(row_leaf, leaf.shape[1:])  # [S, E]
        return np.concatenate([leaf, seed_rows[None].astype(leaf.dtype)])

    return jax.tree.map(append_leaf, outcome, row_outcome)


def _build_differences(results: Results, *, trained: bool) -> list[dict[str, Any]]:
    """Paired differences of the report: layout weights to the baseline, and removals to the layout weights."""
    metrics = results.metrics()
    rows = results.rows
    difference_rows = []
    for index, row in enumerate(rows):
        if row.arm != "layout":
            continue

        # Rows are compared under the same decoding, and only where the reference was evaluated.
        reference_variant = "baseline" if row.variant == "layout" else "layout"
        reference_row = EvaluationRow(reference_variant, None, None, row.decoding)
        if reference_row not in rows:
            continue
        reference_index = rows.index(reference_row)

        for metric in ("sr", "spl", "dts"):
            difference_row = build_difference(
                metric,
                (reference_variant, metrics[metric][reference_index]),
                (row.variant, metrics[metric][index]),
                epsilon=row.epsilon,
                form=row.form,
                decoding=row.decoding,
                episodes=results.episodes,
                same_runs=share_networks(row.variant, reference_variant),
                trained=trained,
            )
            difference_rows.append(difference_row)
    return difference_rows


def measure_leads(results: Results, reference: Results) -> list[ExperienceLead]:
    """Lead of every row over the layout-blind agents.

    Leads are measured in success, in SPL, and in success within the world's budgets; see `ExperienceLead`.

    Args:
      results: results of the agents with experience.
      reference: results of a run of layout-blind agents. Their arm `baseline` is the reference.

    Raises:
      InputError: episodes or numbers of seeds differ, or `reference` has no baseline.
    """
    # Leads are paired by episode, so both results must hold equal episodes; scenes are the clusters of the intervals.
    _check_comparable(results, reference)
    metrics = results.metrics()
    reference_metrics = reference.metrics()
    scenes = results.episodes.clusters()
    experience_leads = []
    for index, row in enumerate(results.rows):
        if row.arm is None:
            continue

        # The layout-blind agent, and the agent with all of its experience, under the same decoding.
        reference_index = reference.rows.index(EvaluationRow("baseline", None, None, row.decoding))
        agent_index = results.rows.index(EvaluationRow(row.arm, None, None, row.decoding))
        variant_label = row_label(results.report["rows"][index])

        for metric in ("sr", "spl", *(f"sr@{budget}" for budget in results.budgets)):
            reference_values = reference_metrics[metric][reference_index]
            agent_values = metrics[metric][agent_index]
            row_values = metrics[metric][index]
            paired_lead = paired_difference(100.0 * reference_values, 100.0 * row_values, scenes)

            # Only rows that remove experience keep a share of the lead.
            lead_share = None
            if index != agent_index:
                lead_share = remaining_share(reference_values, agent_values, row_values, scenes)
            experience_leads.append(ExperienceLead(index, variant_label, row.decoding, metric, paired_lead, lead_share))
    return experience_leads


def _check_comparable(results: Results, reference: Results) -> None:
    """Refuse results of other episodes or numbers of seeds, or a reference without a baseline."""
    if not has_same_episodes(results.episodes, reference.episodes):
        raise InputError("reference run: has other episodes than the run; train both in one world with equal rules")
    num_seeds = results.outcome.length.shape[1]
    reference_seeds = reference.outcome.length.shape[1]
    if num_seeds != reference_seeds:
        raise InputError(f"reference run: has {reference_seeds} seeds, but the run has {num_seeds}; train equally many")
    if EvaluationRow("baseline", None, None, "argmax") not in reference.rows:
        raise InputError("reference run: has no arm `baseline`; train it with --arms baseline")


def has_same_episodes(episodes: EpisodeList, other: EpisodeList) -> bool:
    """True if both lists hold the same episodes of the same scenes."""
    for name in ("scene", "goal", "pose"):
        if not np.array_equal(getattr(episodes, name), getattr(other, name)):
            return False
    return episodes.scenes == other.scenes


def replay_episodes(
    policies: Policies, compiled_world: CompiledWorld, episodes: EpisodeList, row: EvaluationRow
) -> list[EpisodeTrace]:
    """Play episodes of the first bank step by step, with the first seed.

    Args:
      policies: policies of the run.
      compiled_world: compiled scenes.
      episodes: episodes of the first bank.
      row: row of a table, whose arm must be among those of the policies.

    Raises:
      InputError: the method cannot act in the scenes.
    """
    if row.uses_own_fallback:
        policies = policies.with_own_fallback()

    # The first entry of the grid is the row with the first seed.
    inference = jax.tree.map(lambda leaf: leaf[0], inference_grid([row], policies.arms, policies.num_seeds))
    params = jax.tree.map(lambda leaf: leaf[inference.policy_index], policies.params)
    return play_episodes(
        inference,
        params,
        start_states(episodes),
        policies.make_agent_loop(compiled_world),
        compiled_world.make_env_params(0),
        policies.knowledge,
    )
