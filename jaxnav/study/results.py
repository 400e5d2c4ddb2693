"""Result files of a study: one JSON file per part, such as a condition, an instrument report or gap curves.

Every file also holds the settings that determine its numbers (`study`), by which `has_record` recognizes results that
can be reused. `load_study_results` reads all files of a folder.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from jaxnav.evaluation.report import REPORT_FORMAT, Decoding, package_versions
from jaxnav.scenes import worlds as presets
from jaxnav.store.files import write_atomic
from jaxnav.study.records import (
    Condition,
    FullCondition,
    GapCurves,
    InstrumentReport,
    MixtureReport,
    RunScores,
    from_json,
    to_json,
)

#: Runs whose worlds are measured as instruments, and whose layout gaps are traced.
STUDY_WORLDS = ("main", "real")
ConditionType = TypeVar("ConditionType", bound=Condition)
StudyRecord = Condition | InstrumentReport | GapCurves | MixtureReport | RunScores


@dataclass(frozen=True)
class WorldResults:
    """Results of one world.

    Attributes:
      conditions: one per shift.
      instrument: effect of the shift on difficulty and success.
      gap_curves: layout gap by step.
    """

    conditions: tuple[FullCondition, ...]
    instrument: InstrumentReport
    gap_curves: GapCurves


@dataclass(frozen=True)
class StudyResults:
    """Results of a study on one split.

    Attributes:
      shifts: layout shifts.
      episodes: number of episodes at each shift.
      seeds: number of training seeds.
      total_steps: environment steps of each policy.
      worlds: `main`, and `real` if it was studied.
      runs: conditions of each run, one per shift; `main` is first.
      mixtures: removals in a mixed population, by run and decoding.
    """

    shifts: tuple[float, ...]
    episodes: int
    seeds: int
    total_steps: int
    worlds: Mapping[str, WorldResults]
    runs: Mapping[str, tuple[Condition, ...]]
    mixtures: tuple[MixtureReport, ...] = ()


def condition_name(run: str, shift: float) -> str:
    """Name of the part that holds a condition."""
    return f"{run}-shift{shift:g}"


def mixture_name(run: str, decoding: Decoding) -> str:
    """Name of the part that holds a mixture."""
    return f"mixture-{run}-{decoding}"


def reuse_note(num_results: int, folder: Path) -> str:
    """Message about results that were not measured again."""
    return f"{num_results} results in {folder} were there already; measure them anew with another --results"


# Reading


def load_study_results(folder: Path) -> StudyResults | None:
    """Load the results in a folder, or None if there are none.

    Parts of a study with other settings than those of `gap-main` are ignored.
    """
    all_parts = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}
    if not all_parts:
        return None
    study = all_parts["gap-main"]["study"]
    parts = {name: part for name, part in all_parts.items() if part["study"] == study}
    shifts = tuple(study["shifts"])

    worlds = {}
    for world in STUDY_WORLDS:
        if f"gap-{world}" in parts:
            worlds[world] = WorldResults(
                conditions=_load_conditions(parts, world, shifts, FullCondition),
                instrument=from_json(InstrumentReport, parts[f"instrument-{world}"]),
                gap_curves=from_json(GapCurves, parts[f"gap-{world}"]),
            )

    # Runs that were evaluated at all shifts, `main` first.
    run_names = {name.partition("-shift")[0] for name in parts if "-shift" in name}
    runs = {}
    for run in sorted(run_names, key=lambda name: (name != "main", name)):
        if all(condition_name(run, shift) in parts for shift in shifts):
            runs[run] = _load_conditions(parts, run, shifts, Condition)

    base_settings = study["base"]
    return StudyResults(
        shifts=shifts,
        episodes=study["episodes"],
        seeds=base_settings["seeds"],
        total_steps=base_settings["total_steps"] or presets.WORLDS[base_settings["world"]].total_steps,
        worlds=worlds,
        runs=runs,
        mixtures=tuple(from_json(MixtureReport, parts[name]) for name in parts if name.startswith("mixture-")),
    )


def load_condition(path: Path) -> Condition:
    """Load the condition in a file."""
    return from_json(Condition, json.loads(path.read_text()))


def _load_conditions(
    parts: Mapping[str, Any], run: str, shifts: tuple[float, ...], condition_type: type[ConditionType]
) -> tuple[ConditionType, ...]:
    return tuple(from_json(condition_type, parts[condition_name(run, shift)]) for shift in shifts)


# Writing


def write_record(path: Path, study: Mapping[str, Any], record: StudyRecord) -> None:
    """Write a part of a study, with numbers rounded to six digits.

    Args:
      path: of the file.
      study: settings that determine the numbers.
      record: the part.

    Raises:
      OSError: the file cannot be written.
      ValueError: a curve holds NaN or an infinity.
    """
    part = {"study": study, "versions": package_versions(), "format": REPORT_FORMAT, **to_json(record)}
    write_atomic(path, (json.dumps(round_numbers(part), allow_nan=False) + "\n").encode())


def has_record(path: Path, study: Mapping[str, Any]) -> bool:
    """True if the file is undamaged and holds a part with these settings."""
    try:
        return json.loads(path.read_text())["study"] == study
    except (FileNotFoundError, ValueError, KeyError):
        return False


def round_numbers(value: Any) -> Any:
    """Round all numbers in JSON to six digits."""
    if isinstance(value, dict):
        return {name: round_numbers(item) for name, item in value.items()}
    if isinstance(value, list):
        return [round_numbers(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
