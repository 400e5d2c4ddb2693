"""The evaluation command: fixed episodes, all variants and epsilons at once; a table, JSON, a row per episode."""

import csv
import dataclasses
import io
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from rich.console import Console

from jaxnav.baselines.shortest_path import oracle_outcome
from jaxnav.cli.command import exit_code, result_console
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list, together
from jaxnav.evaluation.grid import Outcome, evaluate_grid
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.report import (
    Form,
    build_difference,
    build_report,
    build_row,
    console_table,
    difference_table,
    write_report,
)
from jaxnav.evaluation.variants import Row, inference_grid, table_row, table_rows
from jaxnav.policies.acting import Acting
from jaxnav.runs.directory import load_policies, load_run, settings
from jaxnav.runs.worlds import evaluation_shift, evaluation_world, read_ahead
from jaxnav.store.files import write_atomic


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """An evaluation of a training run.

    Attributes:
      run: the run directory.
      split: scenes to evaluate on.
      scenes: scene file to read instead of the run's own world or file.
      shift: layout shift, from 0 to 1; in single rooms and in a file the share of the categories that exchange their
        labels; default: the run's, and 0 with `--scenes`.
      episodes: in the fixed list, balanced over room types and scenes; where scenes are streamed equally many in every
        shard, and balanced there.
      epsilon: thresholds of sTDE; all of them in one compiled call.
      form: how sTDE combines the logits; default: the run's layout setting's.
      seed: of the episode list, the sampled actions and the bootstrap.
      json: where to write the table; default: in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    scenes: Path | None = None
    shift: float | None = None
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.5,)
    form: tuple[Form, ...] | None = None
    seed: int = 0
    json: Path | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    config = tyro.cli(EvalConfig, args=arguments, prog="eval.py", description="Evaluate a training run.")
    return exit_code(lambda console: evaluate(config, console, result_console()))


def evaluate(config: EvalConfig, console: Console, out: Console) -> None:
    """Evaluate a run: print the table and write JSON and one CSV row per episode."""
    target = _target(config)
    if not 0 <= config.seed < 2**32:
        raise InputError(f"--seed {config.seed}: give a whole number from 0 to 2**32 - 1")
    run = load_run(config.run)
    policies = load_policies(run)
    rows = table_rows(config.epsilon, config.form or (policies.setting.form,))
    world = evaluation_world(run, config.split, config.scenes, config.shift, console)
    everything = range(len(world.banks))
    each = -(-config.episodes // len(world.banks))
    lists = [episode_list(bank, each, config.seed, part) for part, bank in enumerate(world.banks)]
    outcome, compilations = evaluate_grid(
        inference_grid(rows, run.seeds),
        policies.params,
        zip(lists, read_ahead(world, everything), strict=True),
        Acting(world.env, policies.setting),
        policies.spec,
        policies.priors,
        jax.random.key(config.seed),
    )
    outcome = jax.tree.map(lambda leaf: leaf.reshape(len(rows), run.seeds, -1), outcome)
    shortest = oracle_outcome(world.banks, lists, read_ahead(world, everything), world.env)
    rows, outcome = [*rows, table_row("oracle", None, None, "argmax")], _with_oracle(outcome, shortest)
    episodes = together(lists)
    table, differences = _tables(config, rows, outcome, episodes, policies.spec.method, world.scenes[0].world)
    about = settings(run) | {
        "steps_per_policy": run.total_updates * run.update_steps,
        "prior_steps": policies.prior_steps,
        "evaluation_source": str(config.scenes or run.source),
        "evaluation_shift": evaluation_shift(run, config.scenes, config.shift),
        "evaluation_seed": config.seed,
    }
    report = build_report(table, differences, compilations, about)
    out.print(console_table(report))
    out.print(difference_table(report))
    try:
        write_report(target, report)
        write_atomic(_episodes_file(target), _episode_csv(rows, outcome, episodes, world.env.categories).encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); give another --json") from error
    console.print(f"{len(episodes.goal)} episodes, {compilations} compilation; written to {target}", soft_wrap=True)


def _with_oracle(outcome: Outcome, shortest: Outcome) -> Outcome:
    """Outcomes [R, S, E] and one more row: the oracle's [E], which is the same for all seeds."""

    def added(leaf: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.broadcast_to(own, leaf.shape[1:])[None].astype(leaf.dtype)])

    return jax.tree.map(added, outcome, shortest)


def _target(config: EvalConfig) -> Path:
    """Where the table goes, refused early if nothing can be written there."""
    source = "" if config.scenes is None else f"{config.scenes.name.split('.')[0]}-"
    name = f"eval-{source}{config.split}" + ("" if config.shift is None else f"-shift{config.shift:g}")
    target = config.json or config.run / f"{name}.json"
    if target.is_dir() or not target.name or (target.parent.exists() and not target.parent.is_dir()):
        raise InputError(f"--json {target}: is a folder or lies in a file; give the name of a file to write")
    return target


def _episodes_file(target: Path) -> Path:
    return target.with_name(f"{target.name.removesuffix('.json')}.episodes.csv")


def _tables(
    config: EvalConfig, rows: list[Row], outcome: Outcome, episodes: EpisodeList, method: str, world: str
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The table, and the paired differences that it is read for."""

    def generator() -> np.random.Generator:
        # Equal resamples for every row: equal results get equal intervals.
        return np.random.default_rng(config.seed)

    metrics = episode_metrics(outcome, episodes.best_length)  # [R, S, E] each
    by_row = {row: {name: values[i] for name, values in metrics.items()} for i, row in enumerate(rows)}
    table = [
        build_row(
            variant=row.variant,
            method=method.upper(),
            world=world,
            split=config.split,
            epsilon=row.epsilon,
            decoding=row.decoding,
            form=row.form,
            metrics=by_row[row],
            best_lengths=episodes.best_length,
            strata=episodes.room,
            generator=generator(),
        )
        for row in rows
    ]
    differences = []
    for row in rows:
        if row.variant in ("oracle", "random", "baseline"):
            continue
        reference = "baseline" if row.variant == "layout" else "layout"
        against = by_row[Row(reference, None, None, row.decoding)]
        differences += [
            build_difference(
                metric,
                (reference, against[metric]),
                (row.variant, by_row[row][metric]),
                epsilon=row.epsilon,
                form=row.form,
                decoding=row.decoding,
                strata=episodes.room,
                generator=generator(),
                same_seeds=reference == "layout",
            )
            for metric in ("sr", "spl", "dts")
        ]
    return table, differences


def _episode_csv(rows: list[Row], outcome: Outcome, episodes: EpisodeList, categories: tuple[str, ...]) -> str:
    """One line per row of the table, seed and episode."""
    metrics = episode_metrics(outcome, episodes.best_length)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [*Row._fields, "seed", "scene", "room", "goal", "start_pose", "best_length", "length", *metrics, "mean_weight"]
    )
    fixed = [
        (episodes.scenes[scene], episodes.rooms[room], categories[goal], pose, best)
        for scene, room, goal, pose, best in zip(
            episodes.scene, episodes.room, episodes.goal, episodes.pose, episodes.best_length, strict=True
        )
    ]
    for r, row in enumerate(rows):
        for seed in range(outcome.length.shape[1]):
            columns = (outcome.length, *metrics.values(), outcome.weight)
            values = np.stack([np.asarray(column)[r, seed] for column in columns], axis=-1)
            writer.writerows(
                (*row, seed, *known, *(f"{value:.6g}" for value in own))
                for known, own in zip(fixed, values.tolist(), strict=True)
            )
    return text.getvalue()
