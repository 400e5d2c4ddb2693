"""The workbench of an experiment: trained runs and evaluations, each made once, and compiled worlds.

Measurements ask a `Bench` for what they need, and the bench trains or evaluates what is missing.
"""

import dataclasses
import hashlib
import io
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.report import to_report_units
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.experiments.config import AgentRun, ExperimentConfig, agent_runs, part_settings
from jaxnav.experiments.table import ResultRow, ResultTable, read_part
from jaxnav.plain_console import to_plain_console
from jaxnav.runs.evaluate import evaluate
from jaxnav.runs.policies import load_policies
from jaxnav.runs.results import Results
from jaxnav.runs.run import Run, load_run_config, run_settings
from jaxnav.runs.train import train
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world
from jaxnav.store.files import write_atomic


class Scores(NamedTuple):
    """Results of an evaluation, episode by episode.

    Attributes:
      metrics: by row of the evaluation, the metrics [S, E] in the units of the result table.
      episodes: the E episodes.
      results: the evaluation itself.
    """

    metrics: dict[EvaluationRow, Mapping[str, np.ndarray]]
    episodes: EpisodeList
    results: Results


def best_epsilon(table: ResultTable, world: str, agent: str, shift: float) -> float | None:
    """Threshold of sTDE with the greatest SR, in the residual form and with best actions; None without any result."""
    fields = {"world": world, "run": agent, "variant": "stde", "decoding": "argmax", "shift": shift}
    fields |= {"gap": "novelty", "form": "residual", "control": "", "reference": "", "category": "", "metric": "sr"}
    success = {}
    for row in table.where(**fields).rows:
        success[row.epsilon] = table.find(**fields, epsilon=row.epsilon).mean
    # With equal success, the first epsilon is chosen.
    return max(success, key=lambda epsilon: success[epsilon], default=None)


