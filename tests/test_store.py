"""Checkpoints, exports and the run log: exact round trips, refusals, and kills at any moment."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import chex
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.errors import InputError
from jaxnav.store import checkpoint
from jaxnav.store.export import export_params, load_params
from jaxnav.store.files import write_atomic
from jaxnav.store.manifest import FORMAT_VERSION, differences, make_manifest
from jaxnav.store.runlog import append_row, read_rows, truncate_after

REPOSITORY = Path(__file__).parents[1]


class State(flax.struct.PyTreeNode):
    key: jax.Array
    env_keys: jax.Array
    params: dict
    moments: tuple
    step: jax.Array


def make_state(seed: int) -> State:
    key = jax.random.key(seed)
    kernel = jax.random.normal(key, (3, 4))
    return State(
        key=key,
        env_keys=jax.random.split(key, 5),
        params={"dense": {"kernel": kernel, "half": kernel.astype(jnp.bfloat16)}},
        moments=(jnp.uint8(seed), None, kernel > 0),
        step=jnp.int32(seed),
    )


ABSTRACT = jax.eval_shape(make_state, 0)
MANIFEST = make_manifest({"env": {"num_envs": 8, "view": (11, 11)}, "name": "run"})


def as_data(state: State) -> State:
    """Keys as their integers, which compare."""
    return state.replace(key=jax.random.key_data(state.key), env_keys=jax.random.key_data(state.env_keys))


# Checkpoints


def test_state_round_trips_with_types_keys_and_step(tmp_path):
    state = make_state(7)
    assert not np.array_equal(state.params["dense"]["kernel"], make_state(8).params["dense"]["kernel"])
    checkpoint.save(tmp_path, 3, state, MANIFEST)
    restored, step = checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)
    assert step == 3
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    chex.assert_trees_all_equal(as_data(restored), as_data(state), strict=True)
    # The restored key is a live key: it draws what the saved one draws.
    assert jax.random.uniform(restored.key) == jax.random.uniform(state.key)


def test_nothing_saved_restores_nothing(tmp_path):
    assert checkpoint.restore(tmp_path / "none", ABSTRACT, MANIFEST) is None
    (tmp_path / "checkpoints").mkdir()
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST) is None
    assert not (tmp_path / "none").exists()


def test_the_latest_two_steps_are_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_dir = Path("run")  # Orbax itself refuses relative paths
    for step in (1, 5, 10):
        checkpoint.save(run_dir, step, make_state(step), MANIFEST)
    assert sorted(p.name for p in (run_dir / "checkpoints").iterdir()) == ["10", "5"]
    restored, step = checkpoint.restore(run_dir, ABSTRACT, MANIFEST)
    assert (step, restored.step) == (10, 10)


@pytest.mark.parametrize("step", [4, 5])
def test_a_step_cannot_be_saved_twice_or_backwards(tmp_path, step):
    checkpoint.save(tmp_path, 5, make_state(5), MANIFEST)
    with pytest.raises(InputError, match="holds step 5 already"):
        checkpoint.save(tmp_path, step, make_state(step), MANIFEST)
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)[1] == 5


def test_another_config_is_refused_with_keys_and_values(tmp_path):
    checkpoint.save(tmp_path, 1, make_state(1), MANIFEST)
    other = make_manifest({"env": {"num_envs": 16, "view": (11, 11), "limit": 5}, "name": "run"})
    with pytest.raises(InputError) as error:
        checkpoint.restore(tmp_path, ABSTRACT, other)
    assert "env.limit: (absent) != 5; env.num_envs: 8 != 16;" in str(error.value)
    assert "env.view" not in str(error.value)


def test_another_format_version_is_refused(tmp_path):
    checkpoint.save(tmp_path, 1, make_state(1), MANIFEST | {"format_version": 99})
    with pytest.raises(InputError, match=f"has format version 99, this code reads version {FORMAT_VERSION}"):
        checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)


def test_other_package_versions_are_allowed(tmp_path):
    checkpoint.save(tmp_path, 1, make_state(1), MANIFEST | {"versions": {"jax": "0.0.1"}})
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)[1] == 1


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (lambda s: s.replace(step=jnp.float32(0)), ".step: 'int32[]' != 'float32[]'"),  # Orbax would cast it
        (lambda s: s.replace(params={"dense": jnp.ones((3, 5))}), ".params['dense']: (absent) != 'float32[3,5]'"),
        (lambda s: s.replace(env_keys=s.env_keys[:2]), ".env_keys: 'key<fry>[5]' != 'key<fry>[2]'"),
        (lambda s: s.replace(moments=s.moments[:2]), ".moments[2]: 'bool[3,4]' != (absent)"),
    ],
)
def test_another_state_is_refused_with_its_leaves(tmp_path, change, difference):
    checkpoint.save(tmp_path, 1, make_state(1), MANIFEST)
    abstract = jax.eval_shape(lambda: change(make_state(1)))
    with pytest.raises(InputError) as error:
        checkpoint.restore(tmp_path, abstract, MANIFEST)
    assert difference in str(error.value)


@pytest.mark.parametrize("leaf", [3, 0.5, np.zeros(2), jnp.zeros((0, 2))])
def test_leaves_that_could_not_be_restored_are_not_saved(tmp_path, leaf):
    with pytest.raises(TypeError, match=r"state\.step is .*non-empty jax.Array"):
        checkpoint.save(tmp_path, 1, make_state(1).replace(step=leaf), MANIFEST)
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST) is None


@pytest.mark.parametrize("lost", ["_CHECKPOINT_METADATA", "state/_METADATA"])
def test_a_damaged_checkpoint_is_named_and_removing_it_mends(tmp_path, lost):
    for step in (1, 2):
        checkpoint.save(tmp_path, step, make_state(step), MANIFEST)
    folder = tmp_path / "checkpoints" / "2"
    (folder / lost).unlink()
    with pytest.raises(InputError, match=r"checkpoints/2: (is damaged|holds no manifest)"):
        checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)
    for file in sorted(folder.rglob("*"), reverse=True):
        file.rmdir() if file.is_dir() else file.unlink()
    folder.rmdir()
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)[1] == 1


def test_unfinished_commits_are_ignored_and_cleared(tmp_path):
    checkpoint.save(tmp_path, 1, make_state(1), MANIFEST)
    unfinished = tmp_path / "checkpoints" / "2.orbax-checkpoint-tmp"
    (unfinished / "state").mkdir(parents=True)
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)[1] == 1
    checkpoint.save(tmp_path, 2, make_state(2), MANIFEST)
    assert not unfinished.exists()
    assert checkpoint.restore(tmp_path, ABSTRACT, MANIFEST)[1] == 2


# Saves step after step, each with arrays filled with the step, and says when a step is safe.
ENDLESS_SAVES = """
import sys
from pathlib import Path
import jax.numpy as jnp
from jaxnav.store import checkpoint
from jaxnav.store.manifest import make_manifest
for step in range(1, 10**6):
    state = {name: jnp.full((256, 1024), step, jnp.int32) for name in "abcd"}
    print(step, "starts", flush=True)
    checkpoint.save(Path(sys.argv[1]), step, state, make_manifest({}))
    print(step, "safe", flush=True)
