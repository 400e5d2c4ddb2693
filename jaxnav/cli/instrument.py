"""The proof of the instrument: what the layout shift changes for a run, and for those who have no experience."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from rich.console import Console

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.baselines.frontier import frontier_outcome
from jaxnav.cli.console import exit_code, result_console
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list, together
from jaxnav.evaluation.grid import evaluate_grid
from jaxnav.evaluation.report import FORMAT, versions, write_report
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, scene_counts
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.acting import Acting
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import load_run, settings
from jaxnav.runs.policies import Policies, load_policies
from jaxnav.runs.worlds import CompiledWorld, evaluation_world, read_ahead
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.compile import Bank
from jaxnav.study.config import StudyConfig, ensure, parse_study, training
from jaxnav.study.dial import Totals, compare, console_table, verdicts


@dataclasses.dataclass(frozen=True)
class InstrumentConfig:
    """The proof of the instrument, with a finished run.

    Attributes:
      run: the run directory; the table is also written there, as instrument-SPLIT.json.
      shift: layout shifts, at least two; all are compared with the lowest.
      split: scenes to evaluate on.
      episodes: at each shift; see the evaluation.
      scenes_per_split: generated scenes of the split; default: the run's.
      seed: of the episode lists, the sampled actions and the bootstrap.
    """

    run: Annotated[Path, tyro.conf.Positional]
    shift: tuple[float, ...] = (0.0, 0.5, 1.0)
    split: Literal["train", "val", "test"] = "val"
    episodes: int = 1000
    scenes_per_split: int | None = None
    seed: int = 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, also where the proof fails, or 2 after bad input."""
    if any(argument.split("=")[0] == "--config" for argument in arguments or []):
        return exit_code(lambda console: prove(main_run(parse_study(arguments), console), console, result_console()))
    what = "Prove the dial with a finished run, or `--config FILE` with the main run of a study, trained if need be."
    config = tyro.cli(InstrumentConfig, args=arguments, prog="eval.py instrument", description=what)
    return exit_code(lambda console: prove(config, console, result_console()))


def main_run(config: StudyConfig, console: Console) -> InstrumentConfig:
    """What is asked of the instrument in a study, with its main run, trained unless it is finished."""
    run = training(config, "main")
    ensure(run, console)
    return of_study(config, run)


def of_study(config: StudyConfig, run: RunConfig) -> InstrumentConfig:
    """What is asked of the instrument with one of the study's runs."""
    return InstrumentConfig(run.run_dir, config.shifts, config.split, config.episodes, seed=config.seed)


def prove(config: InstrumentConfig, console: Console, out: Console) -> None:
    """Measure at every shift, print the table and what it shows, and write JSON."""
    if not all(0.0 <= shift <= 1.0 for shift in config.shift):
        raise InputError(f"--shift {' '.join(map(str, config.shift))}: give numbers from 0 to 1")
    if len(set(config.shift)) < 2:
        raise InputError(f"--shift {' '.join(map(str, config.shift))}: give at least two different shifts")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"--seed {config.seed}: give a whole number from 0 to 2**32 - 1")
    run = load_run(config.run)
    if config.scenes_per_split is not None:
        if run.scenes:
            raise InputError(f"--scenes-per-split: {config.run} is a run on scenes of a file; leave it out")
        worlds = dataclasses.replace(run.worlds, **{f"num_{config.split}": config.scenes_per_split})
        run = dataclasses.replace(run, worlds=worlds)
    report = instrument_report(config, run, console)
    out.print(console_table(report))
    for line in verdicts(report):
        out.print(line, markup=False)
    target = config.run / f"instrument-{config.split}.json"
    try:
        write_report(target, report)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror})") from error
    console.print(f"written to {target}", soft_wrap=True)


def instrument_report(config: InstrumentConfig, run: RunConfig, console: Console) -> dict[str, Any]:
    """The instrument's table for a finished run, and what it shows."""
    policies, totals = load_policies(run), []
    for shift in sorted(set(config.shift)):
        console.print(f"shift {shift:g}:")
        totals.append(measure(config, run, policies, evaluation_world(run, config.split, None, shift, console)))
    about = settings(run) | {"evaluation_split": config.split, "evaluation_seed": config.seed}
    return {
        "run": about,
        **compare(sorted(set(config.shift)), totals, config.seed),
        "versions": versions(),
        "format": FORMAT,
    }


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
    weights = {name: shown if name.startswith("layout") else count for name in values}
    return Totals(values, weights, tuple(room for bank in world.banks for room in bank.room_types), episodes.scenes)


def _of_bank(bank: Bank, episodes: EpisodeList, world: CompiledWorld, priors: np.ndarray) -> tuple[np.ndarray, ...]:
    """L* and Random [S], the searcher's successes and actions [E], gap and similarity to the priors [S]."""
    limits = np.array([world.step_limits.get(room, world.step_limit) for room in bank.room_types])
    searched, counts = frontier_outcome(bank, episodes, limits), scene_counts(bank)
    prior = priors[[ROOM_TYPES.index(room) if room in ROOM_TYPES else OTHER_ROOM for room in bank.room_types]]
    own = expected_length(bank), random_success(bank, limits), np.asarray(searched.success), np.asarray(searched.length)
    return *own, layout_gap(counts, prior), layout_similarity(counts, prior)
