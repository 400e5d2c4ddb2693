"""A run directory: its configuration, logs and lock.

`Run` opens a finished or interrupted run and gives access to its policies and logs. Training holds the directory with
`lock_run_dir` while it writes. `config.json` keeps the settings that identify the run (`run_settings`), so that
training can resume only with the same settings.
"""

import contextlib
import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_values
from jaxnav.runs.policies import CONFIG_FILE, POLICIES_DIR, Policies, check_path, is_policy, load_policies
from jaxnav.store.files import (
    LOCK_FILE,
    FolderLock,
    LogRow,
    append_log_rows,
    expand_home,
    list_differences,
    read_json_with_digest,
    read_log_rows,
    truncate_log_after,
    write_json_with_digest,
)
from jaxnav.training.devices import run_on_first_process

#: Training metrics, a row for each chunk, arm and seed.
LOG_FILE = "metrics.jsonl"
#: Seconds of training, a row for each chunk.
TIMES_FILE = "times.jsonl"
#: Success of the exported policies within budgets of actions; see `Validator.success_by_budget`.
REACH_FILE = "reach.json"
#: Settings that runs of earlier versions lack, with the values that they were trained with.
_EARLIER_SETTINGS: dict[str, dict[str, Any]] = {
    "worlds": {"front_cell": "nearest"},
    "layout": {"counts": "presence", "weights": "raw"},
    "ppo": {"guidance": 0.0, "final_guidance": None},
}
#: `ppo.experience` of fused networks in files without `counterfactual_memory`: earlier versions ignored this setting.
_IGNORED_EXPERIENCE = 0.8


@dataclasses.dataclass(frozen=True)
class Run:
    """A training run.

    Attributes:
      config: configuration of the run; `config.run_dir` is its directory.
    """

    config: RunConfig

    @classmethod
    def open(cls, run_dir: str | Path) -> "Run":
        """Open an earlier run.

        Raises:
          InputError: the directory holds no run, or its configuration file is damaged or of another version.
        """
        check_path(run_dir)
        return cls(load_run_config(expand_home(run_dir)))

    def policies(self, arms: Sequence[str] | None = None) -> Policies:
        """Load the exported policies; see `load_policies`."""
        return load_policies(self.config, arms)

    def log(self) -> list[dict[str, Any]]:
        """Training log, a row for each chunk, arm and seed."""
        return RunLogs(self.config).read(LOG_FILE)

    def times(self) -> list[dict[str, Any]]:
        """Seconds that training took, a row for each chunk.

        `wall_s` and `cpu_s` count from the start, and include compilation, validation and earlier, interrupted calls.
        """
        return RunLogs(self.config).read(TIMES_FILE)

    def success_by_budget(self) -> dict[str, Any] | None:
        """Success within budgets of actions, see `Validator.success_by_budget`; None for a run without val scenes."""
        path = self.config.run_dir / REACH_FILE
        if not path.exists():
            return None
        return read_json_with_digest(path, "remove it and train again with this --run-dir")


def run_settings(config: RunConfig) -> dict[str, Any]:
    """Settings that identify a run, as JSON.

    Paths, devices and the number of calls between checkpoints are omitted, because they may change when a run resumes.
    Networks with complete experience and a factual counterfactual memory have the settings of earlier versions.
    """
    setting_fields = _all_settings(config)
    is_fused = config.decision == "fused"
    if config.counterfactual_memory == "factual" and not (is_fused and config.ppo.experience_prob < 1.0):
        del setting_fields["counterfactual_memory"]
        if is_fused:
            setting_fields["ppo"]["experience"] = _IGNORED_EXPERIENCE
    return setting_fields


def manifest_settings(config: RunConfig) -> dict[str, Any]:
    """Settings for the manifests of a run: those in its directory, or those of a new run.

    An earlier version may have written the directory. `claim_run_dir` checks that its settings mean the same.
    """
    path = config.run_dir / CONFIG_FILE
    if not path.exists():
        return run_settings(config)
    return read_json_with_digest(path, "restore the file or train in another --run-dir")