"""


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.012, 0.03])
def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path, delay):
    command = [sys.executable, "-c", ENDLESS_SAVES, str(tmp_path)]
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line == "4 starts\n":  # by now older steps are being removed as well
                break
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        safe = [3] + [int(line.split()[0]) for line in process.stdout if line.endswith("safe\n")]
    assert process.returncode == -signal.SIGKILL
    abstract = {name: jax.ShapeDtypeStruct((256, 1024), jnp.int32) for name in "abcd"}
    state, step = checkpoint.restore(tmp_path, abstract, make_manifest({}))
    assert step >= safe[-1]  # what was said to be safe is there; a commit just before the kill may be too
    chex.assert_trees_all_equal(state, {name: np.full((256, 1024), step, np.int32) for name in "abcd"})
    checkpoint.save(tmp_path, step + 1, state, make_manifest({}))  # and the run goes on
    assert checkpoint.restore(tmp_path, abstract, make_manifest({}))[1] == step + 1


# Manifest


def test_manifest_is_json_with_versions():
    assert json.loads(json.dumps(MANIFEST)) == MANIFEST
    assert MANIFEST["config"]["env"]["view"] == [11, 11]
    assert MANIFEST["versions"]["jax"] == jax.__version__


def test_differences_are_dotted_and_sorted():
    a = {"b": {"c": 1, "d": {"e": 2}}, "a": [1], "only": 1}
    b = {"b": {"c": 1, "d": {"e": 3}}, "a": [2], "b2": {}}
    assert differences(a, b) == ["a: [1] != [2]", "b.d.e: 2 != 3", "b2: (absent) != {}", "only: 1 != (absent)"]
    assert differences(a, a) == []


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
