"""Exported parameters, the run log and atomic files: round trips, refusals and torn files."""

import os
import subprocess
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.errors import InputError
from jaxnav.store.export import export_params, load_params
from jaxnav.store.files import write_atomic
from jaxnav.store.runlog import append_row, read_rows, truncate_after

REPOSITORY = Path(__file__).parents[2]

# Exported parameters

PARAMS = {"torso": {"dense": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3).T}}, "scale": np.float32(2)}
SPEC = {"method": "vtnet", "hidden": 8}


def test_params_round_trip_and_read_with_safetensors_alone(tmp_path):
    export_params(tmp_path / "policy", jax.tree.map(jnp.asarray, PARAMS), SPEC)
    params, spec = load_params(tmp_path / "policy")
    assert spec == SPEC
    chex.assert_trees_all_equal(params, PARAMS, strict=True)
    flat = safetensors.numpy.load_file(tmp_path / "policy" / "params.safetensors")
    assert sorted(flat) == ["scale", "torso/dense/kernel"]
    export_params(tmp_path / "policy", PARAMS, SPEC)  # not contiguous: the transposed kernel keeps its order
    chex.assert_trees_all_equal(load_params(tmp_path / "policy")[0], PARAMS)


def test_an_export_is_replaced_and_leaves_two_files(tmp_path):
    export_params(tmp_path, PARAMS, SPEC)
    export_params(tmp_path, {"scale": np.float32(3)}, {"method": "org"})
    assert load_params(tmp_path) == ({"scale": np.float32(3)}, {"method": "org"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["params.safetensors", "policy.json"]


def test_reading_an_export_needs_no_jax(tmp_path):
    export_params(tmp_path, PARAMS, SPEC)
    script = (
        "import sys; from pathlib import Path; from jaxnav.store.export import load_params\n"
        "params, spec = load_params(Path(sys.argv[1])); print(spec['method'], float(params['scale']))\n"
        "print(sorted({'jax', 'flax', 'orbax'} & set(sys.modules)))"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert run.stdout == "vtnet 2.0\n[]\n"


@pytest.mark.parametrize("name", [0, "a/b"])
def test_ambiguous_parameter_names_are_refused(tmp_path, name):
    with pytest.raises(TypeError, match="must be a string without '/'"):
        export_params(tmp_path, {"layers": {name: np.zeros(1)}}, SPEC)


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("policy.json", None, "not an exported policy"),
        ("params.safetensors", None, "not an exported policy"),
        ("policy.json", b"{", "policy.json: not JSON"),
        ("policy.json", b"[]", "policy.json: lacks"),
        ("policy.json", b'{"format_version": 9, "params_sha256": "", "spec": {}}', "has format version 9"),
        ("params.safetensors", b"", "params.safetensors: does not belong to policy.json or is damaged"),
    ],
)
def test_broken_exports_are_refused(tmp_path, file, content, problem):
    export_params(tmp_path, PARAMS, SPEC)
    (tmp_path / file).unlink()
    if content is not None:
        (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=problem):
        load_params(tmp_path)


def test_an_export_killed_between_its_files_is_refused_not_mixed(tmp_path, monkeypatch):
    export_params(tmp_path, PARAMS, SPEC)
    replace = os.replace

    def killed_at_policy(source, target):
        if Path(target).name == "policy.json":
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", killed_at_policy)
    with pytest.raises(KeyboardInterrupt):
        export_params(tmp_path, {"scale": np.float32(3)}, SPEC)
    with pytest.raises(InputError, match="does not belong"):
        load_params(tmp_path)


# Run log


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "metrics.jsonl"
    for step in (10, 20, 30):
        append_row(path, {"step": step, "loss": step / 4})
    return path


def test_rows_are_one_json_object_per_line(log):
    assert log.read_text() == '{"step": 10, "loss": 2.5}\n{"step": 20, "loss": 5.0}\n{"step": 30, "loss": 7.5}\n'
    append_row(log, {"step": 40, "loss": float("nan"), "spl": float("inf"), "note": None})
    assert read_rows(log)[-1] == {"step": 40, "loss": None, "spl": None, "note": None}


@pytest.mark.parametrize(("step", "kept"), [(0, 0), (10, 1), (25, 2), (30, 3), (99, 3)])
def test_rows_after_the_restored_step_are_dropped(log, step, kept):
    lines = log.read_bytes().splitlines(keepends=True)
    truncate_after(log, step)
    assert log.read_bytes() == b"".join(lines[:kept])  # what stays, stays to the byte


@pytest.mark.parametrize("cut", range(1, 27))
def test_a_torn_last_line_is_dropped(log, cut):
    # The last line has 26 bytes with its line end; without only the line end the row is whole and kept.
    lines = log.read_bytes().splitlines(keepends=True)
    assert len(lines[-1]) == 26
    log.write_bytes(log.read_bytes()[:-cut])
    assert len(read_rows(log)) == (3 if cut == 1 else 2)
    truncate_after(log, 30)
    assert log.read_bytes() == b"".join(lines[: 3 if cut == 1 else 2])


def test_a_bad_line_in_the_middle_is_refused_and_kept(log):
    log.write_text('{"step": 1}\n{"loss": 2}\n{"step": 3}\n')
    before = log.read_bytes()
    with pytest.raises(InputError, match=r"metrics.jsonl, line 2: not a JSON object with a whole number `step`"):
        truncate_after(log, 1)
    assert log.read_bytes() == before


def test_a_missing_log_has_no_rows(tmp_path):
    truncate_after(tmp_path / "none.jsonl", 3)
    assert read_rows(tmp_path / "none.jsonl") == []
    assert list(tmp_path.iterdir()) == []


@given(st.dictionaries(st.text(), st.none() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)))
def test_any_row_reads_back_and_survives_truncation_to_the_byte(tmp_path_factory, row):
    path = tmp_path_factory.getbasetemp() / "any.jsonl"
    path.unlink(missing_ok=True)
    append_row(path, row | {"step": 1})
    before = path.read_bytes()
    assert read_rows(path) == [row | {"step": 1}]
    truncate_after(path, 1)
    assert path.read_bytes() == before


# Atomic files


def test_a_failed_replacement_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomic(path, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
