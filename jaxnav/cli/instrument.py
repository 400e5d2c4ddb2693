"""The proof of the instrument: the dial must change who stands near whom, and nothing else that makes a task hard."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxnav.cli.config import RunConfig
from jaxnav.cli.runs import Policies, load_policies, load_run, settings
from jaxnav.cli.worlds import CompiledWorld, evaluation_world, read_ahead
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.errors import InputError
from jaxnav.evaluation.difficulty import expected_length, random_success
from jaxnav.evaluation.episodes import EpisodeList, episode_list, together
from jaxnav.evaluation.frontier import frontier_outcome
from jaxnav.evaluation.grid import evaluate_grid
from jaxnav.evaluation.report import FORMAT, versions, write_report
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, scene_counts
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.acting import Acting
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.compile import Bank

#: Difficulty is matched where it changes by at most so many percent; the baseline must lose at least so many points.
TOLERANCE, LOSS = 5.0, 8.0
RESAMPLES = 2000

#: Rows of the table: name and decimals. The first three must not depend on the dial.
MEASURES = {
    "best_length": ("Shortest path L* (actions)", 2),
    "random_sr": ("Random SR (%)", 2),
    "frontier_sr": ("Frontier search SR (%)", 1),
    "frontier_steps": ("Frontier search, actions", 1),
    "layout_gap": ("Layout gap to the prior, KL (nats)", 3),
    "layout_similarity": ("Layout similarity to the prior, cosine", 3),
    "baseline_argmax_sr": ("Baseline SR, argmax (%)", 1),
    "baseline_sample_sr": ("Baseline SR, sampled (%)", 1),
}
MATCHED, BASELINES = tuple(MEASURES)[:3], tuple(MEASURES)[-2:]


@dataclasses.dataclass(frozen=True)
class InstrumentConfig:
    """The proof of the instrument, with a run on a generated world.

    Attributes:
      run: the run directory; the table is also written there, as instrument-SPLIT.json.
      shift: layout shifts, at least two; all are compared with the lowest.
      split: scenes to evaluate on.
      episodes: at each shift; see the evaluation.
      scenes_per_split: generated scenes; default: the run's.
      seed: of the episode lists, the sampled actions and the bootstrap.
    """

    run: Annotated[Path, tyro.conf.Positional]
    shift: tuple[float, ...] = (0.0, 0.5, 1.0)
    split: Literal["train", "val", "test"] = "val"
    episodes: int = 1000
    scenes_per_split: int | None = None
    seed: int = 0


class Totals(NamedTuple):
    """What was measured in the N scenes at one shift.

    Attributes:
      values: by name of the measure, float64 [S, N]: sums over the scene's episodes by seed (S = 1 without seeds).
      weights: by name of the measure, float64 [N]: over how many they are; a mean is sum of values / sum of weights.
      rooms: [N] room types.
      names: [N] of the scenes.
    """

    values: dict[str, np.ndarray]
    weights: dict[str, np.ndarray]
    rooms: tuple[str, ...]
    names: tuple[str, ...]


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, also where the proof fails, or 2 after bad input."""
    console, out = Console(stderr=True, highlight=False), Console(width=120, highlight=False)
    try:
        config = tyro.cli(InstrumentConfig, args=arguments, prog="eval.py instrument", description="Prove the dial.")
        prove(config, console, out)
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def prove(config: InstrumentConfig, console: Console, out: Console) -> None:
    """Measure at every shift, print the table and what it shows, and write JSON."""
    shifts = sorted(set(config.shift))
    if len(shifts) < 2:
        raise InputError(f"--shift {' '.join(map(str, config.shift))}: give at least two different shifts")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"--seed {config.seed}: give a whole number from 0 to 2**32 - 1")
    run = load_run(config.run)
    if run.scenes:
        raise InputError(f"{config.run}: is a run on scenes of a file; only generated worlds can be shifted")
    policies = load_policies(run)
    if config.scenes_per_split is not None:
        worlds = dataclasses.replace(run.worlds, **{f"num_{config.split}": config.scenes_per_split})
        run = dataclasses.replace(run, worlds=worlds)
    totals = []
    for shift in shifts:
        console.print(f"shift {shift:g}:")
        totals.append(measure(config, run, policies, evaluation_world(run, config.split, None, shift, console)))
    table = compare(shifts, totals, config.seed)
    about = settings(run) | {"evaluation_split": config.split, "evaluation_seed": config.seed}
    report = {"run": about, **table, "versions": versions(), "format": FORMAT}
    out.print(console_table(report))
    for line in verdicts(report):
        out.print(line, markup=False)
    target = config.run / f"instrument-{config.split}.json"
    try:
        write_report(target, report)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror})") from error
    console.print(f"written to {target}", soft_wrap=True)


