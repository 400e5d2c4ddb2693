"""Result files: the committed ones, and how they are written."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import study_results

from jaxnav.study.document import READING_MARK, write_study_document
from jaxnav.study.records import (
    Condition,
    FullCondition,
    GapCurves,
    InstrumentReport,
    MixtureReport,
    from_json,
    to_json,
)
from jaxnav.study.results import has_record, load_condition, load_study_results, write_record

ROOT = Path(__file__).parents[2]
STUDIES = {
    "results": "docs/study.md",
    "results/quick": "results/quick/study.md",
    "results/ai2thor": "results/ai2thor/study.md",
}
SPLITS = ("val", "test")
COMMITTED = sorted(path for folder in STUDIES for split in SPLITS for path in (ROOT / folder / split).glob("*.json"))
HEADER = {"study", "versions", "format"}


def kind(part: dict[str, Any]) -> type:
    """Return the type of the record that a part holds."""
    if "removals" in part:
        return MixtureReport
    if "rows" in part:
        return FullCondition if "gains" in part else Condition
    return InstrumentReport if "matched" in part else GapCurves


def without_nulls(value: Any) -> Any:
    """Return JSON without spreads and bounds that are null.

    Version 0.1 left out a spread that was undefined, and wrote two bounds.
    """
    if isinstance(value, list):
        return [without_nulls(item) for item in value]
    if not isinstance(value, dict):
        return value
    empty = {"std": (None,), "ci95": (None, [None, None])}
    return {name: without_nulls(item) for name, item in value.items() if item not in empty.get(name, ())}


# Committed results


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parents[1].name}-{path.stem}")
def test_committed_parts_are_read_and_written_with_the_same_keys(path):
    part = json.loads(path.read_text())
    assert HEADER | to_json(from_json(kind(part), part)).keys() == part.keys()
    written = {name: part[name] for name in HEADER} | to_json(from_json(kind(part), part))
    # In the same order.
    assert json.dumps(without_nulls({name: written[name] for name in part})) == json.dumps(without_nulls(part))


@pytest.mark.parametrize(("results", "document"), STUDIES.items())
def test_committed_documents_are_those_of_their_results(tmp_path, results, document):
    write_study_document(ROOT / results, tmp_path / "study.md")
    (head, _, tail), (written, _, rest) = (
        path.read_text(encoding="utf-8").split(READING_MARK) for path in (ROOT / document, tmp_path / "study.md")
    )
    assert written == head
    assert rest == tail


# Parts


def test_parts_are_loaded_by_name(tmp_path):
    study_results.write(tmp_path / "val", study_results.parts(("main", "real")))
    assert to_json_of(load_study_results(tmp_path / "val")) == to_json_of(study_results.results(("main", "real")))
    assert load_study_results(tmp_path / "test") is None


def to_json_of(results) -> Any:
    assert results is not None
    return to_json(results)


def test_parts_of_another_study_are_not_read(tmp_path):
    study_results.write(tmp_path, study_results.parts())
    study_results.write(tmp_path, {"left-shift0": study_results.condition(0.0, "coin")}, study={})
    assert to_json_of(load_study_results(tmp_path)) == to_json_of(study_results.results())


def test_a_study_of_the_usual_length_tells_its_steps(tmp_path):
    """Where no number is given runs take that of their world, 1.2 million in rooms."""
    usual = study_results.STUDY | {"base": {"seeds": 3, "total_steps": None, "world": "rooms"}}
    study_results.write(tmp_path, study_results.parts(), usual)
    results = load_study_results(tmp_path)
    assert results is not None
    assert results.total_steps == 1_200_000


def test_a_run_that_misses_a_shift_is_not_read(tmp_path):
    parts = study_results.parts()
    del parts["gate-shift1"]
    study_results.write(tmp_path, parts)
    results = load_study_results(tmp_path)
    assert results is not None
    assert list(results.runs) == ["main", "coin"]


def test_a_part_is_written_with_its_study_and_six_digits(tmp_path):
    path = tmp_path / "part.json"
    course = GapCurves((0,), np.array([[1 / 3]]), (), ())
    assert not has_record(path, {"seed": 0})
    write_record(path, {"seed": 0}, course)
    part = json.loads(path.read_text())
    assert part.keys() > HEADER
    assert (part["study"], part["running"]) == ({"seed": 0}, [[0.333333]])
    assert has_record(path, {"seed": 0})
    assert not has_record(path, {"seed": 1})
    path.write_text("{")
    assert not has_record(path, {"seed": 0})


def test_a_full_condition_is_read_as_a_plain_one(tmp_path):
    study_results.write(tmp_path, {"main-shift1": study_results.full_condition(1.0, chosen_epsilon=0.5)})
    condition = load_condition(tmp_path / "main-shift1.json")
    assert condition.chosen == 0.5
    assert condition.rows == study_results.full_condition(1.0).rows
