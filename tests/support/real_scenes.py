"""Files of real scenes beside the repository."""

from pathlib import Path

import pytest

_FOLDER = Path(__file__).parents[3] / "shared" / "scenes"
ITHOR = _FOLDER / "ithor_train_val.jsonl.gz"
ITHOR_SHUFFLES = _FOLDER / "ithor_shuffles_train.jsonl.gz"
ROBOTHOR = _FOLDER / "robothor_train.jsonl.gz"
PROCTHOR = _FOLDER / "procthor"


def require(path: Path) -> Path:
    """Return a path, or skip the test without it."""
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    return path
