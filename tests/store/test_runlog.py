"""The run log: rows, torn lines, and resuming."""

import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.errors import InputError
from jaxnav.store.files import append_log_rows, read_log_rows, truncate_log_after


@pytest.fixture
def log_path(tmp_path):
    log_file = tmp_path / "metrics.jsonl"
    for step in (10, 20, 30):
        append_log_rows(log_file, [{"step": step, "loss": step / 4}])
    return log_file


def test_log_rows_are_json_lines_with_digests(log_path):
    *_, row = map(json.loads, log_path.read_text().splitlines())
    assert list(row) == ["step", "loss", "digest"]
    # The SHA-256 of the row with sorted keys and without spaces, by hand.
    assert row["digest"] == hashlib.sha256(b'{"loss":7.5,"step":30}').hexdigest()[:16]
    append_log_rows(log_path, [{"step": 40, "loss": float("nan"), "spl": float("inf"), "note": None}])
    assert read_log_rows(log_path)[-1] == {"step": 40, "loss": None, "spl": None, "note": None}


def test_truncate_log_refuses_a_row_without_digest(log_path):
    log_path.write_text(log_path.read_text() + '{"step": 40}\n')
    content_before = log_path.read_bytes()
    with pytest.raises(InputError, match=r"metrics.jsonl, line 4: .*digest.*restore the file"):
        truncate_log_after(log_path, 20)
    assert log_path.read_bytes() == content_before


@pytest.mark.parametrize(("restored_step", "remaining_rows"), [(0, 0), (10, 1), (25, 2), (30, 3), (99, 3)])
def test_truncate_log_drops_rows_after_the_restored_step(log_path, restored_step, remaining_rows):
    lines = log_path.read_bytes().splitlines(keepends=True)
    truncate_log_after(log_path, restored_step)
    assert log_path.read_bytes() == b"".join(lines[:remaining_rows])


@pytest.mark.parametrize("lost_bytes", range(1, 57))
def test_truncate_log_drops_a_torn_last_line(log_path, lost_bytes):
    # The last line has 56 bytes with its line end; without only the line end the row is whole and kept.
    lines = log_path.read_bytes().splitlines(keepends=True)
    assert len(lines[-1]) == 56
    log_path.write_bytes(log_path.read_bytes()[:-lost_bytes])
    assert len(read_log_rows(log_path)) == (3 if lost_bytes == 1 else 2)
    truncate_log_after(log_path, 30)
    assert log_path.read_bytes() == b"".join(lines[: 3 if lost_bytes == 1 else 2])


def test_truncate_log_refuses_a_bad_line_in_the_middle(log_path):
    first_line, _, last_line = log_path.read_text().splitlines(keepends=True)
    log_path.write_text(first_line + '{"loss": 2}\n' + last_line)
    content_before = log_path.read_bytes()
    with pytest.raises(InputError, match=r"metrics.jsonl, line 2: .*`step`"):
        truncate_log_after(log_path, 1)
    assert log_path.read_bytes() == content_before


def test_missing_log_has_no_rows(tmp_path):
    truncate_log_after(tmp_path / "none.jsonl", 3)
    assert read_log_rows(tmp_path / "none.jsonl") == []
    assert list(tmp_path.iterdir()) == []


#: Names of fields; the digest is added.
field_names = st.text().filter(lambda name: name != "digest")


@given(st.dictionaries(field_names, st.none() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)))
def test_log_rows_of_any_content_round_trip_and_survive_truncation(tmp_path_factory, row):
    log_file = tmp_path_factory.getbasetemp() / "any.jsonl"
    log_file.unlink(missing_ok=True)
    append_log_rows(log_file, [row | {"step": 1}])
    content_before = log_file.read_bytes()
    assert read_log_rows(log_file) == [row | {"step": 1}]
    truncate_log_after(log_file, 1)
    assert log_file.read_bytes() == content_before


def test_a_row_whose_own_digest_would_be_lost_is_refused(log_path):
    content_before = log_path.read_bytes()
    with pytest.raises(ValueError, match="'digest' is the digest of the record; give another name"):
        append_log_rows(log_path, [{"step": 40, "digest": 1.0}])
    assert log_path.read_bytes() == content_before


def test_a_folder_in_place_of_a_log_is_refused(tmp_path):
    (tmp_path / "metrics.jsonl").mkdir()
    for read in (read_log_rows, lambda path: truncate_log_after(path, 1)):
        with pytest.raises(InputError, match=r"metrics.jsonl: cannot be read \(Is a directory\); move it away"):
            read(tmp_path / "metrics.jsonl")