def measure(config: InstrumentConfig, run: RunConfig, policies: Policies, world: CompiledWorld) -> Totals:
    """Everything that is measured at one shift.

    L* and Random are means over all episodes that could be drawn in a scene, not over the drawn ones: without noise.
    """
    each = -(-config.episodes // len(world.banks))
    lists = [episode_list(bank, each, config.seed, part) for part, bank in enumerate(world.banks)]
    episodes = together(lists)
    decodings = [table_row("baseline", None, None, decoding) for decoding in ("argmax", "sample")]
    outcome, _ = evaluate_grid(
        inference_grid(decodings, run.seeds),
        policies.params,
        zip(lists, read_ahead(world, range(len(world.banks))), strict=True),
        Acting(world.env, policies.setting),
        policies.spec,
        policies.priors,
        jax.random.key(config.seed),
    )
    count = np.bincount(episodes.scene, minlength=len(episodes.scenes)).astype(np.float64)

    def summed(values: np.ndarray) -> np.ndarray:
        """Values [S, E] added up by scene, [S, N]."""
        return np.stack([np.bincount(episodes.scene, own, len(episodes.scenes)) for own in values])

    argmax, sample = 100.0 * np.asarray(outcome.success, np.float64).reshape(2, run.seeds, -1)
    priors = np.asarray(policies.priors, np.float64)
    parts = [_of_bank(bank, own, world, priors) for bank, own in zip(world.banks, lists, strict=True)]
    length, random, success, steps, gap, similarity = map(np.concatenate, zip(*parts, strict=True))
    shown = (~np.isnan(gap)).astype(np.float64)  # scenes that show two categories together
    values = {
        "best_length": count * length[None],
        "random_sr": count * 100.0 * random[None],
        "frontier_sr": summed(100.0 * success[None]),
        "frontier_steps": summed(steps[None].astype(np.float64)),
        "layout_gap": np.nan_to_num(gap)[None],
        "layout_similarity": np.nan_to_num(similarity)[None],
        "baseline_argmax_sr": summed(argmax),
        "baseline_sample_sr": summed(sample),
    }
    weights = {name: shown if name.startswith("layout") else count for name in MEASURES}
    return Totals(values, weights, tuple(room for bank in world.banks for room in bank.room_types), episodes.scenes)


def _of_bank(bank: Bank, episodes: EpisodeList, world: CompiledWorld, priors: np.ndarray) -> tuple[np.ndarray, ...]:
    """L* and Random [S], the searcher's successes and actions [E], gap and similarity to the priors [S]."""
    limits = np.array([world.step_limits.get(room, world.step_limit) for room in bank.room_types])
    searched, counts = frontier_outcome(bank, episodes, limits), scene_counts(bank)
    prior = priors[[ROOM_TYPES.index(room) if room in ROOM_TYPES else OTHER_ROOM for room in bank.room_types]]
    own = expected_length(bank), random_success(bank, limits), searched.success, searched.length
    return *own, layout_gap(counts, prior), layout_similarity(counts, prior)


def compare(shifts: list[float], totals: list[Totals], seed: int) -> dict[str, Any]:
    """The table, and what it shows of the dial, with 95 % bootstrap intervals.

    A resample draws scenes within each room type and training seeds; a drawn scene is there at all shifts, with its
    twins, and so is a drawn seed.
    """
    names = sorted({name for own in totals for name in own.names})
    rooms = {name: room for own in totals for name, room in zip(own.names, own.rooms, strict=True)}
    seeds = len(totals[0].values[BASELINES[0]])
    generator = np.random.default_rng(seed)
    scene_draws = _draws(np.array([rooms[name] for name in names]), generator)
    seed_draws = _draws(np.zeros(seeds), generator) / seeds

    def means(measure: str, own: Totals) -> np.ndarray:
        """The mean [0] and its resamples [1:]."""
        place, values = [names.index(name) for name in own.names], own.values[measure]
        scenes = np.concatenate([np.ones((1, len(place))), scene_draws[:, place]])
        drawn = np.concatenate([np.full((1, seeds), 1 / seeds), seed_draws])
        sums = scenes @ values.T
        return (sums * (drawn if len(values) > 1 else 1.0)).sum(axis=1) / (scenes @ own.weights[measure])

    every = {measure: [means(measure, own) for own in totals] for measure in MEASURES}
    table = [
        {"shift": shift, "scenes": len(own.names), "episodes": int(own.weights["frontier_sr"].sum())}
        | {measure: _summary(every[measure][i]) for measure in MEASURES}
        for i, (shift, own) in enumerate(zip(shifts, totals, strict=True))
    ]
    matched = []
    for measure in MATCHED:
        first, *others = every[measure]
        for shift, own in zip(shifts[1:], others, strict=True):
            if not first[0]:
                raise InputError(
                    f"{measure} is 0 at shift {shifts[0]:g}: nothing to compare with; give more --episodes"
                )
            change = 100.0 * (own - first) / first[0]
            holds = bool(abs(change[0]) <= TOLERANCE)
            matched.append({"measure": measure, "from": shifts[0], "to": shift, **_summary(change), "holds": holds})
    discriminating = []
    for measure in BASELINES:
        loss = _summary(every[measure][0] - every[measure][-1])
        holds = loss["mean"] >= LOSS and loss["ci95"][0] > 0
        discriminating.append({"measure": measure, "from": shifts[0], "to": shifts[-1], **loss, "holds": holds})
    return {"shifts": table, "matched": matched, "discriminating": discriminating}


def _draws(strata: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """How often each item comes up in a resample: int [RESAMPLES, N]; strata keep their sizes."""
    counts = np.zeros((RESAMPLES, len(strata)))
    for stratum in np.unique(strata):
        members = np.flatnonzero(strata == stratum)
        counts[:, members] = generator.multinomial(len(members), np.full(len(members), 1 / len(members)), RESAMPLES)
    return counts


def _summary(means: np.ndarray) -> dict[str, Any]:
    return {"mean": float(means[0]), "ci95": np.percentile(means[1:], (2.5, 97.5)).tolist()}


def console_table(report: dict[str, Any]) -> Table:
    """A column per shift, `mean [95 % interval]`."""
    table = Table("Layout shift", *(f"{own['shift']:g}" for own in report["shifts"]))
    for name in ("scenes", "episodes"):
        table.add_row(name.capitalize(), *(str(own[name]) for own in report["shifts"]))
    for measure, (title, digits) in MEASURES.items():
        cells = [_cell(own[measure], f".{digits}f") for own in report["shifts"]]
        table.add_row(*map(Text, (title, *cells)))  # Text: brackets are not markup
    return table


def verdicts(report: dict[str, Any]) -> list[str]:
    """What the table shows, line by line."""

    def line(own: dict[str, Any], what: str) -> str:
        return f"  {'yes' if own['holds'] else 'NO':3}  {MEASURES[own['measure']][0]}, {what}"

    return [
        f"Difficulty matched (within {TOLERANCE:g} % of shift {report['shifts'][0]['shift']:g})?",
        *(line(own, f"shift {own['to']:g}: {_cell(own, '+.1f')} %") for own in report["matched"]),
        f"Discriminating (at least {LOSS:g} points lost, the interval clear of 0)?",
        *(
            line(own, f"shift {own['from']:g} to {own['to']:g}: {_cell(own, '.1f')} points lost")
            for own in report["discriminating"]
        ),
    ]


def _cell(own: dict[str, Any], form: str) -> str:
    low, high = own["ci95"]
    return f"{own['mean']:{form}} [{low:{form}}, {high:{form}}]"
