"""Evaluation of a run on fixed episodes.

`evaluate` measures every variant of the run's policies (baseline, layout weights, hard TDE, and sTDE at every epsilon)
and returns `Results` with a report of the tables. `sweep` evaluates sTDE over many epsilons and all seeds in one
compiled call. `measure_leads` compares results with those of agents that cannot know any layout, and `replay_episodes`
plays episodes step by step.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.baselines.shortest_path import run_oracle
from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes, join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator, episode_metrics, start_states
from jaxnav.evaluation.notes import budget_note, convergence_note, evaluation_notes
from jaxnav.evaluation.playback import EpisodeTrace, play_episodes
from jaxnav.evaluation.report import (
    Decoding,
    ExperienceLead,
    build_difference,
    build_report,
    build_row,
    remaining_share,
    row_label,
    write_report,
)
from jaxnav.evaluation.statistics import paired_difference
from jaxnav.evaluation.variants import EvaluationRow, inference_grid, table_row, table_rows
from jaxnav.policies.methods import method_label
from jaxnav.runs.policies import EstimatorName, Policies
from jaxnav.runs.run import Run, run_settings
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, evaluation_shift, prefetch_env_params
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.worlds import WORLDS
from jaxnav.store.files import write_atomic


class Results(NamedTuple):
    """Results of an evaluation with R rows, S seeds and E episodes.

    Attributes:
      rows: rows of the table.
      outcome: outcomes of the episodes, leaves [R, S, E].
      episodes: the episodes.
      categories: names of the K categories.
      budgets: numbers of actions within which success is counted too.
      report: table, paired differences, settings and versions, as JSON.
    """

    rows: list[EvaluationRow]
    outcome: EpisodeOutcome
    episodes: EpisodeList
    categories: tuple[str, ...]
    budgets: tuple[int, ...]
    report: dict[str, Any]

    def metrics(self) -> dict[str, np.ndarray]:
        """Metrics of every episode, float64 [R, S, E].

        All metrics are in [0, 1], except for `dts`, which is in metres; see `episode_metrics`.
        """
        return episode_metrics(self.outcome, self.episodes.best_length, self.budgets)

    def write(self, path: Path) -> None:
        """Write the report, and beside it a CSV file with a line per row, seed and episode.

        Raises:
          OSError: a file cannot be written.
        """
        # `eval-val.json` is accompanied by `eval-val.episodes.csv`.
        write_report(path, self.report)
        csv_path = path.with_name(f"{path.name.removesuffix('.json')}.episodes.csv")
        write_atomic(csv_path, _format_csv(self).encode())


def evaluate(
    run: Run,
    *,
    split: str = "val",
    scenes: Path | None = None,
    world: str | None = None,
    shift: float | None = None,
    episodes: int = 1000,
    epsilon: Sequence[float] | np.ndarray = (0.5,),
    form: Sequence[Form] | None = None,
    setting: EstimatorName | None = None,
    hold: bool = False,
    inner_steps: int | None = None,
    seed: int = 0,
    compiled: CompiledWorld | None = None,
    console: Console | None = None,
) -> Results:
    """Evaluate a run on fixed episodes, in one compiled call.

    Args:
      run: a finished run.
      split: split of the scenes.
      scenes: scene file to read in place of the run's scenes.
      world: generated world to use in place of the run's scenes, with the categories and rules of the run.
      shift: layout shift, from 0 to 1; None for the run's, and 0 with `scenes` or `world`.
      episodes: number of fixed episodes, balanced over room types and scenes.
      epsilon: thresholds of sTDE.
      form: forms in which sTDE combines the logits; None for the form of the run's layout estimator.
      setting, hold: layout estimator to use in place of the run's; see `Policies.with_estimator`.
      inner_steps: limit of adaptation steps in an episode; see `Policies.with_inner_steps`.
      seed: seed of the episode list and the sampled actions, from 0 to 2**32 - 1.
      compiled: result of `compile_evaluation_world` for the same arguments; None compiles it.
      console: console for progress; None for silence.

    Raises:
      InputError: the run is not finished, or an argument is impossible.
    """
    check_seed(seed)
    console = console or Console(quiet=True)
    config = run.config
    policies = run.policies().with_estimator(setting, hold).with_inner_steps(inner_steps)

    # Rows of the table: variants, thresholds and forms, with best and with sampled actions.
    removal_forms = form
    if removal_forms is None:
        removal_forms = () if policies.estimator_config is None else (policies.estimator_config.form,)
    thresholds = np.asarray(epsilon, float).tolist()
    rows = table_rows(thresholds, removal_forms, policies.arms)

    # Run all rows, and the oracle on the same episodes. The oracle reads the tables of every bank once more.
    compiled = compiled or compile_evaluation_world(config, split, scenes, shift, console, world)
    episode_lists, outcome, compilations = evaluate_rows(rows, policies, compiled, episodes, seed)
    env_params = prefetch_env_params(compiled, range(len(compiled.banks)))
    oracle_outcome = run_oracle(compiled.banks, episode_lists, env_params, compiled.env)
    rows = [*rows, table_row("oracle", None, None, "argmax")]
    outcome = _append_row(outcome, oracle_outcome)
    results = Results(
        rows, outcome, join_episode_lists(episode_lists), compiled.env.categories, WORLDS[config.world].budgets, {}
    )

    # Report: tables, notes, and the settings of run and evaluation.
    steps_by_purpose = config.steps_by_purpose | {"exploration": policies.prior_steps}
    names = {"method": method_label(config.method), "world": compiled.scenes[0].world, "split": split}
    report_notes = [
        *evaluation_notes(rows, results.metrics()["sr"], results.episodes, has_room_prior=policies.has_room_priors),
        budget_note(steps_by_purpose),
        *convergence_note(run.log()),
    ]
    report_settings = run_settings(config) | {
        "steps_per_policy": config.total_updates * config.steps_per_update,
        "prior_steps": policies.prior_steps,
        "budget": steps_by_purpose,
        "evaluation_source": str(scenes or world or config.scene_source),
        "evaluation_shift": evaluation_shift(config, scenes or world, shift),
        "evaluation_seed": seed,
        "evaluation_setting": setting,
        "evaluation_hold": hold,
        "evaluation_inner_steps": inner_steps,
    }
    report = build_report(
        _build_rows(results, names), _build_differences(results), report_notes, compilations, report_settings
    )
    return results._replace(report=report)


def evaluate_rows(
    rows: Sequence[EvaluationRow], policies: Policies, world: CompiledWorld, num_episodes: int, seed: int
) -> tuple[list[EpisodeList], EpisodeOutcome, int]:
    """Run rows of a table in one compiled call.

    Args:
      rows: R rows, whose arms must be among those of the policies.
      policies: policies with S seeds of each arm.
      world: compiled scenes.
      num_episodes: number of episodes in all banks together.
      seed: seed of the episode lists and the sampled actions.

    Returns:
      The episodes of each bank, the outcomes with leaves [R, S, E], and the number of compilations.
    """
    # While one bank is evaluated, a thread reads the next.
    episode_lists = draw_episode_lists(world, num_episodes, seed)
    env_params = prefetch_env_params(world, range(len(world.banks)))
    evaluator = Evaluator(policies.make_agent_loop(world))
    outcome = evaluator(
        inference_grid(rows, policies.arms, policies.num_seeds),
        policies.params,
        zip(episode_lists, env_params, strict=True),
        policies.knowledge,
        jax.random.key(seed),
    )
    # The grid is flat: [R S, E] becomes [R, S, E].
    outcome = jax.tree.map(lambda leaf: leaf.reshape(len(rows), policies.num_seeds, -1), outcome)
    return episode_lists, outcome, evaluator.compilations


def draw_episode_lists(world: CompiledWorld, num_episodes: int, seed: int) -> list[EpisodeList]:
    """Draw fixed episodes, equally many in every bank of scenes."""
    episodes_per_bank = -(-num_episodes // len(world.banks))  # rounded up
    return [draw_episodes(bank, episodes_per_bank, seed, index) for index, bank in enumerate(world.banks)]


def check_seed(seed: int) -> None:
    """Check that a seed fits NumPy's generators.

    Raises:
      InputError: the seed is negative or has more than 32 bits.
    """
    if not 0 <= seed < 2**32:
        raise InputError(f"--seed {seed}: give a whole number from 0 to 2**32 - 1")


def _append_row(outcome: EpisodeOutcome, row_outcome: EpisodeOutcome) -> EpisodeOutcome:
    """Append a row with leaves [E], equal for all seeds, to outcomes with leaves [R, S, E]."""

    def append_leaf(leaf: np.ndarray, row_leaf: np.ndarray) -> np.ndarray:
        seed_rows = np.broadcast_to(row_leaf, leaf.shape[1:])  # [S, E]
        return np.concatenate([leaf, seed_rows[None].astype(leaf.dtype)])

    return jax.tree.map(append_leaf, outcome, row_outcome)


def _build_rows(results: Results, names: dict[str, str]) -> list[dict[str, Any]]:
    """Rows of the report's table."""
    metrics = results.metrics()
    report_rows = []
    for index, row in enumerate(results.rows):
        report_row = build_row(
            variant=row.variant,
            **names,
            epsilon=row.epsilon,
            decoding=row.decoding,
            form=row.form,
            metrics={name: metric_values[index] for name, metric_values in metrics.items()},
            episodes=results.episodes,
        )
        report_rows.append(report_row)
    return report_rows


