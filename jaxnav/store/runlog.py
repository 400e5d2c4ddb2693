"""The run log `metrics.jsonl`: one JSON object per line, appended row by row.

Rows are logged before the checkpoint that covers them is saved, so a checkpoint never knows more than the log; on
resume the rows after the restored step are dropped and written again.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic


def append_row(path: Path, row: Mapping[str, int | float | str | None]) -> None:
    """Append a row to the log.

    The row holds an int `step`; it has left this process when the call returns.

    NaN and infinities are written as null, since JSON has no word for them.
    """
    finite = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
    with path.open("ab") as file:
        file.write(json.dumps(finite, allow_nan=False).encode() + b"\n")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a log in order.

    Without a last line torn by a crash; none if there is no file.

    Raises:
      InputError: another line than the last is no JSON object with an int `step`.
    """
    if not path.exists():
        return []
    lines = path.read_bytes().splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        row = _parse(line)
        if row is not None:
            rows.append(row)
        elif number < len(lines):
            raise InputError(f"{path}, line {number}: not a JSON object with a whole number `step`; remove the line")
    return rows


def truncate_after(path: Path, step: int) -> None:
    """Drop the rows later than a step.

    A torn last line is dropped too; a missing log stays missing.

    Raises:
      InputError: as `read_rows`; the log is then left as it is.
    """
    if path.exists():
        kept = [row for row in read_rows(path) if row["step"] <= step]
        write_atomic(path, b"".join(json.dumps(row).encode() + b"\n" for row in kept))


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and type(row.get("step")) is int else None
