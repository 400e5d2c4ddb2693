"""Frozen benchmarks: equal homes, episodes and budgets for every agent.

The manifest of a benchmark, a file in `benchmarks/`, fixes its tracks: homes of a world in the training layout and in
a shifted one. Checksums in the manifest cover the compiled tables and the episode lists, so that scores of different
agents, machines and versions can be compared. `run_benchmark` scores an agent on the tracks.
"""

import csv
import dataclasses
import difflib
import gzip
import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from jaxnav.choices import ShiftKind, Split, WorldName
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.report import UNTRAINED_VARIANTS, package_versions, row_label, to_report_units
from jaxnav.evaluation.statistics import Interval, mean_interval
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.plain_console import to_plain_console
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.evaluate import evaluate
from jaxnav.runs.results import Results
from jaxnav.runs.subjects import AgentSubject, PolicySubject, find_subject
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, draw_episode_lists
from jaxnav.scenes.tables.compile import bank_checksum
from jaxnav.scenes.task import FrontCell
from jaxnav.store.files import expand_home, write_atomic

#: Benchmarks by name.
BENCHMARKS = {path.stem: path for path in sorted((Path(__file__).parent / "benchmarks").glob("*.yaml"))}
#: Version of the JSON layout of scores.
SCORES_FORMAT = 1
#: Name of the score over the episodes of all shifts.
MIXED = "mixed"
#: Columns of the file with a line per episode.
EPISODE_COLUMNS = (
    "track",
    "shift",
    *EvaluationRow._fields,
    "seed",
    "scene",
    "goal",
    "best_length",
    "length",
    "success",
)


