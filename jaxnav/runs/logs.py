"""The two logs of a run: what was measured in training, and the seconds that it took."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import POLICIES
from jaxnav.store.runlog import Row, append_rows, read_rows, truncate_after

LOG_FILE, TIMES_FILE = "metrics.jsonl", "times.jsonl"


@dataclasses.dataclass(frozen=True)
class Logs:
    """Hold the logs of a run.

    `metrics.jsonl` has a row for each chunk, arm and seed, `times.jsonl` one for each chunk.

    Attributes:
      config: settings of the run.
    """

    config: RunConfig

    def metrics(self) -> list[dict[str, Any]]:
        """Return the rows of what was measured; none without the file.

        Raises:
          InputError: a row is damaged or missing.
        """
        return self._read(LOG_FILE)

    def times(self) -> list[dict[str, Any]]:
        """Return the rows of seconds; none without the file.

        Raises:
          InputError: a row is damaged or missing.
        """
        return self._read(TIMES_FILE)

    def append(self, metrics: Sequence[Row], times: Row) -> None:
        """Append the rows of a chunk."""
        append_rows(self.config.run_dir / LOG_FILE, metrics)
        append_rows(self.config.run_dir / TIMES_FILE, [times])

    def rewind(self, step: int) -> None:
        """Drop the rows after a checkpoint; none before it may be missing.

        Raises:
          InputError: a row is damaged or missing.
        """
        for name in (LOG_FILE, TIMES_FILE):
            truncate_after(self.config.run_dir / name, step)
            self._check(name, read_rows(self.config.run_dir / name), step)

    def _read(self, name: str) -> list[dict[str, Any]]:
        """Read a log, which is complete where the run is finished."""
        rows = read_rows(self.config.run_dir / name)
        finished = rows and (self.config.run_dir / POLICIES).exists()
        self._check(name, rows, self.config.total_updates if finished else 0)
        return rows

    def _check(self, name: str, rows: Sequence[dict[str, Any]], step: int) -> None:
        """Refuse rows that are not those of one chunk after the other, at least up to a step."""
        config = self.config
        updates = range(config.chunk, max([step, *(row["step"] for row in rows)]) + 1, config.chunk)
        agents = itertools.product(config.arms, range(config.seeds)) if name == LOG_FILE else [(None, None)]
        wanted = [(update, *agent) for update, agent in itertools.product(updates, agents)]
        held = [(row["step"], row.get("arm"), row.get("seed")) for row in rows]
        equal = [one == other for one, other in zip(held, wanted, strict=False)]
        first = len(equal) if all(equal) else equal.index(False)
        if first < len(held) or (first < len(wanted) and wanted[first][0] <= step):
            raise InputError(
                f"{config.run_dir / name}, line {first + 1}: rows are missing or out of order; restore the file or "
                "train in another --run-dir"
            )