class Bench:
    """Trains, compiles and evaluates for the measurements of an experiment.

    Args:
      config: the experiment.
      console: prints progress.
    """

    def __init__(self, config: ExperimentConfig, console: Console) -> None:
        self.config = config
        self.console = to_plain_console(console)
        self._runs = {(run.world, run.agent): run for run in agent_runs(config)}
        self._scores: dict[tuple[str, str, float], Scores] = {}
        #: Folder of the outcomes of a part that is not finished; None to keep none.
        self.unfinished_folder: Path | None = None

    def find_run(self, world: str, agent: str) -> AgentRun | None:
        """Run of an agent in a world, or None if the experiment has no such run."""
        return self._runs.get((world, agent))

    def layout_blind_run(self, world: str) -> AgentRun | None:
        """Run of the layout-blind agents, or None if the experiment has none."""
        return self.find_run(world, self.config.reference_agent)

    def chosen_epsilon(self, run: AgentRun) -> float:
        """Look up the threshold with the greatest success on `val`, at the first shift and in the residual form.

        Raises:
          InputError: the experiment has not been done on `val` with these settings.
        """
        folder = self.config.results / "val"
        settings = part_settings(dataclasses.replace(self.config, split="val"), run, [])
        del settings["shifts"]  # every shift has a file
        rows: list[ResultRow] = []
        for path in sorted(folder.glob(f"{run.name}-trials-*.jsonl")):
            rows += read_part(path, settings)
        best = best_epsilon(ResultTable(rows), run.world, run.agent, self.config.shifts[0])
        if best is None:
            raise InputError(
                f"{folder}: has no trials of {run.name} with these settings, from which epsilon is chosen; "
                "give --split val first"
            )
        return best

    def recall_outcomes(self, name: str, measure: Callable[[], list[EpisodeOutcome]]) -> list[EpisodeOutcome]:
        """Load the outcomes that an interrupted call stored under a name, or else measure and store them.

        A part can take hours, and must not begin anew after an interruption.

        Args:
          name: name of the outcomes, unique in the part.
          measure: measures them.
        """
        if self.unfinished_folder is None:
            return measure()
        path = self.unfinished_folder / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.npz"
        outcomes = _load_outcomes(path)
        if outcomes is None:
            outcomes = measure()
            self.unfinished_folder.mkdir(parents=True, exist_ok=True)
            _save_outcomes(path, outcomes)
        return outcomes

    def train(self, run: AgentRun) -> None:
        """Train a run unless it is finished with the same settings."""
        if run.is_external:
            return

        # Loading the policies proves that they exist; equal settings prove that they are those of this experiment.
        try:
            load_policies(run.config, run.config.arms)
            is_finished = run_settings(load_run_config(run.config.run_dir)) == run_settings(run.config)
        except InputError:
            is_finished = False
        if not is_finished:
            self.console.print(f"training {run.config.run_dir}")
            train(run.config, self.console)

    def compile_world(self, run: AgentRun, shift: float) -> CompiledWorld:
        """Compile the scenes of a run at a layout shift."""
        return compile_evaluation_world(
            run.config, self.config.split, None, shift, self.console, shift_by=self.config.shift_by
        )

    def draw_episodes(self, compiled_world: CompiledWorld, num_folds: int = 1) -> EpisodeList:
        """Draw the episodes of the experiment in a world, or the share of one of several folds.

        Raises:
          InputError: the scenes fill more than one shard.
        """
        if len(compiled_world.banks) > 1:
            raise InputError(
                f"split {self.config.split}: its {len(compiled_world.scenes)} scenes fill {len(compiled_world.banks)} "
                f"shards, but a measurement needs one; set worlds.shard_scenes to {len(compiled_world.scenes)} or more"
            )
        num_episodes = -(-self.config.episodes // num_folds)  # rounded up
        return draw_episodes(compiled_world.banks[0], num_episodes, self.config.seed)

    def evaluate(self, run: AgentRun, shift: float) -> Scores:
        """Train a run if necessary, and evaluate its variants as `jaxnav eval` does."""
        key = (run.world, run.agent, shift)
        if key not in self._scores:
            self.train(run)
            self._scores[key] = self._evaluate(run, shift)
        return self._scores[key]

    def _evaluate(self, run: AgentRun, shift: float) -> Scores:
        config = self.config
        self.console.print(f"evaluating {run.config.run_dir} at shift {shift:g}")
        results = evaluate(
            Run(run.config),
            split=config.split,
            shift=shift,
            shift_by=config.shift_by,
            episodes=config.episodes,
            epsilon=config.epsilon,
            form=(config.form,),
            seed=config.seed,
            console=self.console,
        )

        # Rates in percent, distances in metres.
        metrics_by_row = {}
        metrics = results.metrics()
        for index, row in enumerate(results.rows):
            row_metrics = {}
            for name, values in metrics.items():
                row_metrics[name] = to_report_units(name, values[index])
            metrics_by_row[row] = row_metrics
        return Scores(metrics_by_row, results.episodes, results)


def _save_outcomes(path: Path, outcomes: Sequence[EpisodeOutcome]) -> None:
    """Write outcomes into a file, which is replaced atomically."""
    arrays = {}
    for index, outcome in enumerate(outcomes):
        for field, values in outcome._asdict().items():
            arrays[f"{index}.{field}"] = np.asarray(values)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    write_atomic(path, file.getvalue())


def _load_outcomes(path: Path) -> list[EpisodeOutcome] | None:
    """Read outcomes; None if there are none, or the file is damaged."""
    try:
        with np.load(io.BytesIO(path.read_bytes())) as arrays:
            num_outcomes = len(arrays.files) // len(EpisodeOutcome._fields)
            outcomes = []
            for index in range(num_outcomes):
                outcomes.append(EpisodeOutcome(*(arrays[f"{index}.{field}"] for field in EpisodeOutcome._fields)))
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error):
        return None
    return outcomes