@dataclasses.dataclass(frozen=True)
class Track:
    """Homes of a benchmark.

    Attributes:
      name: name of the track.
      world: generated world.
      goals: categories to search for; None for those of the world.
      num_scenes: number of homes.
      checksums: checksum of the tables and the episodes at each layout shift.
    """

    name: str
    world: WorldName
    num_scenes: int
    checksums: tuple[str, ...]
    goals: tuple[str, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Manifest of a benchmark.

    Attributes:
      name: name of the benchmark.
      split: split of the homes.
      scene_seed: seed of the generated homes.
      num_episodes: number of episodes of each track at each shift.
      episode_seed: seed of the episode lists.
      shifts: layout shifts.
      shift_by: categories that exchange their places, see `jaxnav.evaluate`.
      tracks: the tracks.
      front_cell: cell in front of the agent that a view shows, see `Rules.front_cell`; None for that of each world.
    """

    name: str
    split: Split
    scene_seed: int
    num_episodes: int
    episode_seed: int
    shifts: tuple[float, ...]
    shift_by: ShiftKind
    tracks: tuple[Track, ...]
    front_cell: FrontCell | None = None


def load_benchmark(name: str) -> Benchmark:
    """Load the manifest of a benchmark.

    Raises:
      InputError: there is no such benchmark.
    """
    if name not in BENCHMARKS:
        close_names = difflib.get_close_matches(name, BENCHMARKS, n=3) or list(BENCHMARKS)
        raise InputError(f"benchmark {name!r}: is unknown; choose from {', '.join(close_names)}")
    manifest = yaml.safe_load(BENCHMARKS[name].read_text(encoding="utf-8"))

    tracks = []
    for track_name, settings in manifest.pop("tracks").items():
        goals = tuple(settings.pop("goals", ())) or None
        tracks.append(Track(track_name, goals=goals, checksums=tuple(settings.pop("checksums")), **settings))
    return Benchmark(name, shifts=tuple(manifest.pop("shifts")), tracks=tuple(tracks), **manifest)


# Scores


class TrackResults(NamedTuple):
    """Results of an agent on a track at one layout shift."""

    track: Track
    shift: float
    results: Results


class BenchmarkScores(NamedTuple):
    """Scores of an agent on a benchmark.

    Attributes:
      benchmark: name of the benchmark.
      subject: name of the agent.
      rows: one score for each track, layout shift (a number, or `mixed` for all), and way to use the agent, as JSON.
      track_results: results by track and shift.
    """

    benchmark: str
    subject: str
    rows: list[dict[str, Any]]
    track_results: list[TrackResults]

    def write(self, path: str | Path) -> None:
        """Write the scores as JSON, and beside them a compressed CSV file with a line per row, seed and episode.

        Raises:
          OSError: a file cannot be written.
        """
        scores = {
            "benchmark": self.benchmark,
            "subject": self.subject,
            "rows": self.rows,
            "versions": package_versions(),
            "format": SCORES_FORMAT,
        }
        path = expand_home(path)
        write_atomic(path, (json.dumps(scores, indent=1, allow_nan=False) + "\n").encode())
        csv_path = path.with_name(f"{path.name.removesuffix('.json')}.episodes.csv.gz")
        write_atomic(csv_path, gzip.compress(_format_episodes(self.track_results).encode(), mtime=0))


def run_benchmark(
    subject: Any,
    name: str = "v2",
    tracks: Sequence[str] | None = None,
    console: Console | None = None,
    **policy_options: Any,
) -> BenchmarkScores:
    """Score an agent, a policy or a run on the tracks of a benchmark.

    Args:
      subject: agent, policy or run, see `jaxnav.evaluate`.
      name: name of the benchmark.
      tracks: names of tracks; None for all tracks with the categories of a policy, or for all tracks.
      console: console for progress; None for silence.
      policy_options: options of `jaxnav.evaluate` that say how a policy removes experience, such as `epsilon`.

    Raises:
      InputError: unknown benchmark or track, tables that differ from the manifest, a policy of other categories, or
        a subject that `jaxnav.evaluate` refuses.
    """
    console = to_plain_console(console)
    benchmark = load_benchmark(name)
    found_subject = find_subject(subject)
    if isinstance(found_subject, PolicySubject):
        policy_options = {"costs": "none"} | policy_options
    track_results = []
    for track in _select_tracks(benchmark, tracks, found_subject):
        for shift, checksum in zip(benchmark.shifts, track.checksums, strict=True):
            console.print(f"benchmark {name}, track {track.name}, layout shift {shift:g}")
            compiled = compile_track(benchmark, track, shift, console)
            if checksum_track(benchmark, compiled) != checksum:
                raise InputError(
                    f"benchmark {name}, track {track.name}: the homes at shift {shift:g} differ from those of the "
                    "manifest, so scores could not be compared; report your versions of jaxnav and NumPy"
                )
            results = evaluate(
                subject,
                split=benchmark.split,
                world=track.world if isinstance(found_subject, AgentSubject) else None,
                shift=shift,
                shift_by=benchmark.shift_by,
                episodes=benchmark.num_episodes,
                seed=benchmark.episode_seed,
                compiled=compiled,
                console=console,
                **policy_options,
            )
            track_results.append(TrackResults(track, shift, results))
    has_runs = isinstance(found_subject, PolicySubject) and found_subject.run is not None
    has_runs = has_runs or (isinstance(found_subject, AgentSubject) and len(found_subject.agents) > 1)
    rows = _score_rows(track_results, found_subject.name, has_runs)
    return BenchmarkScores(name, found_subject.name, rows, track_results)


def scores_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Make the table of scores for a terminal, `mean [95 % interval]` of SR and SPL at every shift."""
    shifts = list(dict.fromkeys(row["shift"] for row in rows))
    titles = []
    for metric in ("SR", "SPL"):
        titles += [f"{metric}, {shift_title(shift)}" for shift in shifts]
    table = Table("Agent", "track", *titles)

    # Rows of one way to use the agent on a track stand in one line.
    cells_by_line: dict[tuple[str, str], dict[tuple[str, Any], str]] = {}
    for row in rows:
        cells = cells_by_line.setdefault((score_label(row), row["track"]), {})
        for metric in ("sr", "spl"):
            cells[metric, row["shift"]] = f"{Interval.from_json(row[metric]):.1f}"
    for line, cells in cells_by_line.items():
        row = list(line)
        for metric in ("sr", "spl"):
            row += [cells[metric, shift] for shift in shifts]
        table.add_row(*row)
    return table


def shift_title(shift: float | str) -> str:
    """Title of a layout shift in tables."""
    return str(shift) if shift == MIXED else f"shift {shift:g}"


def score_label(row: dict[str, Any]) -> str:
    """Name of a way to use an agent, as in tables of evaluations, with the decoding of sampled actions."""
    suffix = ", sampled" if row["decoding"] == "sample" else ""
    return row_label(row) + suffix


def compile_track(benchmark: Benchmark, track: Track, shift: float, console: Console) -> CompiledWorld:
    """Compile the homes of a track at a layout shift."""
    worlds = WorldConfig(seed=benchmark.scene_seed, goals=track.goals, front_cell=benchmark.front_cell)
    worlds = dataclasses.replace(worlds, **{f"num_{benchmark.split}": track.num_scenes})
    config = RunConfig(world=track.world, worlds=worlds)
    return compile_evaluation_world(config, benchmark.split, None, shift, console, shift_by=benchmark.shift_by)


def checksum_track(benchmark: Benchmark, compiled: CompiledWorld) -> str:
    """SHA-256 of the compiled tables and the episodes of a track, the first 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for bank in compiled.banks:
        digest.update(bank_checksum(bank).to_bytes(4, "little"))
    for episodes in draw_episode_lists(compiled, benchmark.num_episodes, benchmark.episode_seed):
        for indices in (episodes.scene, episodes.goal, episodes.pose, episodes.best_length):
            digest.update(np.ascontiguousarray(indices, "<i4").tobytes())
    return digest.hexdigest()[:16]


def _select_tracks(
    benchmark: Benchmark, names: Sequence[str] | None, found_subject: PolicySubject | AgentSubject
) -> list[Track]:
    """Select tracks by name. A policy can act only in tracks with the categories that it was trained for."""
    track_by_name = {track.name: track for track in benchmark.tracks}
    for name in names or ():
        if name not in track_by_name:
            raise InputError(f"track {name!r}: is unknown; choose from {', '.join(track_by_name)}")

    def fits(track: Track) -> bool:
        if isinstance(found_subject, AgentSubject):
            return True
        categories = RunConfig(world=track.world, worlds=WorldConfig(goals=track.goals)).task.categories
        return found_subject.config.task.categories == categories

    selected = [track_by_name[name] for name in names] if names else [*filter(fits, benchmark.tracks)]
    unfit_names = [track.name for track in selected if not fits(track)]
    if unfit_names or not selected:
        raise InputError(
            f"{found_subject.name}: was trained for other categories than those of "
            f"{' and '.join(unfit_names) or f'benchmark {benchmark.name}'}; give --tracks with its categories"
        )
    return selected


def _score_rows(track_results: Sequence[TrackResults], subject: str, has_runs: bool) -> list[dict[str, Any]]:
    """Score every way to use the agent on each track: at each shift, and over the episodes of all shifts."""
    score_rows = []
    for track in dict.fromkeys(entry.track for entry in track_results):
        shift_results = [(entry.shift, entry.results) for entry in track_results if entry.track is track]
        groups: list[tuple[float | str, list[Results]]] = [(shift, [results]) for shift, results in shift_results]
        groups.append((MIXED, [results for _, results in shift_results]))
        for shift, group in groups:
            # Episodes of one home at several shifts belong to one cluster.
            clusters = join_episode_lists([results.episodes for results in group]).clusters()
            group_metrics = [results.metrics() for results in group]
            for row_index, row in enumerate(group[0].rows):
                is_trained = has_runs and row.variant not in UNTRAINED_VARIANTS
                scores = {}
                for metric in group_metrics[0]:
                    values = np.concatenate([metrics[metric][row_index] for metrics in group_metrics], axis=-1)
                    values = to_report_units(metric, values)
                    scores[metric] = mean_interval(values, clusters, trained=is_trained).to_json()
                score_rows.append({"track": track.name, "shift": shift, "method": subject, **row._asdict(), **scores})
    return score_rows


def _format_episodes(track_results: Sequence[TrackResults]) -> str:
    """CSV with a line per track, shift, row, seed and episode."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(EPISODE_COLUMNS)
    for track, shift, results in track_results:
        episodes: EpisodeList = results.episodes
        success = results.metrics()["sr"].astype(int)
        for row_index, row in enumerate(results.rows):
            for seed in range(success.shape[1]):
                for episode in range(len(episodes.goal)):
                    scene_name = episodes.scenes[episodes.scene[episode]]
                    goal_name = results.categories[episodes.goal[episode]]
                    length = int(results.outcome.length[row_index, seed, episode])
                    writer.writerow(
                        (
                            *(track.name, f"{shift:g}", *row, seed, scene_name, goal_name),
                            *(episodes.best_length[episode], length, success[row_index, seed, episode]),
                        )
                    )
    return text.getvalue()
