"""Arguments that are no exported policy, run or agent are refused with one line that names them."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest
from support.mutations import resigned

import jaxnav
from jaxnav.errors import InputError
from jaxnav.policies.network import init_params
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.store.export import export_params, load_params


@pytest.fixture
def export_folder(drawn_run, tmp_path):
    """Copy of an exported policy of the drawn run."""
    return shutil.copytree(drawn_run.config.run_dir / POLICIES_DIR / "layout-0", tmp_path / "layout-0")


def refusal_of(folder):
    """Message of the refusal to load a policy, which must be one line that begins with the path."""
    with pytest.raises(InputError) as error:
        jaxnav.load_policy(folder)
    message = str(error.value)
    assert message.startswith(str(folder))
    assert "\n" not in message
    return message


def change_spec(export_folder, **changes):
    """Change settings in the spec of an exported policy, and return its folder."""
    with resigned(export_folder / "policy.json") as policy:
        policy["spec"] |= changes
    return export_folder


def test_load_policy_refuses_folders_without_an_export(tmp_path, drawn_run):
    for folder in (tmp_path, tmp_path / "none", drawn_run.config.run_dir, str(tmp_path)):
        assert "not an exported policy (No such file or directory: " in refusal_of(folder)


def test_load_policy_refuses_a_run_and_names_its_policies(drawn_run, tmp_path):
    run_dir = drawn_run.config.run_dir
    refusal = refusal_of(run_dir)
    policy_names = ("baseline-0", "baseline-1", "layout-0", "layout-1")
    policy_folders = ", ".join(str(run_dir / POLICIES_DIR / name) for name in policy_names)
    assert refusal.endswith(f" but a run; give one of its policies: {policy_folders}")

    # A run without exports has not finished.
    shutil.copy(run_dir / "config.json", tmp_path)
    assert refusal_of(tmp_path).endswith(" but a run; its training has not finished; resume it by jaxnav train")


def test_run_open_refuses_a_policy(drawn_run, export_folder):
    for policy in (export_folder, "rooms-org"):
        with pytest.raises(InputError, match=f"^{policy}: is an exported policy and holds no run; give the dir"):
            jaxnav.Run.open(policy)


@pytest.mark.parametrize("function", [jaxnav.sweep, jaxnav.load_policy, jaxnav.Run.open])
@pytest.mark.parametrize("argument", [None, 3, b"runs/rooms", ["runs/rooms"]])
def test_arguments_that_are_no_path_are_refused(function, argument):
    with pytest.raises(InputError, match=f"^{type(argument).__name__} is no path; give the directory of a run"):
        function(argument)


@pytest.mark.slow
@pytest.mark.parametrize("subject", [None, 3, b"runs/rooms", ["runs/rooms"]])
def test_subjects_that_are_no_agent_are_refused(subject):
    with pytest.raises(InputError, match="is no agent; give an object with init and act or with predict, a function"):
        jaxnav.evaluate(subject)


def test_train_refuses_an_argument_that_is_no_configuration():
    with pytest.raises(InputError, match=r"^str is no configuration; give a jaxnav\.RunConfig"):
        jaxnav.train("smoke")  # pyright: ignore[reportArgumentType]


def test_load_policy_refuses_damaged_exports(export_folder):
    # A changed bit in the parameters.
    params_file = export_folder / "params.safetensors"
    data = bytearray(params_file.read_bytes())
    data[-1] ^= 1
    params_file.write_bytes(data)
    assert "does not belong to policy.json or is damaged; export the policy again" in refusal_of(export_folder)

    # A record that is cut off, then missing.
    record_file = export_folder / "policy.json"
    record_file.write_text(record_file.read_text()[:-9])
    assert "not JSON" in refusal_of(export_folder)
    record_file.unlink()
    assert "not an exported policy" in refusal_of(export_folder)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"method": "no_such_package:MINE"}, "cannot be imported (ModuleNotFoundError: No module named "),
        ({"method": "jaxnav.layout:MINE"}, "cannot be imported (AttributeError: module 'jaxnav.layout' "),
        ({"method": "strange"}, "method 'strange': is unknown; choose one of anonymous, belief, eotp, hoz, org, "),
        ({"method": "sp"}, "the statistics of method 'sp' are missing; train the run again"),
        ({"sizes": {"depth": 3}}, "its spec does not fit this code (TypeError: "),
        ({"layout": {"rows": "some"}}, "its spec does not fit this code (ValueError: rows is 'some'"),
        ({"decision": "both"}, "its spec does not fit this code (ValueError: decision is 'both'; choose one of fused"),
        ({"method_sizes": None}, "its spec does not fit this code (AttributeError: "),
    ],
)
def test_load_policy_refuses_exports_of_other_code(export_folder, changes, problem):
    assert jaxnav.load_policy(export_folder).spec.method.name == "org"
    message = refusal_of(change_spec(export_folder, **changes))
    assert problem in message
    assert any(advice in message for advice in ("install or fix its package", "choose one of", "train the run again"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "learned_arrays", "problem"),
    [
        ("sp", {"links": np.eye(19, dtype=np.float32)}, "KeyError: 'mixing'"),
        ("sp", {"mixing": np.eye(18, dtype=np.float32)}, "TypeError: "),
        ("hoz", {"nodes": np.zeros((5, 8, 18), np.float32)}, "KeyError: '"),
        ("semexp", {"reach": np.zeros(3, np.int32)}, "KeyError: 'lines'"),
    ],
)
def test_load_policy_refuses_learned_arrays_that_do_not_fit_the_method(
    drawn_run, export_folder, tmp_path, method, learned_arrays, problem
):
    # Export a policy of the method with other learned arrays than its own.
    exported_arrays, spec = load_params(export_folder)
    config = dataclasses.replace(drawn_run.config, method=method)
    params = init_params(config.policy_spec(len(spec["categories"])), jax.random.key(0))
    arrays = exported_arrays | {"policy": params, "knowledge": learned_arrays}
    other_folder = tmp_path / "other"
    export_params(other_folder, arrays, spec | {"method": method})

    message = refusal_of(other_folder)
    assert f"the statistics of method {method!r} do not fit the method ({problem}" in message
    assert message.endswith("; train the run again")


def test_load_policy_lists_packaged_policies_for_an_unknown_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = r"^room-org: not an exported .*; .*, or load one of the package: apartments-belief, .*, rooms-org$"
    with pytest.raises(InputError, match=message):
        jaxnav.load_policy("room-org")
    assert jaxnav.load_policy("rooms-org").spec.method.name == "org"
