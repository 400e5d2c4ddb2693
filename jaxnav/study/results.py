"""Result files of a study, one for each part."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from jaxnav.evaluation.report import FORMAT, Decoding, versions
from jaxnav.scenes import worlds as presets
from jaxnav.store.files import write_atomic
from jaxnav.study.codec import from_json, to_json
from jaxnav.study.compare_report import Scores
from jaxnav.study.curves import GapCourse
from jaxnav.study.instrument_report import InstrumentReport
from jaxnav.study.mixture_report import Mixture
from jaxnav.study.records import Condition, FullCondition

#: Runs whose worlds are measured as instruments, and whose gaps are followed.
WORLDS = ("main", "real")
Kind = TypeVar("Kind", bound=Condition)
Record = Condition | InstrumentReport | GapCourse | Mixture | Scores


@dataclass(frozen=True)
class WorldResults:
    """Hold what is known of one world.

    Attributes:
      conditions: one for each shift.
      instrument: what the shift changes.
      course: of the gap.
    """

    conditions: tuple[FullCondition, ...]
    instrument: InstrumentReport
    course: GapCourse


@dataclass(frozen=True)
class StudyResults:
    """Hold the results of a study on one split.

    Attributes:
      shifts: of the layout.
      episodes: number at each shift.
      seeds: number of training seeds.
      total_steps: environment steps of each policy.
      worlds: `main`, and `real` where it was studied.
      runs: conditions of each run, one for each shift; `main` comes first.
      mixtures: removals in a mixed population, by run and decoding.
    """

    shifts: tuple[float, ...]
    episodes: int
    seeds: int
    total_steps: int
    worlds: Mapping[str, WorldResults]
    runs: Mapping[str, tuple[Condition, ...]]
    mixtures: tuple[Mixture, ...] = ()


def condition_name(run: str, shift: float) -> str:
    """Return the name of the part that holds a condition."""
    return f"{run}-shift{shift:g}"


def mixture_name(run: str, decoding: Decoding) -> str:
    """Return the name of the part that holds a mixture."""
    return f"mixture-{run}-{decoding}"


def kept_note(count: int, folder: Path) -> str:
    """Return what to say of results that were not measured again."""
    return f"{count} results in {folder} were there already; measure them anew with another --results"


def load_results(folder: Path) -> StudyResults | None:
    """Load the results in a folder, if there are any.

    Parts of another study than that of `gap-main` are ignored.
    """
    parts = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}
    if not parts:
        return None
    study = parts["gap-main"]["study"]
    parts = {name: part for name, part in parts.items() if part["study"] == study}
    worlds = {
        world: WorldResults(
            _conditions(parts, world, study["shifts"], FullCondition),
            from_json(InstrumentReport, parts[f"instrument-{world}"]),
            from_json(GapCourse, parts[f"gap-{world}"]),
        )
        for world in WORLDS
        if f"gap-{world}" in parts
    }
    names = {name.partition("-shift")[0] for name in parts if "-shift" in name}
    runs = {
        name: _conditions(parts, name, study["shifts"], Condition)
        for name in sorted(names, key=lambda name: (name != "main", name))
        if all(condition_name(name, shift) in parts for shift in study["shifts"])
    }
    mixtures = tuple(from_json(Mixture, part) for name, part in parts.items() if name.startswith("mixture-"))
    base, shifts = study["base"], tuple(study["shifts"])
    steps = base["total_steps"] or presets.WORLDS[base["world"]].total_steps
    return StudyResults(shifts, study["episodes"], base["seeds"], steps, worlds, runs, mixtures)


def load_condition(path: Path) -> Condition:
    """Load the condition in a file."""
    return from_json(Condition, json.loads(path.read_text()))


def write_record(path: Path, study: Mapping[str, Any], record: Record) -> None:
    """Write a part of a study, numbers to six digits.

    Raises:
      OSError: the file cannot be written.
      ValueError: a curve holds NaN or an infinity.
    """
    part = {"study": study, "versions": versions(), "format": FORMAT, **to_json(record)}
    write_atomic(path, (json.dumps(rounded(part), allow_nan=False) + "\n").encode())


def is_written(path: Path, study: Mapping[str, Any]) -> bool:
    """Return whether an undamaged part of this study is there."""
    try:
        return json.loads(path.read_text())["study"] == study
    except (FileNotFoundError, ValueError, KeyError):
        return False


def _conditions(parts: Mapping[str, Any], run: str, shifts: list[float], kind: type[Kind]) -> tuple[Kind, ...]:
    return tuple(from_json(kind, parts[condition_name(run, shift)]) for shift in shifts)


def rounded(value: Any) -> Any:
    """Return JSON with six digits of each number."""
    if isinstance(value, dict):
        return {name: rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
