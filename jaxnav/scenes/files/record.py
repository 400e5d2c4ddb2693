"""Checked access to the JSON of users' files.

Every error says where the value is and how to mend it.
"""

import dataclasses
import gzip
import io
import json
import reprlib
import zlib
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError

_LIMIT = 1e6  # metres or degrees; a number beyond it is a mistake


@dataclasses.dataclass(frozen=True)
class Record:
    """Hold a JSON object and its name in errors.

    Attributes:
      where: for example `rooms.jsonl.gz, line 3, scene 'FloorPlan1'`.
      fields: its members.
    """

    where: str
    fields: dict[str, Any]

    def error(self, field: str, problem: str) -> InputError:
        """Return an error about one field, to be raised."""
        return InputError(f"{self.where}: {field} {problem}")

    def get(self, field: str) -> Any:
        """Return a required member."""
        if field not in self.fields:
            raise self.error(field, "is missing; add it")
        return self.fields[field]

    def text(self, field: str, value: Any) -> str:
        """Return a value that must be a text, not empty."""
        if not isinstance(value, str) or not value:
            raise self.error(field, f"is {reprlib.repr(value)}; give a text")
        if any("\ud800" <= character <= "\udfff" for character in value):
            raise self.error(field, f"is {reprlib.repr(value)}, which holds half a character; write the whole one")
        return value

    def number(self, field: str, value: Any) -> float:
        """Return a value that must be a finite number."""
        if value is None:
            raise self.error(field, "is null; give the number or leave the object out")
        if type(value) not in (int, float) or not abs(value) <= _LIMIT:  # also refuses NaN
            raise self.error(field, f"is {reprlib.repr(value)}; give a finite number, at most {_LIMIT:g}")
        return float(value)

    def sequence(self, field: str, value: Any, length: int | None = None) -> list[Any]:
        """Return a value that must be a list (of `length`)."""
        if not isinstance(value, list) or length not in (None, len(value)):
            expected = "a list" if length is None else f"a list of {length}"
            raise self.error(field, f"is {reprlib.repr(value)}; give {expected}")
        return value

    def record(self, field: str, value: Any) -> "Record":
        """Return an object as a record.

        Its errors name `field` too.
        """
        if not isinstance(value, dict):
            raise self.error(field, f"is {reprlib.repr(value)}; give an object")
        return Record(f"{self.where}: {field}", value)

    def vector(self, field: str, value: Any, names: str = "xyz") -> list[float]:
        """Return the numbers `names` of an object.

        Such an object is {"x": 0, "y": 0, "z": 0}.
        """
        inner = self.record(field, value)
        return [inner.number(name, inner.get(name)) for name in names]


def read_bytes(path: Path) -> bytes:
    """Read a file, and decompress it if it is gzip.

    Raises:
      InputError: the file is missing or damaged, or too large when decompressed.
    """
    try:
        content = path.read_bytes()
        if content[:2] != b"\x1f\x8b":
            return content
        most = largest(len(content))
        with gzip.open(io.BytesIO(content)) as file:
            content = file.read(most + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: is cut short or damaged ({error}); fetch or write it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if len(content) > most:
        raise InputError(f"{path}: holds more than {most:,} bytes; split it, or give it uncompressed")
    return content


def largest(compressed: int) -> int:
    """Return the most bytes that a file of so many compressed ones may hold.

    Scenes hold 4 to 10 times as many; 64 MiB are allowed in any case.
    """
    return max(2**26, 50 * compressed)


def parse_json(where: str, text: bytes) -> Any:
    """Parse JSON.

    Raises:
      InputError: the bytes are not JSON.
    """
    try:
        return json.loads(text.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not JSON ({error}); give valid JSON") from error
