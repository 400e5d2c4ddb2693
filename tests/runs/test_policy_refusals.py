"""What is no exported policy is refused in one line that names it."""

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
def export(drawn_run, tmp_path):
    return shutil.copytree(drawn_run.config.run_dir / POLICIES_DIR / "layout-0", tmp_path / "layout-0")


def refusal_of(folder):
    """The message of the refusal, one line that begins with the path."""
    with pytest.raises(InputError) as error:
        jaxnav.load_policy(folder)
    message = str(error.value)
    assert message.startswith(str(folder))
    assert "\n" not in message
    return message


def change_spec(export, **changes):
    """The export with something changed in its spec."""
    with resigned(export / "policy.json") as policy:
        policy["spec"] |= changes
    return export


def test_load_policy_refuses_folders_without_an_export(tmp_path, drawn_run):
    for folder in (tmp_path, tmp_path / "none", drawn_run.config.run_dir, str(tmp_path)):
        assert "not an exported policy (No such file or directory: " in refusal_of(folder)


def test_a_run_is_no_policy_and_its_policies_are_named(drawn_run, tmp_path):
    run_dir = drawn_run.config.run_dir
    refusal = refusal_of(run_dir)
    policy_names = ("baseline-0", "baseline-1", "layout-0", "layout-1")
    policy_folders = ", ".join(str(run_dir / POLICIES_DIR / name) for name in policy_names)
    assert refusal.endswith(f" but a run; give one of its policies: {policy_folders}")

    shutil.copy(run_dir / "config.json", tmp_path)
    assert refusal_of(tmp_path).endswith(" but a run; its training has not finished; resume it by jaxnav train")


def test_a_policy_is_no_run(drawn_run, export):
    for policy in (export, "rooms-org"):
        with pytest.raises(InputError, match=f"^{policy}: is an exported policy and holds no run; give the dir"):
            jaxnav.Run.open(policy)


@pytest.mark.parametrize("function", [jaxnav.sweep, jaxnav.load_policy, jaxnav.Run.open])
@pytest.mark.parametrize("argument", [None, 3, b"runs/rooms", ["runs/rooms"]])
def test_arguments_that_are_no_path_are_named(function, argument):
    with pytest.raises(InputError, match=f"^{type(argument).__name__} is no path; give the directory of a run"):
        function(argument)


@pytest.mark.slow
@pytest.mark.parametrize("subject", [None, 3, b"runs/rooms", ["runs/rooms"]])
def test_subjects_that_are_no_agent_are_named(subject):
    with pytest.raises(InputError, match="is no agent; give an object with init and act or with predict, a function"):
        jaxnav.evaluate(subject)


def test_training_takes_a_configuration():
    with pytest.raises(InputError, match=r"^str is no configuration; give a jaxnav\.RunConfig"):
        jaxnav.train("smoke")  # pyright: ignore[reportArgumentType]


def test_load_policy_refuses_damaged_exports(export):
    data = bytearray((export / "params.safetensors").read_bytes())
    data[-1] ^= 1
    (export / "params.safetensors").write_bytes(data)
    assert "does not belong to policy.json or is damaged; export the policy again" in refusal_of(export)
    (export / "policy.json").write_text((export / "policy.json").read_text()[:-9])
    assert "not JSON" in refusal_of(export)
    (export / "policy.json").unlink()
    assert "not an exported policy" in refusal_of(export)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"method": "no_such_package:MINE"},
            "cannot be imported (ModuleNotFoundError: No module named ",
        ),
        ({"method": "jaxnav.layout:MINE"}, "cannot be imported (AttributeError: module 'jaxnav.layout' "),
        ({"method": "strange"}, "method 'strange': is unknown; choose one of anonymous, belief, eotp, hoz, org, "),
        ({"method": "sp"}, "the statistics of method 'sp' are missing; train the run again"),
        ({"sizes": {"depth": 3}}, "its spec does not fit this code (TypeError: "),
        ({"layout": {"rows": "some"}}, "its spec does not fit this code (ValueError: rows is 'some'"),
        ({"decision": "both"}, "its spec does not fit this code (ValueError: decision is 'both'; choose one of fused"),
        ({"method_sizes": None}, "its spec does not fit this code (AttributeError: "),
    ],
)
def test_load_policy_refuses_exports_of_other_code(export, changes, problem):
    assert jaxnav.load_policy(export).spec.method.name == "org"
    message = refusal_of(change_spec(export, **changes))
    assert problem in message
    assert any(advice in message for advice in ("install or fix its package", "choose one of", "train the run again"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "learned", "problem"),
    [
        ("sp", {"links": np.eye(19, dtype=np.float32)}, "KeyError: 'mixing'"),
        ("sp", {"mixing": np.eye(18, dtype=np.float32)}, "TypeError: "),
        ("hoz", {"nodes": np.zeros((5, 8, 18), np.float32)}, "KeyError: '"),
        ("semexp", {"reach": np.zeros(3, np.int32)}, "KeyError: 'lines'"),
    ],
)
def test_load_policy_refuses_learned_arrays_that_do_not_fit_the_method(
    drawn_run, export, tmp_path, method, learned, problem
):
    exported_params, spec = load_params(export)
    config = dataclasses.replace(drawn_run.config, method=method)
    policy = init_params(config.policy_spec(len(spec["categories"])), jax.random.key(0))
    folder = tmp_path / "other"
    export_params(folder, exported_params | {"policy": policy, "knowledge": learned}, spec | {"method": method})
    message = refusal_of(folder)
    assert f"the statistics of method {method!r} do not fit the method ({problem}" in message
    assert message.endswith("; train the run again")


def test_load_policy_lists_packaged_policies_for_an_unknown_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        InputError,
        match=r"^room-org: not an exported .*; .*, or load one of the package: apartments-belief, .*, rooms-org$",
    ):
        jaxnav.load_policy("room-org")
    assert jaxnav.load_policy("rooms-org").spec.method.name == "org"
