"""Comparison of methods: training, evaluation and document."""

import json
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxnav.baselines.frontier import frontier_outcome
from jaxnav.evaluation.episodes import EpisodeList, together
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.notes import last_quarter, notes
from jaxnav.evaluation.report import Decoding
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import Run
from jaxnav.runs.evaluate import Results, episode_lists, evaluate
from jaxnav.runs.worlds import evaluation_world
from jaxnav.study.codec import from_json
from jaxnav.study.compare_config import CompareConfig, Entry, entries, entry_identity, frontier_identity, world_runs
from jaxnav.study.compare_pairs import chooses_actions
from jaxnav.study.compare_report import SCALE, Line, Scores, Training
from jaxnav.study.compare_tables import frontier_name, write_comparison
from jaxnav.study.document import check_document
from jaxnav.study.paper_tables import write_paper_tables
from jaxnav.study.results import is_written, kept_note, write_record
from jaxnav.study.runs import ensure_trained

#: What random choices are called where they are no actions, and where they are.
RANDOM_AGENTS = ("random choices", "Random")
#: Name, settings that decide the numbers, and how they are measured.
Job = tuple[str, Mapping[str, Any], Callable[[], Scores]]


def run_compare(config: CompareConfig, console: Console) -> None:
    """Train and evaluate what is missing, and write the document.

    Finished runs and results are kept, so an interrupted comparison goes on where it stopped. The document is written
    anew after every run.

    Raises:
      InputError: the document is another one, or a run is impossible.
    """
    for document in (config.document, config.paper):
        if document is not None:
            check_document(document)
    folder, kept, found = config.results / config.split, 0, {}
    for name, identity, measure in _jobs(config, console):
        path = folder / f"{name}.json"
        if is_written(path, identity):
            kept += 1
        else:
            console.print(f"{path}")
            write_record(path, identity, measure())
        found[name] = from_json(Scores, json.loads(path.read_text()))
        write_comparison(config, found)
        if config.paper is not None:
            write_paper_tables(config.paper, folder)
    if kept:
        console.print(kept_note(kept, folder))
    console.print(f"written to {config.document}")


def _jobs(config: CompareConfig, console: Console) -> list[Job]:
    """Return all jobs of a comparison, the untrained ones first."""
    searched: list[Job] = [
        (frontier_name(world), frontier_identity(config, run), partial(measure_frontier, config, run, console))
        for world, run in world_runs(config).items()
    ]
    trained: list[Job] = [
        (entry.name, entry_identity(config, entry), partial(measure_entry, config, entry, console))
        for entry in entries(config)
    ]
    return searched + trained


def measure_entry(config: CompareConfig, entry: Entry, console: Console) -> Scores:
    """Train a run unless it is finished, and evaluate it.

    The numbers are those of `jaxnav eval` with the same split, number of episodes, epsilon, form and seed.
    """
    ensure_trained(entry.run, console)
    run = Run(entry.run)
    results = evaluate(
        run,
        split=config.split,
        episodes=config.episodes,
        epsilon=(config.epsilon,),
        form=(config.form,),
        seed=config.seed,
        console=console,
    )
    success = results.metrics()["sr"]
    random, room_prior = RANDOM_AGENTS[chooses_actions(entry.method)], entry.run.layout.prior == "room"
    told = notes(results.rows, success, results.episodes, room_prior=room_prior, random=random)
    budget, wall = results.report["run"]["budget"], run.times()[-1]["wall_s"]
    return by_scene(results, Training(budget, wall, last_quarter(run.log()), tuple(told)))


def by_scene(results: Results, training: Training) -> Scores:
    """Return the results of an evaluation, scene by scene."""
    metrics = results.metrics()
    lines = [
        _line(row.variant, row.decoding, {name: metrics[name][i] for name in SCALE}, results.episodes)
        for i, row in enumerate(results.rows)
    ]
    return _scores(results.episodes, lines, training)


def measure_frontier(config: CompareConfig, run: RunConfig, console: Console) -> Scores:
    """Search the frontiers in the episodes of a world."""
    world = evaluation_world(run, config.split, None, None, console)
    lists = episode_lists(world, config.episodes, config.seed)
    outcomes = [
        frontier_outcome(bank, episodes, world.limits(bank)) for bank, episodes in zip(world.banks, lists, strict=True)
    ]
    outcome, episodes = jax.tree.map(lambda *leaves: np.concatenate(leaves)[None], *outcomes), together(lists)
    metrics = episode_metrics(outcome, episodes.best_length)
    return _scores(episodes, [_line("frontier", "argmax", metrics, episodes)])


def _line(variant: str, decoding: Decoding, metrics: Mapping[str, np.ndarray], episodes: EpisodeList) -> Line:
    """Add up metrics [S, E] over the episodes of each scene."""
    drawn = np.unique(episodes.scene)
    inside = (episodes.scene[:, None] == drawn).astype(np.float64)  # [E, N]
    return Line(variant, decoding, **{name: metrics[name] @ inside for name in SCALE})


def _scores(episodes: EpisodeList, lines: Iterable[Line], training: Training | None = None) -> Scores:
    """Return results with what is known of the scenes."""
    drawn, first, counts = np.unique(episodes.scene, return_index=True, return_counts=True)
    rooms = tuple(episodes.rooms[room] for room in episodes.room[first])
    return Scores(tuple(episodes.scenes[scene] for scene in drawn), rooms, counts, tuple(lines), training)
