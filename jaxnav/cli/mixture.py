"""The mixture command: removal of experience where half of the scenes are shifted."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import command_line, exit_code
from jaxnav.errors import InputError
from jaxnav.evaluation.report import Decoding, versions
from jaxnav.runs.directory import load_run
from jaxnav.store.files import write_atomic
from jaxnav.study.bench import Bench
from jaxnav.study.codec import to_json
from jaxnav.study.config import StudyConfig, check_study
from jaxnav.study.gap_course import gap_course
from jaxnav.study.mixture import measure_mixture
from jaxnav.study.mixture_tables import mixture_sections
from jaxnav.study.results import rounded
from jaxnav.study.tables import gap_tables


@dataclasses.dataclass(frozen=True)
class MixtureConfig:
    """Configure an evaluation in a mixed population.

    Attributes:
      run: the run directory; its policies use the layout.
      without: that of agents which cannot know any layout: trained in the same world, with as many seeds, by
        `--method anonymous`.
      hand_over: removal leaves the policies of `without`, not what the run's own decide without experience; eq. 2's
        switch is then a hand-over from one agent to another.
      split: scenes to evaluate on.
      shift: layout shift of the other half of the scenes, above 0, at most 1.
      decoding: take the best action, or sample.
      episodes: in each half.
      steps: of the episodes at which the AUC of the gaps is measured.
      seed: of the episode list and the sampled actions.
      json: where to write what was measured; default: in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    without: Annotated[Path, tyro.conf.Positional]
    hand_over: bool = False
    split: Literal["val", "test"] = "val"
    shift: float = 1.0
    decoding: Decoding = "sample"
    episodes: int = 1000
    steps: int = 80
    seed: int = 0
    json: Path | None = None


def main(arguments: list[str] | None = None, prog: str = "jaxnav mixture") -> int:
    """Run the command and return its exit code."""
    what = "Measure what every removal of experience keeps of its value and recovers of its cost; prints Markdown."
    config = command_line(MixtureConfig, arguments, prog, what)
    return exit_code(lambda console: _mixture(config, console))


def _mixture(config: MixtureConfig, console: Console) -> None:
    """Evaluate, print and write."""
    if not 0.0 < config.shift <= 1.0:
        raise InputError(f"--shift {config.shift:g}: give a number above 0, at most 1")
    given = {name: getattr(config, name) for name in ("split", "episodes", "steps", "seed")}
    study = check_study(StudyConfig(shifts=(0.0, config.shift), **given))
    run = load_run(config.run)
    mixture = measure_mixture(
        run, load_run(config.without), config.decoding, Bench(study), console, hand_over=config.hand_over
    )
    course = gap_course(run, study, console)
    print("\n".join([*mixture_sections([mixture]), "### Does the gap track the layout?", "", *gap_tables(course)]))
    handed = "-handed" if config.hand_over else ""
    target = config.json or config.run / f"mixture-{config.split}-{config.decoding}{handed}.json"
    about = {name: str(value) for name, value in dataclasses.asdict(config).items() if name != "json"}
    report = rounded(
        {"settings": about, "versions": versions(), "mixture": to_json(mixture), "course": to_json(course)}
    )
    try:
        write_atomic(target, (json.dumps(report, allow_nan=False) + "\n").encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); give another --json") from error
    console.print(f"written to {target}")
