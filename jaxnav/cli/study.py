"""The commands that run experiments: study, compare, instrument and mixture.

`main` tests the paper's claims; `compare_main` puts methods side by side, with and without the layout;
`instrument_main` validates the layout shift itself; `mixture_main` measures the removal of experience in scenes of
which half are shifted.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import make_result_console, parse_arguments, parse_config, parse_options, run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.report import Decoding, package_versions
from jaxnav.runs.run import load_run_config
from jaxnav.store.files import write_atomic
from jaxnav.study.compare import run_compare
from jaxnav.study.compare_config import CompareConfig, check_compare
from jaxnav.study.config import StudyConfig, check_study
from jaxnav.study.document import gap_auc_tables, mixture_sections
from jaxnav.study.gap_traces import measure_gap_curves
from jaxnav.study.instrument import InstrumentConfig, prove_instrument, prove_main_run
from jaxnav.study.measure import TrialRunner
from jaxnav.study.mixture import measure_mixture
from jaxnav.study.records import to_json
from jaxnav.study.results import round_numbers
from jaxnav.study.run import run_study


def main(arguments: list[str] | None = None, prog: str = "jaxnav study") -> int:
    """Run the study command and return its exit code."""
    return run_command(lambda console: run_study(parse_study(arguments, prog), console))


def parse_study(arguments: list[str] | None, prog: str = "jaxnav study") -> StudyConfig:
    """Return the settings of a study from the defaults, the configuration of `--config` and the other options.

    Raises:
      InputError: bad configuration or setting.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    return parse_config(StudyConfig(), arguments, prog, "Put the paper's claims to the test.", check_study)


def compare_main(arguments: list[str] | None = None, prog: str = "jaxnav compare") -> int:
    """Run the compare command and return its exit code."""
    return run_command(lambda console: run_compare(parse_compare(arguments, prog), console))


def parse_compare(arguments: list[str] | None, prog: str = "jaxnav compare") -> CompareConfig:
    """Return the settings of a comparison from the defaults, the configuration of `--config` and the other options.

    Raises:
      InputError: bad configuration or setting.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    description = (
        "Train and evaluate methods in several worlds, and write their table: Table 2 of the paper, or ablations."
    )
    return parse_config(CompareConfig(), arguments, prog, description, check_compare)


def instrument_main(arguments: list[str] | None = None, prog: str = "jaxnav instrument") -> int:
    """Run the instrument command and return its exit code; 0 also if the validation fails."""
    # With a configuration the options are those of a study.
    arguments = sys.argv[1:] if arguments is None else arguments
    has_config = any(argument.split("=")[0] == "--config" for argument in arguments)
    if has_config:
        return run_command(lambda console: prove_main_run(parse_study(arguments, prog), console, make_result_console()))
    description = (
        "Prove the dial with a finished run, or with the main run of the study of `--config`, trained if need be."
    )
    config = parse_options(InstrumentConfig, arguments, prog, description)
    return run_command(lambda console: prove_instrument(config, console, make_result_console()))


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


def mixture_main(arguments: list[str] | None = None, prog: str = "jaxnav mixture") -> int:
    """Run the mixture command and return its exit code."""
    description = (
        "Measure what every removal of experience keeps of its value and recovers of its cost; prints Markdown."
    )
    config = parse_arguments(MixtureConfig, arguments, prog, description)
    return run_command(lambda console: _print_mixture(config, console))


def _print_mixture(config: MixtureConfig, console: Console) -> None:
    """Evaluate the mixed population, print Markdown and write JSON."""
    if not 0.0 < config.shift <= 1.0:
        raise InputError(f"--shift {config.shift:g}: give a number above 0, at most 1")
    shared_settings = {name: getattr(config, name) for name in ("split", "episodes", "steps", "seed")}
    study = check_study(StudyConfig(shifts=(0.0, config.shift), **shared_settings))

    # Measure the removals in the mixture, and how well the gaps detect the shift.
    run = load_run_config(config.run)
    reference_run = load_run_config(config.without)
    mixture = measure_mixture(
        run, reference_run, config.decoding, TrialRunner(study), console, hand_over=config.hand_over
    )
    gap_curves = measure_gap_curves(run, study, console)
    lines = [*mixture_sections([mixture]), "### Does the gap track the layout?", "", *gap_auc_tables(gap_curves)]
    print("\n".join(lines))

    # The file holds all settings, of which its name shows only some.
    suffix = "-handed" if config.hand_over else ""
    target = config.json or config.run / f"mixture-{config.split}-{config.decoding}{suffix}.json"
    settings = dataclasses.asdict(config)
    del settings["json"]
    report = {
        "settings": {name: str(value) for name, value in settings.items()},
        "versions": package_versions(),
        "mixture": to_json(mixture),
        "course": to_json(gap_curves),
    }
    report = round_numbers(report)
    try:
        write_atomic(target, (json.dumps(report, allow_nan=False) + "\n").encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); give another --json") from error
    console.print(f"written to {target}")
