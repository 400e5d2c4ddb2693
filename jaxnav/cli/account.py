"""The account command: value and cost of experience, against a run of agents without any."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.causal import Form
from jaxnav.cli.console import make_result_console, parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.report import accounting_table
from jaxnav.runs.evaluate import account
from jaxnav.runs.policies import EstimatorName
from jaxnav.runs.run import Run
from jaxnav.store.files import write_atomic


@dataclasses.dataclass(frozen=True)
class AccountConfig:
    """Configure the accounting of a run's experience.

    Attributes:
      run: the run directory.
      without: that of agents which cannot know any layout: trained in the same world, with as many seeds, by
        `--method anonymous`.
      split: scenes to evaluate on.
      shift: layout shifts, from 0 to 1; a table for each.
      episodes: in the fixed list, balanced over room types and scenes.
      epsilon: thresholds of sTDE.
      form: how sTDE combines the logits; default: the run's layout setting's.
      setting, hold: layout estimator to use instead of the run's, as of `eval`.
      seed: of the episode list and the sampled actions.
      json: where to write the tables; default: in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    without: Annotated[Path, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    shift: tuple[float, ...] = (0.0, 1.0)
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.5,)
    form: tuple[Form, ...] | None = None
    setting: EstimatorName | None = None
    hold: bool = False
    seed: int = 0
    json: Path | None = None


def main(arguments: list[str] | None = None, prog: str = "jaxnav account") -> int:
    """Run the command and return its exit code."""
    description = "Say what experience is worth to a run where the layout holds, and what it costs where it is shifted."
    config = parse_arguments(AccountConfig, arguments, prog, description)
    return run_command(lambda console: _print_account(config, console, make_result_console()))


def _print_account(config: AccountConfig, console: Console, result_console: Console) -> None:
    """Evaluate both runs at every shift, print the tables and write them as JSON."""
    run = Run.open(config.run)
    reference_run = Run.open(config.without)
    target = config.json or config.run / f"account-{config.split}.json"

    # Both runs are evaluated at every shift, and a table printed for each.
    names = ("split", "episodes", "epsilon", "form", "setting", "hold", "seed")
    options = {name: getattr(config, name) for name in names}
    entries_by_shift = {}
    for shift in config.shift:
        entries = account(run, reference_run, shift=shift, console=console, **options)
        result_console.print(f"Lead over {reference_run.config.method} at shift {shift:g}, in points")
        result_console.print(accounting_table(entries))
        entries_by_shift[f"{shift:g}"] = [entry.to_json() for entry in entries]

    # Write the entries with their settings.
    settings = {"run": str(config.run), "without": str(config.without)} | options
    document = {"settings": settings, "shifts": entries_by_shift}
    try:
        write_atomic(target, (json.dumps(document, indent=2) + "\n").encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); give another --json") from error
    console.print(f"written to {target}")
