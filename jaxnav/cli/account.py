"""The accounting command: what experience is worth, and what it costs."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.causal import Form
from jaxnav.cli.console import command_line, exit_code, result_console
from jaxnav.errors import InputError
from jaxnav.evaluation.accounting import accounting_table
from jaxnav.runs.account import account
from jaxnav.runs.directory import Run
from jaxnav.runs.policies import EstimatorName
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
    what = "Say what experience is worth to a run where the layout holds, and what it costs where it is shifted."
    config = command_line(AccountConfig, arguments, prog, what)
    return exit_code(lambda console: _account(config, console, result_console()))


def _account(config: AccountConfig, console: Console, out: Console) -> None:
    """Evaluate both runs at every shift, print and write."""
    run, without = Run.open(config.run), Run.open(config.without)
    target = config.json or config.run / f"account-{config.split}.json"
    names = ("split", "episodes", "epsilon", "form", "setting", "hold", "seed")
    options = {name: getattr(config, name) for name in names}
    found = {}
    for shift in config.shift:
        entries = account(run, without, shift=shift, console=console, **options)
        out.print(f"Lead over {without.config.method} at shift {shift:g}, in points")
        out.print(accounting_table(entries))
        found[f"{shift:g}"] = [entry.to_json() for entry in entries]
    about = {"run": str(config.run), "without": str(config.without)} | options
    try:
        write_atomic(target, (json.dumps({"settings": about, "shifts": found}, indent=2) + "\n").encode())
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}); give another --json") from error
    console.print(f"written to {target}")
