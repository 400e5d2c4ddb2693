"""The table of results: one flat row per number, stored as JSON lines.

Every experiment keeps its results in this form. A `ResultRow` names what was measured (world, run, variant, decoding,
shift, ...) and holds the statistic with its 95 % interval. A file of results (`write_part`) begins with the settings
that determine its numbers, so that `has_part` recognizes results that need not be measured again. `read_part` reads
the rows back, and a `ResultTable` finds them for pages and figures.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.report import package_versions
from jaxnav.evaluation.statistics import Interval
from jaxnav.store.files import write_atomic

#: Settings that files of results of earlier versions lack.
_DEFAULT_SETTINGS: Mapping[str, Any] = {"shift_by": "size"}
#: Version of the files of results.
RESULTS_FORMAT = 4


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """A statistic along an axis, such as the step of an episode, with its 95 % interval.

    Attributes:
      positions: float64 [T], on the axis.
      mean, low, high: float64 [T]; NaN where the statistic is undefined.
    """

    positions: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def from_intervals(cls, positions: Sequence[float], intervals: Iterable[Interval]) -> "Curve":
        """Make a curve from one interval per position."""
        bounds = [(interval.mean, interval.low, interval.high) for interval in intervals]
        return cls(np.asarray(positions, np.float64), *np.array(bounds, np.float64).T)

    def interval_at(self, index: int) -> Interval:
        """Interval at one position."""
        return Interval(float(self.mean[index]), float(self.low[index]), float(self.high[index]))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ResultRow:
    """One result, and what it is the result of.

    All fields but the last two identify the result; those that do not apply are empty.

    Attributes:
      world: name of the world.
      run: name of the agent, which is that of its training run.
      variant: how its policies are used: `baseline`, `layout`, `tde`, `stde`, `random`, ..., a removal rule or the
        label of its reference in a mixture.
      decoding: `argmax` for best actions, `sample` for sampled ones.
      shift: layout shift, from 0 to 1; None for a mixture of shifts.
      gap: layout gap of sTDE.
      epsilon, form: threshold and form of sTDE.
      control: modification of sTDE that serves as a control.
      category: goal category; empty for all categories together.
      reference: what the variant is compared with; the row is then the difference, paired on episodes.
      metric: name of the metric. Rates and their differences are in percent, distances in metres.
      value: the statistic.
      scenes: number of scenes.
    """

    world: str
    run: str
    variant: str = ""
    decoding: str = ""
    shift: float | None = None
    gap: str = ""
    epsilon: float | None = None
    form: str = ""
    control: str = ""
    category: str = ""
    reference: str = ""
    metric: str
    value: Interval | Curve
    scenes: int = 0

    def to_json(self) -> dict[str, Any]:
        """Convert to JSON; fields that do not apply are left out."""
        data: dict[str, Any] = {}
        for name in KEY_FIELDS:
            value = getattr(self, name)
            if value not in ("", None):
                # Results are found by these fields, so unlike values they keep all digits.
                is_whole = isinstance(value, float) and value.is_integer()
                data[name] = int(value) if is_whole else value
        if self.scenes:
            data["scenes"] = self.scenes
        return data | _value_to_json(self.value)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "ResultRow":
        """Read a row from JSON."""
        fields = {name: data[name] for name in KEY_FIELDS if name in data}
        return cls(**fields, value=_value_from_json(data), scenes=data.get("scenes", 0))


#: Fields that identify a row.
KEY_FIELDS = tuple(field.name for field in dataclasses.fields(ResultRow) if field.name not in ("value", "scenes"))


class ResultTable:
    """Rows of results, found by their fields.

    Args:
      rows: the rows.

    Raises:
      InputError: two rows have equal fields and different values.
    """

    def __init__(self, rows: Iterable[ResultRow]) -> None:
        self.rows = tuple(rows)
        self._row_by_key: dict[tuple[Any, ...], ResultRow] = {}
        for row in self.rows:
            first_row = self._row_by_key.setdefault(_row_key(row), row)
            if row is not first_row and _value_to_json(row.value) != _value_to_json(first_row.value):
                raise InputError(f"two results have the same fields: {first_row.to_json()} and {row.to_json()}")

    def where(self, *selections: Mapping[str, Any], **fields: Any) -> "ResultTable":
        """Select the rows whose fields have these values.

        Args:
          selections: fields with their values; the other methods take them alike.
          fields: further fields.
        """
        wanted = _known_fields(selections, fields)
        rows = []
        for row in self.rows:
            if all(getattr(row, name) == value for name, value in wanted.items()):
                rows.append(row)
        return ResultTable(rows)

    def distinct(self, field: str, *selections: Mapping[str, Any], **fields: Any) -> list[Any]:
        """List the values of a field among the rows where others have given values, in order of appearance."""
        return list(dict.fromkeys(getattr(row, field) for row in self.where(*selections, **fields).rows))

    def find(self, *selections: Mapping[str, Any], **fields: Any) -> Interval:
        """Statistic of one row; fields that are not given must be empty.

        Returns:
          The interval; its mean is NaN if there is no such row.
        """
        row = self._find_row(selections, fields)
        return row.value if row is not None and isinstance(row.value, Interval) else Interval(math.nan)

    def find_at(self, position: float, *selections: Mapping[str, Any], **fields: Any) -> Interval:
        """Statistic at a position of the curve of one row; its mean is NaN if there is no such row or position."""
        row = self._find_row(selections, fields)
        if row is None or not isinstance(row.value, Curve) or position not in row.value.positions:
            return Interval(math.nan)
        return row.value.interval_at(int(np.flatnonzero(row.value.positions == position)[0]))

    def has(self, *selections: Mapping[str, Any], **fields: Any) -> bool:
        """True if a row has exactly these fields."""
        return self._find_row(selections, fields) is not None

    def curve(self, *selections: Mapping[str, Any], **fields: Any) -> Curve:
        """Curve of one row; fields that are not given must be empty.

        Raises:
          KeyError: no such row holds a curve.
        """
        row = self._find_row(selections, fields)
        if row is None or not isinstance(row.value, Curve):
            raise KeyError(f"no curve of {merge_fields(*selections, **fields)}")
        return row.value

    def num_scenes(self, *selections: Mapping[str, Any], **fields: Any) -> int:
        """Number of scenes behind the first row with these values."""
        return self.where(*selections, **fields).rows[0].scenes

    def _find_row(self, selections: Sequence[Mapping[str, Any]], fields: Mapping[str, Any]) -> ResultRow | None:
        wanted = _known_fields(selections, fields)
        return self._row_by_key.get(tuple(wanted.get(name, _EMPTY[name]) for name in KEY_FIELDS))


def merge_fields(*selections: Mapping[str, Any], **fields: Any) -> dict[str, Any]:
    """Merge fields, of which the later ones count."""
    merged: dict[str, Any] = {}
    for selection in (*selections, fields):
        merged |= selection
    return merged


#: Value of every field that is not given.
_EMPTY: Mapping[str, Any] = dict.fromkeys(KEY_FIELDS, "") | {"shift": None, "epsilon": None}


def _known_fields(selections: Sequence[Mapping[str, Any]], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Merge fields, and refuse names that no row has: a misspelt field would find nothing."""
    wanted = merge_fields(*selections, **fields)
    unknown_names = sorted(wanted.keys() - _EMPTY.keys())
    if unknown_names:
        raise KeyError(f"rows have no field {unknown_names[0]!r}")
    return wanted


