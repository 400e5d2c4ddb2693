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
from support.commands import contents

from jaxnav.errors import InputError
from jaxnav.store.export import POLICY_FORMAT_VERSION, export_params, load_params

REPOSITORY = Path(__file__).parents[2]
PARAMS = {"torso": {"dense": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3).T}}, "scale": np.float32(2)}
SPEC = {"method": "vtnet", "hidden": 8}


def test_exported_params_round_trip_and_load_with_safetensors_alone(tmp_path):
    export_params(tmp_path / "policy", jax.tree.map(jnp.asarray, PARAMS), SPEC)

    # Parameters, specification and types are the same.
    loaded_params, loaded_spec = load_params(tmp_path / "policy")
    assert loaded_spec == SPEC
    chex.assert_trees_all_equal(loaded_params, PARAMS, strict=True)

    # The file is readable without jaxnav.
    flat_params = safetensors.numpy.load_file(tmp_path / "policy" / "params.safetensors")
    assert sorted(flat_params) == ["scale", "torso/dense/kernel"]

    # An array that is not contiguous, the transposed kernel, keeps its order.
    export_params(tmp_path / "again", PARAMS, SPEC)
    chex.assert_trees_all_equal(load_params(tmp_path / "again")[0], PARAMS)


@pytest.mark.parametrize(
    ("other_params", "other_spec"), [({"scale": np.float32(3)}, SPEC), (PARAMS, {"method": "org"})]
)
def test_export_refuses_to_replace_another_policy(tmp_path, other_params, other_spec):
    export_params(tmp_path, PARAMS, SPEC)
    exported_files = contents(tmp_path)
    with pytest.raises(InputError, match="another policy"):
        export_params(tmp_path, other_params, other_spec)
    assert contents(tmp_path) == exported_files


@pytest.mark.parametrize(
    ("other_kernel", "is_equal"),
    [
        (lambda kernel: kernel * np.float32(1 + 5e-6), True),  # other hardware sums in another order
        (lambda kernel: kernel + np.float32(5e-6), True),
        (lambda kernel: kernel * np.float32(1 + 1e-4), False),
        (lambda kernel: kernel + np.float32(1e-4), False),
        (lambda kernel: kernel * np.nan, False),
        (lambda kernel: kernel.astype(np.float64), False),
        (lambda kernel: kernel[None], False),
        (lambda kernel: kernel[:, None], False),
    ],
)
def test_exports_are_compared_by_numbers(tmp_path, other_kernel, is_equal):
    kernel = np.linspace(-3, 3, 7, dtype=np.float32)
    export_params(tmp_path, {"kernel": kernel}, SPEC)
    exported_files = contents(tmp_path)
    if is_equal:
        export_params(tmp_path, {"kernel": other_kernel(kernel)}, SPEC)
    else:
        with pytest.raises(InputError, match="another policy"):
            export_params(tmp_path, {"kernel": other_kernel(kernel)}, SPEC)
    assert contents(tmp_path) == exported_files


def test_whole_numbers_of_equal_exports_are_exact(tmp_path):
    steps = np.array([10**6, 0], np.int32)
    export_params(tmp_path, {"steps": steps}, SPEC)
    export_params(tmp_path, {"steps": steps}, SPEC)
    with pytest.raises(InputError, match="another policy"):
        export_params(tmp_path, {"steps": steps + np.int32(1)}, SPEC)


@pytest.mark.parametrize("file_name", ["params.safetensors", "policy.json"])
def test_export_repairs_a_damaged_file(tmp_path, file_name):
    export_params(tmp_path, PARAMS, SPEC)
    exported_files = contents(tmp_path)
    assert sorted(exported_files) == ["params.safetensors", "policy.json"]
    (tmp_path / file_name).write_bytes(b"damaged")
    export_params(tmp_path, PARAMS, SPEC)
    assert contents(tmp_path) == exported_files


def test_load_params_imports_no_jax(tmp_path):
    export_params(tmp_path, PARAMS, SPEC)
    reading_script = (
        "import sys; from pathlib import Path; from jaxnav.store.export import load_params\n"
        "params, spec = load_params(Path(sys.argv[1])); print(spec['method'], float(params['scale']))\n"
        "print(sorted({'jax', 'flax', 'orbax'} & set(sys.modules)))"
    )
    finished_process = subprocess.run(
        [sys.executable, "-c", reading_script, str(tmp_path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    assert finished_process.stdout == "vtnet 2.0\n[]\n"


@pytest.mark.parametrize("parameter_name", [0, "a/b"])
def test_export_refuses_ambiguous_parameter_names(tmp_path, parameter_name):
    with pytest.raises(TypeError, match="string without '/'"):
        export_params(tmp_path, {"layers": {parameter_name: np.zeros(1)}}, SPEC)


@pytest.mark.parametrize(
    ("file_name", "file_content", "expected_message"),
    [
        ("policy.json", None, "exported policy"),
        ("params.safetensors", None, "exported policy"),
        ("policy.json", b"{", "policy.json: not JSON"),
        ("policy.json", b"[]", "policy.json: lacks"),
        ("policy.json", b'{"format_version": 9, "params_sha256": "", "spec": {}}', "version 9"),
        ("params.safetensors", b"", "params.safetensors: .*damaged"),
    ],
)
def test_load_params_refuses_broken_exports(tmp_path, file_name, file_content, expected_message):
    export_params(tmp_path, PARAMS, SPEC)
    (tmp_path / file_name).unlink()
    if file_content is not None:
        (tmp_path / file_name).write_bytes(file_content)
    with pytest.raises(InputError, match=expected_message):
        load_params(tmp_path)


def test_load_params_refuses_files_of_two_exports(tmp_path, monkeypatch):
    export_params(tmp_path, PARAMS, SPEC)
    (tmp_path / "params.safetensors").write_bytes(b"damaged")  # or it would not be replaced
    original_replace = os.replace

    def killed_at_policy(source_path, target_path):
        if Path(target_path).name == "policy.json":
            raise KeyboardInterrupt
        original_replace(source_path, target_path)

    monkeypatch.setattr(os, "replace", killed_at_policy)

    # The parameters are replaced, but not the file that holds their digest.
    with pytest.raises(KeyboardInterrupt):
        export_params(tmp_path, {"scale": np.float32(3)}, SPEC)
    with pytest.raises(InputError, match=r"params\.safetensors"):
        load_params(tmp_path)


def test_export_does_not_overwrite_another_format_version(tmp_path):
    export_params(tmp_path, PARAMS, SPEC)
    policy_file = tmp_path / "policy.json"
    policy_file.write_text(
        policy_file.read_text().replace(f'"format_version": {POLICY_FORMAT_VERSION}', '"format_version": 9')
    )
    content_before = policy_file.read_bytes()
    with pytest.raises(InputError, match=f"version 9.*version {POLICY_FORMAT_VERSION}"):
        export_params(tmp_path, PARAMS, SPEC)
    assert policy_file.read_bytes() == content_before