def _build_differences(results: Results) -> list[dict[str, Any]]:
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
                same_runs=reference_variant == "layout",
            )
            difference_rows.append(difference_row)
    return difference_rows


def _format_csv(results: Results) -> str:
    """CSV with a line per row, seed and episode."""
    metrics = results.metrics()
    outcome = results.outcome
    episodes = results.episodes
    csv_buffer = io.StringIO()
    csv_writer = csv.writer(csv_buffer, lineterminator="\n")
    episode_columns = ["scene", "room", "goal", "start_pose", "best_length"]
    # Header.
    csv_writer.writerow([*EvaluationRow._fields, "seed", *episode_columns, "length", *metrics, "mean_weight"])

    # Cells that all rows and seeds share.
    episode_cells = []
    for scene, room, goal, pose, best_length in zip(
        episodes.scene, episodes.room, episodes.goal, episodes.pose, episodes.best_length, strict=True
    ):
        names = (episodes.scenes[scene], episodes.rooms[room], results.categories[goal])
        episode_cells.append((*names, pose, best_length))

    # Measured values, with M columns.
    num_seeds = outcome.length.shape[1]
    metric_columns = (outcome.length, *metrics.values(), outcome.mean_weight)
    measured_values = np.stack(metric_columns, axis=-1)  # [R, S, E, M]
    for row_index, row in enumerate(results.rows):
        for seed in range(num_seeds):
            metric_values = measured_values[row_index, seed].tolist()
            for cells_of_episode, episode_values in zip(episode_cells, metric_values, strict=True):
                csv_writer.writerow((*row, seed, *cells_of_episode, *map("{:.6g}".format, episode_values)))
    return csv_buffer.getvalue()