def comparable_settings(config: RunConfig) -> dict[str, Any]:
    """Settings that identify a run, without those that stand for the behaviour of versions that lack them.

    Results of earlier versions are recognized by these settings.
    """
    settings = run_settings(config)
    for group_name, earlier_values in _EARLIER_SETTINGS.items():
        for name, earlier_value in earlier_values.items():
            if settings[group_name][name] == earlier_value:
                del settings[group_name][name]
    return settings


def _all_settings(config: RunConfig) -> dict[str, Any]:
    """All settings but those that may change when a run resumes, as JSON."""
    setting_fields = dataclasses.asdict(config)
    setting_fields = json.loads(json.dumps(setting_fields, default=str))  # tuples become lists, as in the file
    for name in ("run_dir", "save_every", "cache", "devices"):
        del setting_fields[name]
    return setting_fields


def _complete_settings(saved_settings: dict[str, Any]) -> dict[str, Any]:
    """Add the settings that came with later versions to those of a file."""
    settings = dict(saved_settings)
    for group_name, earlier_values in _EARLIER_SETTINGS.items():
        if isinstance(settings.get(group_name), dict):
            settings[group_name] = earlier_values | settings[group_name]

    # Without the kind of counterfactual memory, a fused network has complete experience.
    if "counterfactual_memory" not in settings:
        settings["counterfactual_memory"] = "factual"
        if settings.get("decision") == "fused" and isinstance(settings.get("ppo"), dict):
            settings["ppo"] = settings["ppo"] | {"experience": None}
    return settings


def load_run_config(run_dir: Path) -> RunConfig:
    """Read the configuration of an earlier run.

    Raises:
      InputError: the directory holds no run, or its configuration file is damaged or of another version.
    """
    path = run_dir / CONFIG_FILE
    if not path.exists() and is_policy(run_dir):
        raise InputError(
            f"{run_dir}: is an exported policy and holds no run; give the directory of a run (jaxnav.sweep and "
            "jaxnav.load_policy accept policies)"
        )
    if not path.exists():
        raise InputError(f"{run_dir}: holds no run ({CONFIG_FILE} is missing); train one there first")
    # The digest reveals edits and damage.
    saved_settings = read_json_with_digest(path, "restore the file or train in another --run-dir")
    saved_settings = _complete_settings(saved_settings)

    # Settings that are missing in the file would silently take their default values.
    config = apply_values(RunConfig(), saved_settings, path)
    setting_differences = list_differences(saved_settings, _all_settings(config))
    if setting_differences:
        raise InputError(
            f"{path}: lacks settings ({'; '.join(setting_differences)}); restore the file or train the run again"
        )
    return check_config(dataclasses.replace(config, run_dir=run_dir))


@contextlib.contextmanager
def lock_run_dir(config: RunConfig) -> Iterator[FolderLock]:
    """Lock the run directory for this run while the context is entered.

    Of several processes of a run, the first one holds the directory for all.

    Raises:
      InputError: the directory holds another run or other files, or another process trains in it.
    """
    folder_lock = FolderLock(config.run_dir)

    def claim_and_lock() -> None:
        check_run_dir(config)  # a directory of something else gets no lock file
        config.run_dir.mkdir(parents=True, exist_ok=True)
        folder_lock.acquire()
        claim_run_dir(config)

    try:
        run_on_first_process(claim_and_lock)
        yield folder_lock
    except Exception:
        folder_lock.check()  # a missing directory explains whatever else failed
        raise
    finally:
        folder_lock.release()


def claim_run_dir(config: RunConfig) -> None:
    """Write the settings to the run directory, or check that they are there.

    Raises:
      InputError: the directory holds another run or other files.
    """
    check_run_dir(config)
    path = config.run_dir / CONFIG_FILE
    if not path.exists():
        write_json_with_digest(path, run_settings(config))


