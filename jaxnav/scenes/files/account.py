"""Account of an import: everything that was read is kept, or skipped for a reason."""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Any

#: Why the content of scenes that cannot be used is skipped.
IN_REFUSED_SCENE = "in refused scenes"


@dataclasses.dataclass
class ImportCount:
    """Count of what an importer read, for one scene or file.

    The numbers of all counts of a unit add up: read and added are kept and skipped.

    Attributes:
      unit: what is counted: `scenes`, `objects`, `goals`, `episodes` or `rows`.
      num_read: number in the source.
      num_added: number that one in the source became beyond the first, such as the boxes of a corner counter.
      num_kept: number kept. Importers leave it 0 for objects and scenes, which are counted when they are written.
      skipped: number skipped, by the reason.
    """

    unit: str
    num_read: int = 0
    num_added: int = 0
    num_kept: int = 0
    skipped: Counter[str] = dataclasses.field(default_factory=Counter)

    def skip_all(self, reason: str) -> None:
        """Skip everything that was read, for one reason."""
        self.num_added = 0
        self.num_kept = 0
        self.skipped = Counter({reason: self.num_read} if self.num_read else {})

    def add(self, other: "ImportCount") -> None:
        """Add another count of the unit."""
        self.num_read += other.num_read
        self.num_added += other.num_added
        self.num_kept += other.num_kept
        self.skipped.update(other.skipped)

    @property
    def is_balanced(self) -> bool:
        """True if everything read is accounted for."""
        return self.num_read + self.num_added == self.num_kept + self.skipped.total()

    @property
    def num_by_reason(self) -> dict[str, int]:
        """Number skipped for each reason that occurred."""
        return dict(sorted((+self.skipped).items()))

    def to_json(self) -> dict[str, Any]:
        """Return the numbers for the header of a scene file."""
        return {
            "read": self.num_read,
            "added": self.num_added,
            "kept": self.num_kept,
            "skipped": self.num_by_reason,
        }

    def __str__(self) -> str:
        added_note = f", {self.num_added:,} added" if self.num_added else ""
        reasons = "; ".join(f"{number:,} {reason}" for reason, number in self.num_by_reason.items())
        reason_note = f" ({reasons})" if reasons else ""
        skip_note = f"{self.skipped.total():,} skipped{reason_note}"
        return f"{self.unit}: {self.num_read:,} read{added_note}, {self.num_kept:,} kept, {skip_note}"


def account_to_json(counts: Mapping[str, ImportCount]) -> dict[str, Any]:
    """Return the account of an import for the header of its scene file."""
    return {unit: count.to_json() for unit, count in counts.items()}
