"""Proof of the instrument: what the layout shift changes."""

import dataclasses
from pathlib import Path
from typing import Literal

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.report import FORMAT, versions, write_report
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import load_run, settings
from jaxnav.runs.policies import Policies, load_policies
from jaxnav.runs.worlds import evaluation_world
from jaxnav.study.codec import to_json
from jaxnav.study.config import StudyConfig
from jaxnav.study.dial import compare
from jaxnav.study.instrument_report import InstrumentReport, console_table, verdicts
from jaxnav.study.runs import ensure_trained, run_config
from jaxnav.study.scene_measures import measure_scenes


@dataclasses.dataclass(frozen=True)
class InstrumentConfig:
    """Describe a proof of the instrument with a finished run.

    Attributes:
      run: the run directory; the table is also written there, as instrument-SPLIT.json.
      shift: layout shifts, at least two; all are compared with the lowest.
      without: run directory of agents that cannot know any layout, such as those of the method `anonymous`: they must
        lose nothing.
      split: scenes to evaluate on.
      episodes: number at each shift; see the evaluation.
      scenes_per_split: generated scenes of the split; default: the run's.
      seed: of the episode lists and the sampled actions.
    """

    run: Path
    shift: tuple[float, ...] = (0.0, 0.5, 1.0)
    without: Path | None = None
    split: Literal["train", "val", "test"] = "val"
    episodes: int = 1000
    scenes_per_split: int | None = None
    seed: int = 0


def study_instrument(config: StudyConfig, run: RunConfig, without: Path | None = None) -> InstrumentConfig:
    """Return the proof that a study asks of a run."""
    return InstrumentConfig(run.run_dir, config.shifts, without, config.split, config.episodes, seed=config.seed)


def prove_main_run(config: StudyConfig, console: Console, out: Console) -> None:
    """Prove the instrument with a study's main run.

    The run is trained unless it is finished; see `prove_instrument`.
    """
    run = run_config(config, "main")
    ensure_trained(run, console)
    prove_instrument(study_instrument(config, run), console, out)


def prove_instrument(config: InstrumentConfig, console: Console, out: Console) -> None:
    """Measure at every shift, print the table, write JSON.

    Args:
      config: what is measured.
      console: shows the progress.
      out: takes the table and the verdicts.

    Raises:
      InputError: an impossible setting, no finished run, or a file that cannot be written.
    """
    run = _checked_run(config)
    report = instrument_report(config, run, console)
    out.print(console_table(report))
    for line in verdicts(report):
        out.print(line, markup=False)
    target = config.run / f"instrument-{config.split}.json"
    try:
        write_report(target, to_json(report) | {"versions": versions(), "format": FORMAT})
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror})") from error
    console.print(f"written to {target}")


def instrument_report(config: InstrumentConfig, run: RunConfig, console: Console) -> InstrumentReport:
    """Measure a finished run at every shift and compare."""
    policies, totals = load_policies(run), []
    without = None if config.without is None else load_without(config.without, run)
    shifts = sorted(set(config.shift))
    for shift in shifts:
        console.print(f"shift {shift:g}:")
        world = evaluation_world(run, config.split, None, shift, console)
        totals.append(measure_scenes(world, policies, without, config.episodes, config.seed))
    about = settings(run) | {"evaluation_split": config.split, "evaluation_seed": config.seed}
    return dataclasses.replace(compare(shifts, totals), run=about)


def load_without(folder: Path, run: RunConfig) -> Policies:
    """Load agents that cannot know any layout.

    Raises:
      InputError: no finished run, or one of another task or number of seeds.
    """
    other = load_run(folder)
    if (other.task, other.seeds) != (run.task, run.seeds):
        raise InputError(f"--without {folder}: is of another task or number of seeds; train it like {run.run_dir}")
    return load_policies(other, ("baseline",))


def _checked_run(config: InstrumentConfig) -> RunConfig:
    """Return the run with the number of scenes asked for."""
    given = f"--shift {' '.join(map(str, config.shift))}"
    if not all(0.0 <= shift <= 1.0 for shift in config.shift):
        raise InputError(f"{given}: give numbers from 0 to 1")
    if len(set(config.shift)) < 2:
        raise InputError(f"{given}: give at least two different shifts")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"--seed {config.seed}: give a whole number from 0 to 2**32 - 1")
    run = load_run(config.run)
    if config.scenes_per_split is None:
        return run
    if run.scenes:
        raise InputError(f"--scenes-per-split: {config.run} is a run on scenes of a file; leave it out")
    worlds = dataclasses.replace(run.worlds, **{f"num_{config.split}": config.scenes_per_split})
    return dataclasses.replace(run, worlds=worlds)
