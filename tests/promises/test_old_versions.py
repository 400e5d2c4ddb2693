"""What version 0.2 wrote is read, or refused by name; what 0.1 wrote is refused; both are left as they are.

`tests/data` holds what is refused of a run of version 0.1.0 (settings, log, a policy without its arrays), and a run of
0.2.0 with an evaluation: two chunks of a tiny policy, as `train.py` of that version left them.
"""

import json
import tarfile
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support.commands import contents, evaluate, refusal, train
from support.tiny_run import write_config

import jaxnav
from jaxnav.cli import log as log_command
from jaxnav.errors import InputError
from jaxnav.store import checkpoint
from jaxnav.store.files import make_manifest, read_log_rows

DATA = Path(__file__).parents[1] / "data"
REFUSED = "written by jaxnav 0.1; train again, or read it with jaxnav 0.1"


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
        lambda run, file: train(file, run),
        lambda run, file: evaluate(run),
        lambda run, file: log_command.main([str(run), "--to", "tensorboard"]),
    ],
)
def test_commands_refuse_a_run_of_0_1_and_leave_it_unchanged(run_of_0_1, tmp_path, capsys, command):
    before = contents(run_of_0_1)
    assert command(run_of_0_1, write_config(tmp_path)) == 2
    message = refusal(capsys)
    assert message.startswith(f"error: {run_of_0_1}/config.json: has no digest")
    assert message.endswith(REFUSED)
    assert contents(run_of_0_1) == before


def test_eval_refuses_a_report_of_0_1(run_of_0_2, tmp_path, capsys):
    report = json.loads((run_of_0_2 / "eval-val.json").read_text())
    del report["notes"]
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report))
    assert evaluate(path) == 2
    assert refusal(capsys) == f"error: {path}: {REFUSED}"


def test_load_policy_refuses_a_policy_of_0_1(run_of_0_1):
    folder = run_of_0_1 / "policies" / "layout-0"
    with pytest.raises(InputError) as refused:
        jaxnav.load_policy(folder)
    assert str(refused.value) == f"{folder}/policy.json: {REFUSED}"


def test_read_log_rows_refuses_a_log_of_0_1(run_of_0_1):
    path = run_of_0_1 / "metrics.jsonl"
    with pytest.raises(InputError) as refused:
        read_log_rows(path)
    assert str(refused.value).startswith(f"{path}, line 1: has no digest")
    assert str(refused.value).endswith(REFUSED)


def test_restore_refuses_a_checkpoint_of_0_1(tmp_path, monkeypatch):
    """Their metadata has no digest."""
    manifest = make_manifest({})
    state = {"step": jnp.int32(1)}
    monkeypatch.setattr(checkpoint, "add_digest", lambda metadata: metadata)
    checkpoint.save_checkpoint(tmp_path, 1, state, manifest)
    with pytest.raises(InputError, match=r"checkpoints/1: has no digest.*" + REFUSED):
        checkpoint.restore_checkpoint(tmp_path, jax.eval_shape(lambda: state), manifest)


# Version 0.2


def test_run_of_0_2_is_evaluated_as_by_that_version(run_of_0_2, tmp_path):
    before = json.loads((run_of_0_2 / "eval-val.json").read_text())
    assert evaluate(run_of_0_2, "--episodes", 24, "--json", tmp_path / "new.json") == 0
    after = json.loads((tmp_path / "new.json").read_text())
    assert after.keys() == before.keys()
    assert [(row["variant"], row["decoding"]) for row in after["rows"]] == [
        (row["variant"], row["decoding"]) for row in before["rows"]
    ]
    # Another processor rounds otherwise, which may change single episodes of 24.
    for row_before, row_after in zip(before["rows"], after["rows"], strict=True):
        assert row_after["sr"]["mean"] == pytest.approx(row_before["sr"]["mean"], abs=100 * 3 / 24)


def test_policies_logs_and_reports_of_0_2_are_read(run_of_0_2, capsys):
    assert jaxnav.load_policy(run_of_0_2 / "policies" / "layout-0").spec.method.name == "org"
    assert [row["step"] for row in read_log_rows(run_of_0_2 / "metrics.jsonl") if row["arm"] == "layout"] == [2, 4]
    assert evaluate(run_of_0_2 / "eval-val.json", "--format", "markdown") == 0
    assert "| + w (layout) |" in capsys.readouterr().out


def test_train_refuses_a_checkpoint_of_0_2_by_its_version(run_of_0_2, tmp_path, capsys):
    before = contents(run_of_0_2)
    assert train(write_config(tmp_path, num_seeds=1), run_of_0_2) == 2
    assert "has format version 1, this code reads version 2; use the jaxnav that wrote it (0.2.0)" in refusal(capsys)
    after = contents(run_of_0_2)
    assert {name: after[name] for name in before} == before