def _row_key(row: ResultRow) -> tuple[Any, ...]:
    return tuple(getattr(row, name) for name in KEY_FIELDS)


def _value_to_json(value: Interval | Curve) -> dict[str, Any]:
    """JSON of a statistic; numbers have seven digits, undefined ones are left out, or null in a curve."""
    if isinstance(value, Curve):
        data: dict[str, Any] = {"positions": _round_list(value.positions), "mean": _round_list(value.mean)}
        if not np.isnan(value.low).all():
            data |= {"low": _round_list(value.low), "high": _round_list(value.high)}
        return data

    numbers = {"mean": value.mean, "low": value.low, "high": value.high}
    data = {name: _round(number) for name, number in numbers.items() if not math.isnan(number)}
    if value.seeds:
        data["seeds"] = _round_list(value.seeds)
    return data


def _value_from_json(data: Mapping[str, Any]) -> Interval | Curve:
    if "positions" in data:
        undefined = [None] * len(data["positions"])
        low = np.array(data.get("low", undefined), np.float64)
        high = np.array(data.get("high", undefined), np.float64)
        return Curve(np.array(data["positions"], np.float64), np.array(data["mean"], np.float64), low, high)

    # The deviation over the training runs follows from their values; that of two sides that were trained separately is
    # not stored.
    seeds = tuple(data.get("seeds", ()))
    std = float(np.std(seeds, ddof=1)) if len(seeds) > 1 else math.nan
    low = float(data.get("low", math.nan))
    high = float(data.get("high", math.nan))
    return Interval(float(data["mean"]), low, high, std, seeds)


