"""Evaluation of a run: fixed episodes, all variants and epsilons at once."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxnav.baselines.shortest_path import oracle_outcome
from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list, together
from jaxnav.evaluation.grid import Evaluator, Outcome
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.notes import notes, spent, trained_out
from jaxnav.evaluation.report import build_difference, build_report, build_row, write_report
from jaxnav.evaluation.variants import Row, inference_grid, table_row, table_rows
from jaxnav.runs.directory import Run, settings
from jaxnav.runs.policies import EstimatorName, Policies
from jaxnav.runs.worlds import CompiledWorld, evaluation_shift, evaluation_world, read_ahead
from jaxnav.scenes.worlds import WORLDS
from jaxnav.store.files import write_atomic


class Results(NamedTuple):
    """Hold an evaluation; R rows, S seeds, E episodes.

    Attributes:
      rows: of the table.
      outcome: how the episodes went, leaves [R, S, E].
      episodes: that were run.
      categories: [K] names.
      budgets: numbers of actions within which success is counted too.
      report: the table, paired differences, settings and versions, as JSON.
    """

    rows: list[Row]
    outcome: Outcome
    episodes: EpisodeList
    categories: tuple[str, ...]
    budgets: tuple[int, ...]
    report: dict[str, Any]

    def metrics(self) -> dict[str, np.ndarray]:
        """Return the metrics of every episode, float64 [R, S, E].

        All are in [0, 1] but `dts`, which is in metres; see `episode_metrics`.
        """
        return episode_metrics(self.outcome, self.episodes.best_length, self.budgets)

    def write(self, path: Path) -> None:
        """Write the report, and a CSV row per episode.

        Raises:
          OSError: a file cannot be written.
        """
        write_report(path, self.report)
        episodes = path.with_name(f"{path.name.removesuffix('.json')}.episodes.csv")
        write_atomic(episodes, _episode_csv(self).encode())


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
      split: scenes to evaluate on.
      scenes: scene file to read instead of the run's own world or file.
      world: generated world instead, by the categories and rules of the run.
      shift: layout shift, from 0 to 1; None for the run's, and 0 with `scenes` or `world`.
      episodes: in the fixed list, balanced over room types and scenes.
      epsilon: thresholds of sTDE.
      form: how sTDE combines the logits; None for that of the run's layout setting.
      setting, hold: layout estimator to use instead of the run's; see `Policies.estimating`.
      inner_steps: by which policies may adapt in an episode; see `Policies.adapting`.
      seed: of the episode list and the sampled actions, from 0 to 2**32 - 1.
      compiled: the world of `evaluation_world` with these arguments, where it is there already.
      console: to tell of progress on; None for silence.

    Raises:
      InputError: no finished run, or an impossible argument.
    """
    check_seed(seed)
    console = console or Console(quiet=True)
    config, policies = run.config, run.policies().estimating(setting, hold).adapting(inner_steps)
    if form is None:
        form = () if policies.setting is None else (policies.setting.form,)
    rows = table_rows([float(threshold) for threshold in epsilon], form, policies.arms)
    compiled = compiled or evaluation_world(config, split, scenes, shift, console, world)
    lists, outcome, compilations = run_rows(rows, policies, compiled, episodes, seed)
    shortest = oracle_outcome(compiled.banks, lists, read_ahead(compiled, range(len(compiled.banks))), compiled.env)
    rows, outcome = [*rows, table_row("oracle", None, None, "argmax")], _with_oracle(outcome, shortest)
    about = settings(config) | {
        "steps_per_policy": config.total_updates * config.update_steps,
        "prior_steps": policies.prior_steps,
        "budget": (budget := config.budget | {"exploration": policies.prior_steps}),
        "evaluation_source": str(scenes or world or config.source),
        "evaluation_shift": evaluation_shift(config, scenes or world, shift),
        "evaluation_seed": seed,
        "evaluation_setting": setting,
        "evaluation_hold": hold,
        "evaluation_inner_steps": inner_steps,
    }
    results = Results(rows, outcome, together(lists), compiled.env.categories, WORLDS[config.world].budgets, {})
    names = {"method": config.method.upper(), "world": compiled.scenes[0].world, "split": split}
    table, differences = _table(results, names), _differences(results)
    told = notes(rows, results.metrics()["sr"], results.episodes, room_prior=config.layout.prior == "room")
    told += [spent(budget), *trained_out(run.log())]
    return results._replace(report=build_report(table, differences, told, compilations, about))


