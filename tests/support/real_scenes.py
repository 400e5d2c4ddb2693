"""Files of real scenes beside the repository; a test that needs one is skipped where it is missing."""

from pathlib import Path

import pytest

_FOLDER = Path(__file__).parents[3] / "shared" / "scenes"
ITHOR = _FOLDER / "ithor_train_val.jsonl.gz"
ITHOR_SHUFFLES = _FOLDER / "ithor_shuffles_train.jsonl.gz"
ROBOTHOR = _FOLDER / "robothor_train.jsonl.gz"


def require(path: Path) -> Path:
    """Return the path of a file, or skip the test that asks for it."""
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    return path