def _round(number: float) -> float:
    """Round to seven digits; whole numbers become integers, which are shorter in JSON, but -0 keeps its sign."""
    rounded = float(f"{number:.7g}")
    is_negative_zero = rounded == 0.0 and math.copysign(1.0, rounded) < 0.0
    return int(rounded) if rounded.is_integer() and not is_negative_zero else rounded


def _round_list(numbers: Iterable[float]) -> list[float | None]:
    rounded_numbers = []
    for number in numbers:
        is_missing = math.isnan(number)
        rounded_numbers.append(None if is_missing else _round(number))
    return rounded_numbers


# Files


def write_part(path: Path, settings: Mapping[str, Any], rows: Iterable[ResultRow]) -> None:
    """Write rows into a file, which is replaced atomically.

    Args:
      path: the file. Its first line is the head: the settings, and the fields that all rows share. Every further line
        is a row. Rows without a value are left out.
      settings: settings that determine the numbers, as JSON.
      rows: the rows.

    Raises:
      OSError: the file cannot be written.
    """
    row_lines = []
    for row in rows:
        if isinstance(row.value, Curve) or not math.isnan(row.value.mean):
            row_lines.append(row.to_json())

    # Fields that all rows share are written once. They are compared as text, which distinguishes -0 from 0.
    shared = dict(row_lines[0]) if len(row_lines) > 1 else {}
    for line in row_lines:
        shared = {name: value for name, value in shared.items() if str(line.get(name)) == str(value)}
    head = {"settings": settings, "versions": package_versions(), "format": RESULTS_FORMAT, "shared": shared}

    text = json.dumps(head) + "\n"
    for line in row_lines:
        own_fields = {name: value for name, value in line.items() if name not in shared}
        text += json.dumps(own_fields, separators=(",", ":"), allow_nan=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text.encode())


def has_part(path: Path, settings: Mapping[str, Any]) -> bool:
    """True if the file is undamaged and holds results of these settings.

    Raises:
      InputError: as `read_settings`.
    """
    return read_settings(path) == settings


def read_settings(path: Path) -> dict[str, Any] | None:
    """Read the settings of a file; None if it is missing or damaged.

    Raises:
      InputError: the file holds results of another format, which must not be lost.
    """
    try:
        part_settings, _ = _read_file(path)
    except (FileNotFoundError, _DamagedFileError):
        return None
    return part_settings


def read_part(path: Path, settings: Mapping[str, Any] | None = None) -> list[ResultRow]:
    """Read the rows of a file.

    Args:
      path: the file.
      settings: settings that the file must share; no rows if any of them differs.

    Raises:
      InputError: the file is damaged, or is no file of results.
    """
    part_settings, rows = _read_file(path)
    for name, value in (settings or {}).items():
        if part_settings.get(name, _DEFAULT_SETTINGS.get(name)) != value:
            return []
    return rows


class _DamagedFileError(InputError):
    """A file of results cannot be read."""


def _read_file(path: Path) -> tuple[dict[str, Any], list[ResultRow]]:
    """Read the settings and the rows of a file."""
    try:
        head, *row_lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if head["format"] == RESULTS_FORMAT:
            rows = [ResultRow.from_json(head["shared"] | line) for line in row_lines]
            return dict(head["settings"]), rows
    except (ValueError, KeyError, TypeError) as error:
        raise _DamagedFileError(f"{path}: is damaged ({error}); delete it, and it is measured again") from error
    raise InputError(f"{path}: holds no results of format {RESULTS_FORMAT}; move it away to measure them again")
