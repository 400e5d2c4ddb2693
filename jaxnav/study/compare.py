"""Comparison of methods: training, evaluation and documents.

`run_compare` trains and evaluates every run of a comparison that has no results yet, and writes the documents. The
results of a run are summed by scene (`scores_by_scene`), which suffices for all means and intervals of the tables.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from jaxnav.baselines.frontier import run_frontier_search
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import episode_metrics
from jaxnav.evaluation.notes import evaluation_notes, last_quarter_success
from jaxnav.evaluation.report import Decoding
from jaxnav.runs.config import RunConfig
from jaxnav.runs.evaluate import Results, draw_episode_lists, evaluate
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.study.compare_config import (
    CompareConfig,
    ComparedRun,
    chooses_actions,
    compared_runs,
    frontier_identity,
    run_identity,
    world_run_configs,
)
from jaxnav.study.compare_tables import frontier_name, write_comparison
from jaxnav.study.config import ensure_trained
from jaxnav.study.document import check_document
from jaxnav.study.paper_tables import write_paper_tables
from jaxnav.study.records import METRIC_SCALE, AgentScores, RunScores, TrainingSummary, from_json
from jaxnav.study.results import has_record, reuse_note, write_record

#: Names of random choices: of methods whose choices are not actions, and of methods whose choices are.
RANDOM_AGENTS = ("random choices", "Random")


class MeasurementJob(NamedTuple):
    """One result file of a comparison.

    Attributes:
      name: of the file.
      identity: settings that determine the results.
      measure: trains what is missing and evaluates it.
    """

    name: str
    identity: Mapping[str, Any]
    measure: Callable[[], RunScores]


def run_compare(config: CompareConfig, console: Console) -> None:
    """Train and evaluate the runs that have no results yet, and write the documents.

    Finished runs and results are reused, so an interrupted comparison resumes where it stopped. The documents are
    rewritten after every run.

    Raises:
      InputError: a file is another document, or a run is impossible.
    """
    for document in (config.document, config.paper):
        if document is not None:
            check_document(document)

    folder = config.results / config.split
    num_reused = 0
    scores_by_name = {}
    for job in _measurement_jobs(config, console):
        path = folder / f"{job.name}.json"
        if has_record(path, job.identity):
            num_reused += 1
        else:
            console.print(f"{path}")
            write_record(path, job.identity, job.measure())

        # Results are read back, so that documents depend on the files alone.
        scores_by_name[job.name] = from_json(RunScores, json.loads(path.read_text()))
        write_comparison(config, scores_by_name)
        if config.paper is not None:
            write_paper_tables(config.paper, folder)

    if num_reused:
        console.print(reuse_note(num_reused, folder))
    console.print(f"written to {config.document}")


def _measurement_jobs(config: CompareConfig, console: Console) -> list[MeasurementJob]:
    """List all jobs of a comparison, those without training first."""
    jobs = []
    for world, run in world_run_configs(config).items():
        measure = partial(measure_frontier, config, run, console)
        jobs.append(MeasurementJob(frontier_name(world), frontier_identity(config, run), measure))
    for compared_run in compared_runs(config):
        measure = partial(measure_run, config, compared_run, console)
        jobs.append(MeasurementJob(compared_run.name, run_identity(config, compared_run), measure))
    return jobs


def measure_run(config: CompareConfig, compared_run: ComparedRun, console: Console) -> RunScores:
    """Train a run unless it is finished, and evaluate it.

    The numbers equal those of `jaxnav eval` with the same split, number of episodes, epsilon, form and seed.
    """
    # Train and evaluate.
    ensure_trained(compared_run.run, console)
    run = Run(compared_run.run)
    results = evaluate(
        run,
        split=config.split,
        episodes=config.episodes,
        epsilon=(config.epsilon,),
        form=(config.form,),
        seed=config.seed,
        console=console,
    )

    # The document prints caveats and the cost of training beside the results.
    notes = evaluation_notes(
        results.rows,
        results.metrics()["sr"],
        results.episodes,
        has_room_prior=compared_run.run.layout.prior == "room",
        random_name=RANDOM_AGENTS[chooses_actions(compared_run.method)],
    )
    training = TrainingSummary(
        budget=results.report["run"]["budget"],
        wall_s=run.times()[-1]["wall_s"],
        course=last_quarter_success(run.log()),
        notes=tuple(notes),
    )
    return scores_by_scene(results, training)


def measure_frontier(config: CompareConfig, run: RunConfig, console: Console) -> RunScores:
    """Evaluate frontier search on the episodes of a world."""
    world = compile_evaluation_world(run, config.split, None, None, console)
    episode_lists = draw_episode_lists(world, config.episodes, config.seed)
    outcomes = []
    for bank, bank_episodes in zip(world.banks, episode_lists, strict=True):
        outcomes.append(run_frontier_search(bank, bank_episodes, world.scene_step_limits(bank)))

    # The search is deterministic, so it counts as a single run: leaves [1, E].
    outcome = jax.tree.map(lambda *leaves: np.concatenate(leaves)[None], *outcomes)
    episodes = join_episode_lists(episode_lists)
    metrics = episode_metrics(outcome, episodes.best_length)
    return _run_scores(episodes, [_sum_by_scene("frontier", "argmax", metrics, episodes)])


def scores_by_scene(results: Results, training: TrainingSummary) -> RunScores:
    """Sum the results of an evaluation by scene."""
    metrics = results.metrics()
    agents = []
    for row_index, row in enumerate(results.rows):
        row_metrics = {name: metrics[name][row_index] for name in METRIC_SCALE}
        agents.append(_sum_by_scene(row.variant, row.decoding, row_metrics, results.episodes))
    return _run_scores(results.episodes, agents, training)


def _sum_by_scene(
    variant: str, decoding: Decoding, metrics: Mapping[str, np.ndarray], episodes: EpisodeList
) -> AgentScores:
    """Sum metrics [S, E] over the episodes of each scene, [S, N]."""
    scenes = np.unique(episodes.scene)
    membership = (episodes.scene[:, None] == scenes).astype(np.float64)  # [E, N]
    return AgentScores(variant, decoding, **{name: metrics[name] @ membership for name in METRIC_SCALE})


def _run_scores(
    episodes: EpisodeList, agents: Sequence[AgentScores], training: TrainingSummary | None = None
) -> RunScores:
    """Add the names, room types and numbers of episodes of the scenes."""
    scenes, first_episodes, episode_counts = np.unique(episodes.scene, return_index=True, return_counts=True)
    return RunScores(
        scenes=tuple(episodes.scenes[scene] for scene in scenes),
        rooms=tuple(episodes.rooms[room] for room in episodes.room[first_episodes]),
        episodes=episode_counts,
        lines=tuple(agents),
        training=training,
    )
