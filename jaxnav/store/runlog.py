"""The run log `metrics.jsonl`: one JSON object with its digest per line, appended chunk by chunk.

Rows are on the disk before the checkpoint that covers them is saved, so a checkpoint never knows more than the log; on
resume the rows after the restored step are dropped and written again.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic
from jaxnav.store.signed import DIGEST, sign, verified

Row = Mapping[str, int | float | str | None]


def append_rows(path: Path, rows: Sequence[Row]) -> None:
    """Append rows to the log; they are on the disk then.

    A row holds an int `step`. NaN and infinities are written as null, since JSON has no word for them.
    """
    with path.open("ab") as file:
        file.write(_lines(rows))
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a log in order.

    Without a last line torn by a crash; none if there is no file.

    Raises:
      InputError: another line than the last is no JSON object with an int `step`, or a row is damaged.
    """
    if not path.exists():
        return []
    lines = path.read_bytes().splitlines()
    rows, signed = [], []
    for number, line in enumerate(lines, start=1):
        where, row = f"{path}, line {number}", _parse(line)
        if row is not None:
            rows.append(verified(where, row, "restore the file, or remove the line"))
            signed.append(DIGEST in row)
        elif number < len(lines):
            raise InputError(f"{where}: not a JSON object with a whole number `step`; remove the line")
    if any(signed) and not all(signed):
        number = signed.index(False) + 1
        raise InputError(f"{path}, line {number}: has no digest, unlike others; restore the file, or remove the line")
    return rows


def truncate_after(path: Path, step: int) -> None:
    """Drop the rows later than a step.

    A torn last line is dropped too; a missing log stays missing.

    Raises:
      InputError: as `read_rows`; the log is then left as it is.
    """
    if path.exists():
        write_atomic(path, _lines([row for row in read_rows(path) if row["step"] <= step]))


def _lines(rows: Sequence[Row]) -> bytes:
    finite = [{k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()} for row in rows]
    return b"".join(json.dumps(sign(row)).encode() + b"\n" for row in finite)


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and type(row.get("step")) is int else None
