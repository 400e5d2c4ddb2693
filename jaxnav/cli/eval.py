"""The evaluation command: fixed episodes, all variants and epsilons at once; a table, JSON, a row per episode."""

import csv
import dataclasses
import io
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from jaxnav.cli.arms import ARMS
from jaxnav.cli.train import POLICIES, load_run
from jaxnav.env.make import build_for, in_split, load_scenes
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
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
from jaxnav.evaluation.variants import Row, inference_grid, table_rows
from jaxnav.layout import SETTINGS
from jaxnav.policies.acting import Acting
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.scenes.compile import Bank, compile_bank
from jaxnav.store.export import load_params
from jaxnav.store.files import write_atomic


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """An evaluation of a training run.

    Attributes:
      run: the run directory.
      split: scenes to evaluate on.
      scenes: scene file to read instead of the run's own world or file.
      episodes: in the fixed list, balanced over room types and scenes.
      epsilon: thresholds of sTDE; all of them in one compiled call.
      form: how sTDE combines the logits; default: the run's layout setting's.
      seed: of the episode list, the sampled actions and the bootstrap.
      json: where to write the table; default: in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    scenes: Path | None = None
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.5,)
    form: tuple[Form, ...] | None = None
    seed: int = 0
    json: Path | None = None


class Policies(NamedTuple):
    """All policies of a run.

    Attributes:
      params: leaves [2 S, ...], baseline seeds first, then layout seeds.
      priors: float32 [rooms, K, K].
      spec: sizes.
      categories: [K].
      setting: of the layout estimator.
      seeds: S.
    """

    params: dict[str, Any]
    priors: jax.Array
    spec: PolicySpec
    categories: tuple[str, ...]
    setting: str
    seeds: int


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    console, out = Console(stderr=True, highlight=False), Console(width=120, highlight=False)
    try:
        config = tyro.cli(EvalConfig, args=arguments, prog="eval.py", description="Evaluate a training run.")
        evaluate(config, console, out)
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def evaluate(config: EvalConfig, console: Console, out: Console) -> None:
    """Evaluate a run: print the table and write JSON and one CSV row per episode."""
    if not 0 <= config.seed < 2**32:
        raise InputError(f"--seed {config.seed}: give a whole number from 0 to 2**32 - 1")
    run = load_run(config.run)
    policies = load_policies(config.run, run.seeds)
    rows = table_rows(config.epsilon, config.form or (SETTINGS[policies.setting].form,))
    worlds, source = run.worlds, config.scenes or run.source
    scenes = load_scenes(source, worlds.num_train, worlds.num_val, worlds.num_test, worlds.seed)
    bank = compile_bank(in_split(scenes, config.split, source), policies.categories, run.detector)
    env, params = build_for(bank, config.split, worlds.train_step_limit, worlds.step_limit, worlds.large_step_limit)
    episodes = episode_list(bank, config.episodes, config.seed)
    outcome, compilations = evaluate_grid(
        inference_grid(rows, policies.seeds),
        policies.params,
        episodes,
        Acting(env, policies.setting),
        policies.spec,
        params,
        policies.priors,
        jax.random.key(config.seed),
    )
    outcome = jax.tree.map(lambda leaf: leaf.reshape(len(rows), policies.seeds, -1), outcome)
    report = _report(config, rows, outcome, episodes, policies.spec.method, scenes[0].world, compilations)
    target = config.json or config.run / f"eval-{config.split}.json"
    write_report(target, report)
    write_atomic(target.with_suffix(".episodes.csv"), _episode_csv(rows, outcome, episodes, bank).encode())
    out.print(console_table(report))
    out.print(difference_table(report))
    console.print(f"{len(episodes.goal)} episodes, {compilations} compilation; written to {target}")


def load_policies(run_dir: Path, seeds: int) -> Policies:
    """All exported policies of a run.

    Raises:
      InputError: training has not finished, or a file is damaged.
    """
    loaded = [load_params(run_dir / POLICIES / f"{arm}-{seed}") for arm in ARMS for seed in range(seeds)]
    spec = loaded[-1][1]
    return Policies(
        params=jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tensors["policy"] for tensors, _ in loaded)),
        priors=jnp.asarray(loaded[-1][0]["layout"]["prior"]),
        spec=PolicySpec(spec["method"], len(spec["categories"]), Sizes(**spec["sizes"])),
        categories=tuple(spec["categories"]),
        setting=spec["layout"],
        seeds=seeds,
    )


def _report(
    config: EvalConfig,
    rows: list[Row],
    outcome: Outcome,
    episodes: EpisodeList,
    method: str,
    world: str,
    compilations: int,
) -> dict[str, Any]:
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
        if row.variant in ("random", "baseline"):
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
    return build_report(table, differences, compilations)


def _episode_csv(rows: list[Row], outcome: Outcome, episodes: EpisodeList, bank: Bank) -> str:
    """One line per row of the table, seed and episode."""
    metrics = episode_metrics(outcome, episodes.best_length)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [*Row._fields, "seed", "scene", "room", "goal", "start_pose", "best_length", "length", *metrics, "mean_weight"]
    )
    fixed = [
        (bank.names[scene], episodes.rooms[room], bank.categories[goal], pose, best)
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
