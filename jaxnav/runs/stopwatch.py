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
    def start(cls) -> "Stopwatch":
        """Start counting."""
        return cls(time.monotonic(), time.process_time())

    def resume(self, path: Path) -> "Stopwatch":
        """Go on from the last row of a file of times; it may be missing."""
        rows = read_rows(path)
        return Stopwatch(self.wall - rows[-1]["wall_s"], self.cpu - rows[-1]["cpu_s"]) if rows else self

    def read(self) -> dict[str, float]:
        """Return `wall_s` and `cpu_s`."""
        wall, cpu = time.monotonic() - self.wall, time.process_time() - self.cpu
        return {"wall_s": round(wall, 2), "cpu_s": round(cpu, 2)}
