"""Run directories: the settings and the exported policies of a run."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.runs.check import check
from jaxnav.runs.config import RunConfig
from jaxnav.runs.logs import Logs
from jaxnav.runs.overlay import apply_values
from jaxnav.runs.policies import Policies, load_policies
from jaxnav.store.lock import Lock
from jaxnav.store.manifest import differences
from jaxnav.store.signed import read_signed, write_signed
from jaxnav.training.devices import by_first_process

CONFIG_FILE = "config.json"
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
        return Logs(self.config).metrics()

    def reach(self) -> dict[str, Any] | None:
        """Return success within budgets of actions, see `Validator.reach`.

        None where the run had no val scenes.
        """
        path = self.config.run_dir / REACH_FILE
        return read_signed(path, "remove it and train again with this --run-dir") if path.exists() else None

    def times(self) -> list[dict[str, Any]]:
        """Return the seconds that training took, a row per chunk.

        `wall_s` and `cpu_s` are since the start, with compilation, validation and what came before an interruption.
        """
        return Logs(self.config).times()


def settings(config: RunConfig) -> dict[str, Any]:
    """Return what identifies a run, as JSON.

    All its settings but where it runs and how often what is kept where.
    """
    plain = dataclasses.asdict(config)
    plain = json.loads(json.dumps(plain, default=str))  # as it is read again: tuples are lists
    return {name: value for name, value in plain.items() if name not in ("run_dir", "save_every", "cache", "devices")}


@contextlib.contextmanager
def claimed(config: RunConfig) -> Iterator[Lock]:
    """Hold the run directory for this run, and for no other process.

    Of several processes of a run the first one holds it for all.

    Raises:
      InputError: it holds another run, or something else, or another process trains in it.
    """
    lock = Lock(config.run_dir)

    def hold() -> None:
        claim(config)
        lock.acquire()
        claim(config)  # another process may have claimed it since

    try:
        by_first_process(hold)
        yield lock
    except Exception:
        lock.check()  # whatever fails while the folder is gone fails for that
        raise
    finally:
        lock.release()


def claim(config: RunConfig) -> None:
    """Write the settings to the run directory, or find them there.

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
    write_signed(path, settings(config))


def load_run(run_dir: Path) -> RunConfig:
    """Read the settings of an earlier run.

    Raises:
      InputError: the directory holds no run, or its config file is damaged or of another version.
    """
    path = run_dir / CONFIG_FILE
    if not path.exists():
        raise InputError(f"{run_dir}: holds no run ({CONFIG_FILE} is missing); train one there first")
    held = read_signed(path, "restore the file or train in another --run-dir")
    config = apply_values(RunConfig(), held, path)
    if different := differences(held, settings(config)):
        raise InputError(f"{path}: lacks settings ({'; '.join(different)}); restore the file or train the run anew")
    return check(dataclasses.replace(config, run_dir=run_dir))
