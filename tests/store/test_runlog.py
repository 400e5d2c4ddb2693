"""The run log: rows, torn lines, and resuming."""

import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.errors import InputError
from jaxnav.store.files import append_log_rows, read_log_rows, truncate_log_after


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "metrics.jsonl"
    for step in (10, 20, 30):
        append_log_rows(path, [{"step": step, "loss": step / 4}])
    return path


def test_rows_are_one_json_object_per_line_with_its_digest(log):
    *_, row = map(json.loads, log.read_text().splitlines())
    assert list(row) == ["step", "loss", "digest"]
    # The SHA-256 of the row with sorted keys and without spaces, by hand.
    assert row["digest"] == hashlib.sha256(b'{"loss":7.5,"step":30}').hexdigest()[:16]
    append_log_rows(log, [{"step": 40, "loss": float("nan"), "spl": float("inf"), "note": None}])
    assert read_log_rows(log)[-1] == {"step": 40, "loss": None, "spl": None, "note": None}


def test_a_row_without_a_digest_is_refused(log):
    log.write_text(log.read_text() + '{"step": 40}\n')
    before = log.read_bytes()
    with pytest.raises(InputError, match=r"metrics.jsonl, line 4: has no digest, so it is damaged \(restore the file"):
        truncate_log_after(log, 20)
    assert log.read_bytes() == before


@pytest.mark.parametrize(("step", "remaining"), [(0, 0), (10, 1), (25, 2), (30, 3), (99, 3)])
def test_rows_after_the_restored_step_are_dropped(log, step, remaining):
    lines = log.read_bytes().splitlines(keepends=True)
    truncate_log_after(log, step)
    assert log.read_bytes() == b"".join(lines[:remaining])  # what stays, stays to the byte


@pytest.mark.parametrize("lost", range(1, 57))
def test_a_torn_last_line_is_dropped(log, lost):
    # The last line has 56 bytes with its line end; without only the line end the row is whole and kept.
    lines = log.read_bytes().splitlines(keepends=True)
    assert len(lines[-1]) == 56
    log.write_bytes(log.read_bytes()[:-lost])
    assert len(read_log_rows(log)) == (3 if lost == 1 else 2)
    truncate_log_after(log, 30)
    assert log.read_bytes() == b"".join(lines[: 3 if lost == 1 else 2])


def test_a_bad_line_in_the_middle_is_refused_and_kept(log):
    first, _, last = log.read_text().splitlines(keepends=True)
    log.write_text(first + '{"loss": 2}\n' + last)
    before = log.read_bytes()
    with pytest.raises(InputError, match=r"metrics.jsonl, line 2: not a JSON object with a whole number `step`"):
        truncate_log_after(log, 1)
    assert log.read_bytes() == before


def test_a_missing_log_has_no_rows(tmp_path):
    truncate_log_after(tmp_path / "none.jsonl", 3)
    assert read_log_rows(tmp_path / "none.jsonl") == []
    assert list(tmp_path.iterdir()) == []


@given(st.dictionaries(st.text(), st.none() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)))
def test_any_row_reads_back_and_survives_truncation_to_the_byte(tmp_path_factory, row):
    path = tmp_path_factory.getbasetemp() / "any.jsonl"
    path.unlink(missing_ok=True)
    append_log_rows(path, [row | {"step": 1}])
    before = path.read_bytes()
    assert read_log_rows(path) == [row | {"step": 1}]
    truncate_log_after(path, 1)
    assert path.read_bytes() == before
