"""The seconds that a run has taken."""

import dataclasses
import time
from pathlib import Path

from jaxnav.store.runlog import read_rows


@dataclasses.dataclass(frozen=True)
class Stopwatch:
    """Count the seconds of a run, also over interruptions.

    Attributes:
      wall, cpu: reading of the clocks at which the run would have started without interruptions.
    """

    wall: float
    cpu: float

    @classmethod
    def resume(cls, path: Path, started: float) -> "Stopwatch":
        """Go on from the last row of a file of times.

        Args:
          path: of the file; it may be missing.
          started: when this process began with the run, by `time.monotonic`.
        """
        rows = read_rows(path)
        last = rows[-1] if rows else {"wall_s": 0.0, "cpu_s": 0.0}
        return cls(started - last["wall_s"], -last["cpu_s"])

    def read(self) -> dict[str, float]:
        """Return `wall_s` and `cpu_s`."""
        return {
            "wall_s": round(time.monotonic() - self.wall, 2),
            "cpu_s": round(time.process_time() - self.cpu, 2),
        }
