"""Files of earlier versions are read, or refused with the version that wrote them, and never changed.

`tests/data` contains two old runs. The run of version 0.1.0 consists of the files that are refused: settings, log, and
a policy without its arrays. The run of 0.2.0 has an evaluation: two chunks of a tiny policy of ORG, as `train.py` of
this version left them.
"""

import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.commands import contents, evaluate, refusal, train
from support.mutations import resigned
from support.tiers import params_by_tier
from support.tiny_run import DRAWN_ESTIMATOR, tiny_config, write_config
from support.tiny_world import random_params

import jaxnav
from jaxnav.cli import log as log_command
from jaxnav.env.objectnav import NUM_PRIORS, Observation
from jaxnav.errors import InputError
from jaxnav.policies.method import Knowledge
from jaxnav.policies.spec import WeightKind
from jaxnav.runs.config import LayoutConfig
from jaxnav.runs.policies import PACKAGED_POLICIES, export_policy
from jaxnav.runs.run import load_run_config
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.store import checkpoint
from jaxnav.store.files import make_manifest, read_log_rows
from jaxnav.training.calibration import Exploration, layout_priors

DATA = Path(__file__).parents[1] / "data"
REFUSED_RELATIONS = (
    "was trained before jaxnav 0.4, which corrected the relations of org; train it again, or use it with jaxnav 0.3"
)
REFUSED_VERSION = "written by jaxnav 0.1; train again, or read it with jaxnav 0.1"