class Sweep(NamedTuple):
    """Results of a sweep over X thresholds, S seeds and E episodes.

    Attributes:
      epsilon: float64 [X], thresholds.
      sr, spl: float64 [X, S, E], in [0, 1].
      dts: float64 [X, S, E], in metres.
      outcome: outcomes of the episodes, leaves [X, S, E].
      compilations: number of compilations; 1 where the scenes are in memory.
    """

    epsilon: np.ndarray
    sr: np.ndarray
    spl: np.ndarray
    dts: np.ndarray
    outcome: EpisodeOutcome
    compilations: int


def sweep(
    run: Run,
    epsilon: Sequence[float] | np.ndarray,
    params: Any = None,
    *,
    split: str = "val",
    scenes: Path | None = None,
    shift: float | None = None,
    episodes: int = 1000,
    decoding: Decoding = "argmax",
    form: Form | None = None,
    seed: int = 0,
) -> Sweep:
    """Evaluate sTDE at every threshold and for every seed in one compiled call.

    Args:
      run: a finished run with the arm `layout`.
      epsilon: thresholds [X]; no experience is removed for epsilon >= 1.
      params: network parameters of your own, leaves [S, ...]; None for those of the run.
      split, scenes, shift, episodes, form, seed: as in `jaxnav.evaluate`.
      decoding: `argmax` for best actions, `sample` for sampled ones.

    Raises:
      InputError: the run is not finished or has no arm `layout`, or an argument is impossible.
    """
    check_seed(seed)
    policies = run.policies(("layout",))
    estimator_config = policies.estimator_config
    assert estimator_config is not None  # policies of the arm `layout` have an estimator
    if not len(epsilon):
        raise InputError("epsilon: give at least one number")

    # Random numbers depend on `policy_index`. Repeating the layout parameters for every arm gives them the same index
    # as in `evaluate`, and so both functions sample the same actions.
    arm_names = run.config.arms
    params = policies.params if params is None else params
    repeated_params = jax.tree.map(lambda leaf: jnp.concatenate([jnp.asarray(leaf)] * len(arm_names)), params)
    policies = policies._replace(params=repeated_params, arms=arm_names)

    # One row for each threshold.
    form = estimator_config.form if form is None else form
    rows = [table_row("stde", float(threshold), form, decoding) for threshold in epsilon]
    world = compile_evaluation_world(run.config, split, scenes, shift, Console(quiet=True))
    episode_lists, outcome, compilations = evaluate_rows(rows, policies, world, episodes, seed)

    metrics = episode_metrics(outcome, join_episode_lists(episode_lists).best_length)
    return Sweep(np.asarray(epsilon, np.float64), metrics["sr"], metrics["spl"], metrics["dts"], outcome, compilations)