def check_run_dir(config: RunConfig) -> None:
    """Check that the run directory holds this run, or nothing yet.

    Raises:
      InputError: the directory holds another run or other files.
    """
    run_dir = config.run_dir
    path = run_dir / CONFIG_FILE

    # A directory with a run must hold this run.
    if path.exists():
        setting_differences = list_differences(run_settings(load_run_config(run_dir)), run_settings(config))
        if setting_differences:
            raise InputError(
                f"{run_dir}: holds another run (stored != requested): {'; '.join(setting_differences)}; "
                "choose another --run-dir or use the settings of the stored run"
            )
        return

    # Any other directory must be empty, except for what a call leaves that was killed before it wrote the settings.
    if run_dir.exists() and not run_dir.is_dir():
        raise InputError(f"{run_dir}: is a file; choose another --run-dir")
    for folder_item in run_dir.iterdir() if run_dir.exists() else ():
        if folder_item.name != LOCK_FILE and not folder_item.match(f".{CONFIG_FILE}.*.tmp"):
            raise InputError(f"{run_dir}: is not empty and holds no run; choose another --run-dir")


@dataclasses.dataclass(frozen=True)
class RunLogs:
    """Logs of a run: `metrics.jsonl` and `times.jsonl`.

    Attributes:
      config: configuration of the run.
    """

    config: RunConfig

    def read(self, name: str) -> list[dict[str, Any]]:
        """Rows of `metrics.jsonl` or `times.jsonl`; empty without the file.

        Raises:
          InputError: a row is damaged or missing.
        """
        rows = read_log_rows(self.config.run_dir / name)

        # The logs of a finished run must be complete.
        is_finished = bool(rows) and (self.config.run_dir / POLICIES_DIR).exists()
        self._check_rows(name, rows, self.config.total_updates if is_finished else 0)
        return rows

    def append(self, metrics: Sequence[LogRow], times: LogRow) -> None:
        """Append the rows of one chunk."""
        append_log_rows(self.config.run_dir / LOG_FILE, metrics)
        append_log_rows(self.config.run_dir / TIMES_FILE, [times])

    def rewind(self, update: int) -> None:
        """Drop the rows after an update, because training resumes there and will log them again.

        Raises:
          InputError: a row up to the update is damaged or missing.
        """
        for name in (LOG_FILE, TIMES_FILE):
            path = self.config.run_dir / name
            truncate_log_after(path, update)
            self._check_rows(name, read_log_rows(path), update)

    def _check_rows(self, name: str, rows: Sequence[dict[str, Any]], last_update: int) -> None:
        """Refuse rows that are out of order or incomplete up to `last_update`."""
        config = self.config

        # Rows of a log without gaps: every chunk in order, and in it every arm and seed.
        last_row_update = max([last_update, *(row["step"] for row in rows)])
        logged_updates = range(config.chunk, last_row_update + 1, config.chunk)
        arms = config.arms if name == LOG_FILE else (None,)
        seeds = range(config.seeds) if name == LOG_FILE else (None,)
        expected_rows = list(itertools.product(logged_updates, arms, seeds))
        actual_rows = [(row["step"], row.get("arm"), row.get("seed")) for row in rows]

        # The log may end early, but only after `last_update`.
        num_equal = 0
        for actual_row, expected_row in zip(actual_rows, expected_rows, strict=False):
            if actual_row != expected_row:
                break
            num_equal += 1
        has_wrong_row = num_equal < len(actual_rows)
        ends_early = num_equal < len(expected_rows) and expected_rows[num_equal][0] <= last_update
        if has_wrong_row or ends_early:
            raise InputError(
                f"{config.run_dir / name}, line {num_equal + 1}: rows are missing or out of order; restore the file or "
                "train in another --run-dir"
            )