def extract_run(version: str, folder: Path) -> Path:
    """Extract the run of a version into a folder."""
    with tarfile.open(DATA / f"run_of_version_{version}.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture
def run_of_0_1(tmp_path) -> Path:
    """The run of version 0.1.0."""
    return extract_run("0_1", tmp_path / "old")


@pytest.fixture
def run_of_0_2(tmp_path) -> Path:
    """The run of version 0.2.0."""
    return extract_run("0_2", tmp_path / "old")


# Version 0.1


@pytest.mark.parametrize(
    "command",
    [
        lambda run_dir, config_file: train(config_file, run_dir),
        lambda run_dir, config_file: evaluate(run_dir),
        lambda run_dir, config_file: log_command.main([str(run_dir), "--to", "tensorboard"]),
    ],
)
def test_commands_refuse_a_run_of_0_1_and_leave_it_unchanged(run_of_0_1, tmp_path, capsys, command):
    old_files = contents(run_of_0_1)
    assert command(run_of_0_1, write_config(tmp_path)) == 2
    message = refusal(capsys)
    assert message.startswith(f"error: {run_of_0_1}/config.json: has no digest")
    assert message.endswith(REFUSED_VERSION)
    assert contents(run_of_0_1) == old_files


def test_eval_refuses_a_report_of_0_1(run_of_0_2, tmp_path, capsys):
    report = json.loads((run_of_0_2 / "eval-val.json").read_text())
    del report["notes"]
    report_file = tmp_path / "report.json"
    report_file.write_text(json.dumps(report))
    assert evaluate(report_file) == 2
    assert refusal(capsys) == f"error: {report_file}: {REFUSED_VERSION}"


def test_load_policy_refuses_a_policy_of_0_1(run_of_0_1):
    folder = run_of_0_1 / "policies" / "layout-0"
    with pytest.raises(InputError) as error:
        jaxnav.load_policy(folder)
    assert str(error.value) == f"{folder}/policy.json: {REFUSED_VERSION}"


def test_read_log_rows_refuses_a_log_of_0_1(run_of_0_1):
    log_file = run_of_0_1 / "metrics.jsonl"
    with pytest.raises(InputError) as error:
        read_log_rows(log_file)
    assert str(error.value).startswith(f"{log_file}, line 1: has no digest")
    assert str(error.value).endswith(REFUSED_VERSION)


@pytest.mark.slow
def test_restore_refuses_a_checkpoint_of_0_1(tmp_path, monkeypatch):
    """The metadata of these checkpoints has no digest."""
    manifest = make_manifest({})
    state = {"step": jnp.int32(1)}

    # Save as version 0.1, which did not read its first checkpoint back, either.
    with monkeypatch.context() as version_0_1:
        version_0_1.setattr(checkpoint, "add_digest", lambda metadata: metadata)
        version_0_1.setattr(checkpoint, "_load_step", lambda *_: None)
        checkpoint.save_checkpoint(tmp_path, 1, state, manifest)

    with pytest.raises(InputError, match=r"checkpoints/1: has no digest.*" + REFUSED_VERSION):
        checkpoint.restore_checkpoint(tmp_path, jax.eval_shape(lambda: state), manifest)


# Version 0.2


def test_settings_logs_and_reports_of_0_2_are_read(run_of_0_2, capsys):
    config = load_run_config(run_of_0_2)
    assert (config.method, config.direct, config.layout.weights, config.ppo.guidance) == ("org", "all", "raw", 0.0)
    rows = read_log_rows(run_of_0_2 / "metrics.jsonl")
    assert [row["step"] for row in rows if row["arm"] == "layout"] == [2, 4]
    assert evaluate(run_of_0_2 / "eval-val.json", "--format", "markdown") == 0
    assert "| + w (layout) |" in capsys.readouterr().out


def test_eval_refuses_a_run_of_0_2_with_former_relations_and_leaves_it_unchanged(run_of_0_2, capsys):
    old_files = contents(run_of_0_2)
    assert evaluate(run_of_0_2) == 2
    assert refusal(capsys) == f"error: {run_of_0_2}/policies/baseline-0: {REFUSED_RELATIONS}"
    assert contents(run_of_0_2) == old_files


@pytest.mark.slow
def test_train_refuses_a_checkpoint_of_0_2_by_its_version(run_of_0_2, tmp_path, capsys):
    old_files = contents(run_of_0_2)
    settings_of_0_2 = ("--direct", "all", "--layout.weights", "raw")
    assert train(write_config(tmp_path, num_seeds=1), run_of_0_2, *settings_of_0_2) == 2
    assert "has format version 1, this code reads version 3; use the jaxnav that wrote it (0.2.0)" in refusal(capsys)

    # The command may add files, but changes none.
    new_files = contents(run_of_0_2)
    assert {name: new_files[name] for name in old_files} == old_files


# Policies of version 0.3


def remove_new_fields(policy_file: Path, **changes: Any) -> None:
    """Turn the description of an export into one of version 0.3, which lacks the fields of later versions."""
    with resigned(policy_file) as policy:
        spec = policy["spec"]
        for name in ("weight_kind", "experience_dropout", "counterfactual_memory"):
            del spec[name]
        del spec["task"]["instance_counts"]
        if spec["layout"] is not None:
            del spec["layout"]["counts"]
        spec |= changes


def test_load_policy_refuses_a_policy_of_0_2_with_former_relations(run_of_0_2):
    folder = run_of_0_2 / "policies" / "layout-0"
    with pytest.raises(InputError) as error:
        jaxnav.load_policy(folder)
    assert str(error.value) == f"{folder}: {REFUSED_RELATIONS}"


@pytest.mark.parametrize("method", ["org", "hoz", "tpn", "support.methods:STEPWISE"])
def test_load_policy_refuses_former_relations_of_every_method(tmp_path, method):
    """The packaged policy can be loaded, but not with the description that version 0.3 would have written."""
    folder = shutil.copytree(PACKAGED_POLICIES / "rooms-org", tmp_path / "policy")
    assert jaxnav.load_policy(folder).spec.method.name == "org"
    remove_new_fields(folder / "policy.json", method=method)
    with pytest.raises(InputError) as error:
        jaxnav.load_policy(folder)
    assert str(error.value) == f"{folder}: {REFUSED_RELATIONS}"


def export_tiny_policy(folder: Path, method: str, weight_kind: WeightKind) -> Path:
    """Export a random policy whose direct pathway sees all categories, with statistics if its method learns some."""
    layout = LayoutConfig(weights=weight_kind)
    config = tiny_config(folder, method=method, method_sizes={}, direct="all", layout=layout)
    num_categories = len(config.task.categories)
    spec = config.policy_spec(num_categories)

    # Made-up statistics, with the shapes of those that a training learns.
    counts = jnp.ones((NUM_PRIORS, num_categories, num_categories))
    statistics = {"mixing": jnp.eye(num_categories)} if spec.method.learn is not None else {}
    knowledge = Knowledge(layout_priors(counts, DRAWN_ESTIMATOR), statistics)
    exploration = Exploration(counts, counts, jnp.int32(1280), jnp.int32(600))
    export_policy(folder / "policy", config, random_params(0, spec), knowledge, DRAWN_ESTIMATOR, exploration)
    return folder / "policy"


def decide_once(policy: jaxnav.LoadedPolicy) -> jax.Array:
    """Logits float32 [A] for a random observation row with detections of many categories."""
    num_bytes = RowFormat(policy.spec.num_categories).num_bytes
    row = jax.random.randint(jax.random.key(0), (num_bytes,), 0, 256).astype(jnp.uint8)
    observation = Observation(row, goal=jnp.int32(1))
    return policy.decide(observation, policy.init("kitchen"), heading=0, moved=False, horizon=0).logits


@pytest.mark.parametrize("method", params_by_tier(["rgb", "anonymous", "sp"], slow=["rgb"]))
def test_policies_of_0_3_of_other_methods_keep_their_meaning(tmp_path, method):
    folder = export_tiny_policy(tmp_path / "raw", method, "raw")
    new_policy = jaxnav.load_policy(folder)
    remove_new_fields(folder / "policy.json")
    old_policy = jaxnav.load_policy(folder)
    assert old_policy.spec == new_policy.spec
    assert (old_policy.spec.weight_kind, old_policy.spec.direct) == ("raw", "all")
    np.testing.assert_array_equal(decide_once(old_policy), decide_once(new_policy))

    # Control: where a method has experience, another kind of weights decides otherwise.
    if method == "sp":
        relative_policy = jaxnav.load_policy(export_tiny_policy(tmp_path / "relative", method, "relative"))
        assert (decide_once(old_policy) != decide_once(relative_policy)).any()
