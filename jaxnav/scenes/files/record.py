"""Checked access to the JSON of users' files: every error says where the value stands and how to mend it."""

import dataclasses
import gzip
import json
import reprlib
import zlib
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError

_LIMIT = 1e6  # a number beyond it (metres, degrees) is a mistake


@dataclasses.dataclass(frozen=True)
class Record:
    """A JSON object, and how errors name it.

    Attributes:
      where: for example `rooms.jsonl.gz, line 3, scene 'FloorPlan1'`.
      fields: its members.
    """

    where: str
    fields: dict[str, Any]

    def error(self, field: str, problem: str) -> InputError:
        """An error about one field, to be raised."""
        return InputError(f"{self.where}: {field} {problem}")

    def get(self, field: str) -> Any:
        """A required member."""
        if field not in self.fields:
            raise self.error(field, "is missing; add it")
        return self.fields[field]

    def text(self, field: str, value: Any) -> str:
        """`value`, if it is a text that is not empty."""
        if not isinstance(value, str) or not value:
            raise self.error(field, f"is {reprlib.repr(value)}; give a text")
        return value

    def number(self, field: str, value: Any) -> float:
        """`value` as a float, if it is a finite number."""
        if value is None:
            raise self.error(field, "is null; give the number or leave the object out")
        if type(value) not in (int, float) or not abs(value) <= _LIMIT:  # also refuses NaN
            raise self.error(field, f"is {reprlib.repr(value)}; give a finite number, at most {_LIMIT:g}")
        return float(value)

    def sequence(self, field: str, value: Any, length: int | None = None) -> list[Any]:
        """`value`, if it is a list (of `length`)."""
        if not isinstance(value, list) or length not in (None, len(value)):
            expected = "a list" if length is None else f"a list of {length}"
            raise self.error(field, f"is {reprlib.repr(value)}; give {expected}")
        return value

    def record(self, field: str, value: Any) -> "Record":
        """`value` as a record whose errors name `field` too, if it is an object."""
        if not isinstance(value, dict):
            raise self.error(field, f"is {reprlib.repr(value)}; give an object")
        return Record(f"{self.where}: {field}", value)

    def vector(self, field: str, value: Any, names: str = "xyz") -> list[float]:
        """The members `names` of an object of numbers such as {"x": 0, "y": 0, "z": 0}."""
        inner = self.record(field, value)
        return [inner.number(name, inner.get(name)) for name in names]


def read_bytes(path: Path) -> bytes:
    """The content of a file, decompressed if it is gzip.

    Raises:
      InputError: the file is missing or damaged.
    """
    try:
        content = path.read_bytes()
        return gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: is cut short or damaged ({error}); fetch or write it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def parse_json(where: str, text: bytes) -> Any:
    """JSON of some bytes.

    Raises:
      InputError: it is none.
    """
    try:
        return json.loads(text.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not JSON ({error}); give valid JSON") from error
