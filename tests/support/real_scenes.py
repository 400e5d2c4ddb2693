"""Files of real scenes, and small inputs of known faults, beside the repository."""

from pathlib import Path

import pytest

_SHARED = Path(__file__).parents[3] / "shared"
_FOLDER = _SHARED / "scenes"
INPUTS = _SHARED / "inputs"
ITHOR = _FOLDER / "ithor_train_val.jsonl.gz"
ITHOR_SHUFFLES = _FOLDER / "ithor_shuffles_train.jsonl.gz"
ROBOTHOR = _FOLDER / "robothor_train.jsonl.gz"
PROCTHOR = _FOLDER / "procthor"


def require(path: Path) -> Path:
    """Return a path, or skip the test without it."""
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    return path