def run_rows(
    rows: Sequence[Row], policies: Policies, world: CompiledWorld, episodes: int, seed: int
) -> tuple[list[EpisodeList], Outcome, int]:
    """Run rows of a table in one compiled call.

    Args:
      rows: R of them; their arms must be among those of the policies.
      policies: S seeds of each arm.
      world: the scenes.
      episodes: in all, drawn anew in every bank.
      seed: of the episode lists and the sampled actions.

    Returns:
      The episodes of each bank, outcomes with leaves [R, S, E], and the number of compilations.
    """
    lists = episode_lists(world, episodes, seed)
    evaluator = Evaluator(policies.acting(world))
    outcome = evaluator(
        inference_grid(rows, policies.arms, policies.seeds),
        policies.params,
        zip(lists, read_ahead(world, range(len(world.banks))), strict=True),
        policies.knowledge,
        jax.random.key(seed),
    )
    outcome = jax.tree.map(lambda leaf: leaf.reshape(len(rows), policies.seeds, -1), outcome)
    return lists, outcome, evaluator.compilations


def episode_lists(world: CompiledWorld, episodes: int, seed: int) -> list[EpisodeList]:
    """Draw so many episodes in all, equally many in every bank."""
    each = -(-episodes // len(world.banks))
    return [episode_list(bank, each, seed, part) for part, bank in enumerate(world.banks)]


def check_seed(seed: int) -> None:
    """Check that a seed can be drawn from.

    Raises:
      InputError: it cannot.
    """
    if not 0 <= seed < 2**32:
        raise InputError(f"--seed {seed}: give a whole number from 0 to 2**32 - 1")


def _with_oracle(outcome: Outcome, shortest: Outcome) -> Outcome:
    """Add the oracle's row [E] to outcomes [R, S, E]."""

    def added(leaf: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.broadcast_to(row, leaf.shape[1:])[None].astype(leaf.dtype)])

    return jax.tree.map(added, outcome, shortest)


def _table(results: Results, names: dict[str, str]) -> list[dict[str, Any]]:
    """Make the table."""
    metrics = results.metrics()
    return [
        build_row(
            variant=row.variant,
            **names,
            epsilon=row.epsilon,
            decoding=row.decoding,
            form=row.form,
            metrics={name: values[i] for name, values in metrics.items()},
            episodes=results.episodes,
        )
        for i, row in enumerate(results.rows)
    ]


def _differences(results: Results) -> list[dict[str, Any]]:
    """Make the paired differences of rows that are there."""
    metrics, rows = results.metrics(), results.rows
    differences = []
    for i, row in enumerate(rows):
        if row.arm != "layout":
            continue
        reference = "baseline" if row.variant == "layout" else "layout"
        against = Row(reference, None, None, row.decoding)
        if against not in rows:
            continue
        differences += [
            build_difference(
                metric,
                (reference, metrics[metric][rows.index(against)]),
                (row.variant, metrics[metric][i]),
                epsilon=row.epsilon,
                form=row.form,
                decoding=row.decoding,
                episodes=results.episodes,
                same_runs=reference == "layout",
            )
            for metric in ("sr", "spl", "dts")
        ]
    return differences


def _episode_csv(results: Results) -> str:
    """Make a line per row, seed and episode."""
    metrics, outcome, episodes = results.metrics(), results.outcome, results.episodes
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [*Row._fields, "seed", "scene", "room", "goal", "start_pose", "best_length", "length", *metrics, "mean_weight"]
    )
    fixed = [
        (episodes.scenes[scene], episodes.rooms[room], results.categories[goal], pose, best)
        for scene, room, goal, pose, best in zip(
            episodes.scene, episodes.room, episodes.goal, episodes.pose, episodes.best_length, strict=True
        )
    ]
    for r, row in enumerate(results.rows):
        for seed in range(outcome.length.shape[1]):
            columns = (outcome.length, *metrics.values(), outcome.weight)
            values = np.stack([np.asarray(column)[r, seed] for column in columns], axis=-1)
            writer.writerows(
                (*row, seed, *known, *(f"{value:.6g}" for value in measured))
                for known, measured in zip(fixed, values.tolist(), strict=True)
            )
    return text.getvalue()
