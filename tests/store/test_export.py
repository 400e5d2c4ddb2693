"""Exported parameters: round trips, and broken exports."""

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

from jaxnav.errors import InputError
from jaxnav.store.export import POLICY_FORMAT_VERSION, export_params, load_params

REPOSITORY = Path(__file__).parents[2]
PARAMS = {"torso": {"dense": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3).T}}, "scale": np.float32(2)}
SPEC = {"method": "vtnet", "hidden": 8}


def test_params_round_trip_and_read_with_safetensors_alone(tmp_path):
    export_params(tmp_path / "policy", jax.tree.map(jnp.asarray, PARAMS), SPEC)
    params, spec = load_params(tmp_path / "policy")
    assert spec == SPEC
    chex.assert_trees_all_equal(params, PARAMS, strict=True)
    flat = safetensors.numpy.load_file(tmp_path / "policy" / "params.safetensors")
    assert sorted(flat) == ["scale", "torso/dense/kernel"]
    export_params(tmp_path / "again", PARAMS, SPEC)  # not contiguous: the transposed kernel keeps its order
    chex.assert_trees_all_equal(load_params(tmp_path / "again")[0], PARAMS)


def test_an_export_stays_is_mended_and_is_not_replaced_by_another(tmp_path):
    export_params(tmp_path, PARAMS, SPEC)
    written = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sorted(written) == ["params.safetensors", "policy.json"]
    for params, spec in (({"scale": np.float32(3)}, SPEC), (PARAMS, {"method": "org"})):
        with pytest.raises(InputError, match="holds another policy than would be exported"):
            export_params(tmp_path, params, spec)
    for name in written:
        (tmp_path / name).write_bytes(b"damaged")
        export_params(tmp_path, PARAMS, SPEC)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == written


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
    (tmp_path / "params.safetensors").write_bytes(b"damaged")  # or it would not be replaced
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


def test_an_export_of_another_format_version_is_not_overwritten(tmp_path):
    export_params(tmp_path, PARAMS, SPEC)
    policy = tmp_path / "policy.json"
    policy.write_text(policy.read_text().replace(f'"format_version": {POLICY_FORMAT_VERSION}', '"format_version": 9'))
    before = policy.read_bytes()
    with pytest.raises(InputError, match="has format version 9, this code reads"):
        export_params(tmp_path, PARAMS, SPEC)
    assert policy.read_bytes() == before