def measure_leads(results: Results, reference: Results) -> list[ExperienceLead]:
    """Lead of every row over agents without experience.

    Leads are measured in success, in SPL, and in success within the world's budgets; see `ExperienceLead`.

    Args:
      results: results of the agents with experience.
      reference: results of agents that cannot know any layout. Their baseline is the reference.

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

        # The agent without experience, and the agent with all of its experience, under the same decoding.
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
        raise InputError("account: the runs do not meet the same episodes; train both in one world, with equal rules")
    num_seeds = results.outcome.length.shape[1]
    reference_seeds = reference.outcome.length.shape[1]
    if num_seeds != reference_seeds:
        raise InputError(
            f"account: {num_seeds} seeds with experience and {reference_seeds} without; train as many of each"
        )
    if EvaluationRow("baseline", None, None, "argmax") not in reference.rows:
        raise InputError("account: the run without experience has no arm `baseline`; train it with one")


def has_same_episodes(episodes: EpisodeList, other: EpisodeList) -> bool:
    """True if both lists hold the same episodes of the same scenes."""
    for name in ("scene", "goal", "pose"):
        if not np.array_equal(getattr(episodes, name), getattr(other, name)):
            return False
    return episodes.scenes == other.scenes


def replay_episodes(
    policies: Policies, world: CompiledWorld, episodes: EpisodeList, row: EvaluationRow
) -> list[EpisodeTrace]:
    """Play episodes of the first bank step by step, with the first seed.

    Args:
      policies: policies of the run.
      world: compiled scenes.
      episodes: episodes of the first bank.
      row: row of a table, whose arm must be among those of the policies.

    Raises:
      InputError: the method cannot act in the scenes.
    """
    # The first cell of the grid is the row with the first seed.
    inference = jax.tree.map(lambda leaf: leaf[0], inference_grid([row], policies.arms, policies.num_seeds))
    params = jax.tree.map(lambda leaf: leaf[inference.policy_index], policies.params)
    return play_episodes(
        inference,
        params,
        start_states(episodes),
        policies.make_agent_loop(world),
        world.make_env_params(0),
        policies.knowledge,
    )


def find_scene(world: CompiledWorld, name: str) -> Scene:
    """Scene of a world by its name."""
    for index in range(len(world.scenes)):
        scene = world.scenes[index]
        if scene.name == name:
            return scene
    raise LookupError(f"the world has no scene {name!r}")
