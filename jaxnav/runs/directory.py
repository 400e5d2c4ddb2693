"""Run directories: the settings and the exported policies of a run."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.runs.check import check
from jaxnav.runs.config import RunConfig
from jaxnav.runs.overlay import apply_yaml
from jaxnav.runs.policies import Policies, load_policies
from jaxnav.store.files import write_atomic
from jaxnav.store.manifest import differences
from jaxnav.store.runlog import read_rows

CONFIG_FILE, LOG_FILE, TIMES_FILE = "config.json", "metrics.jsonl", "times.jsonl"
#: Success within budgets of actions, of the exported policies; see `Validator.reach`.
REACH_FILE = "reach.json"


@dataclasses.dataclass(frozen=True)
class Run:
    """Hold a training run.

    Attributes:
      config: its settings; `config.run_dir` is where it is kept.
    """

    config: RunConfig

    @classmethod
    def open(cls, run_dir: str | Path) -> "Run":
        """Open an earlier run.

        Raises:
          InputError: the directory holds no run, or its config file is damaged or of another version.
        """
        return cls(load_run(Path(run_dir)))

    def policies(self, arms: Sequence[str] | None = None) -> Policies:
        """Load the exported policies; see `load_policies`."""
        return load_policies(self.config, arms)

    def log(self) -> list[dict[str, Any]]:
        """Return the training log, a row per chunk and seed."""
        return read_rows(self.config.run_dir / LOG_FILE)

    def reach(self) -> dict[str, Any] | None:
        """Return success within budgets of actions, see `Validator.reach`.

        None where the run had no val scenes.
        """
        path = self.config.run_dir / REACH_FILE
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def times(self) -> list[dict[str, Any]]:
        """Return the seconds that training took, a row per chunk.

        `wall_s` and `cpu_s` are since the start, with compilation, validation and what came before an interruption.
        """
        return read_rows(self.config.run_dir / TIMES_FILE)


def settings(config: RunConfig) -> dict[str, Any]:
    """Return what identifies a run, as JSON.

    All its settings but where it runs and how often what is kept where.
    """
    plain = dataclasses.asdict(config)
    plain = json.loads(json.dumps(plain, default=str))  # as it is read again: tuples are lists
    return {name: value for name, value in plain.items() if name not in ("run_dir", "save_every", "cache", "devices")}


def claim(config: RunConfig) -> None:
    """Claim the run directory for this run, or leave it.

    Raises:
      InputError: it holds another run, or something else.
    """
    path, run_dir = config.run_dir / CONFIG_FILE, config.run_dir
    if path.exists():
        if different := differences(settings(load_run(run_dir)), settings(config)):
            raise InputError(
                f"{run_dir}: holds another run (there != asked for): {'; '.join(different)}; "
                "choose another --run-dir or the same settings"
            )
        return
    if run_dir.exists() and not run_dir.is_dir():
        raise InputError(f"{run_dir}: is a file; choose another --run-dir")
    # A kill while the config is written leaves its temporary file alone in the directory.
    if run_dir.exists() and any(not item.match(f".{CONFIG_FILE}.*.tmp") for item in run_dir.iterdir()):
        raise InputError(f"{run_dir}: is not empty and holds no run; choose another --run-dir")
    write_atomic(path, (json.dumps(settings(config), indent=2) + "\n").encode())


def load_run(run_dir: Path) -> RunConfig:
    """Read the settings of an earlier run.

    Raises:
      InputError: the directory holds no run, or its config file is damaged or of another version.
    """
    path = run_dir / CONFIG_FILE
    if not path.exists():
        raise InputError(f"{run_dir}: holds no run ({CONFIG_FILE} is missing); train one there first")
    config = apply_yaml(RunConfig(), path)
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}); restore the file or train in another --run-dir") from error
    if different := differences(held or {}, settings(config)):
        raise InputError(f"{path}: lacks settings ({'; '.join(different)}); restore the file or train the run anew")
    return check(dataclasses.replace(config, run_dir=run_dir))
