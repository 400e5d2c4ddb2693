"""What earlier versions wrote is read, or refused by name and left as it is.

`tests/data` holds a run of version 0.1.0 and one of 0.2.0: two chunks of a tiny policy, its checkpoint and its exports,
as `train.py` of that version left them; that of 0.2.0 with an evaluation.
"""

import json
import tarfile
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support.commands import CONFIG, contents, evaluate, refusal, train, write_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.store import checkpoint
from jaxnav.store.export import POLICY_FORMAT_VERSION
from jaxnav.store.files import make_manifest, read_log_rows

DATA = Path(__file__).parents[1] / "data"


def extract_run(version: str, folder: Path) -> Path:
    """Extract the run of a version into a folder."""
    with tarfile.open(DATA / f"run_of_version_{version}.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture
def old(tmp_path) -> Path:
    """The run of version 0.1.0."""
    return extract_run("0_1", tmp_path / "old")


@pytest.fixture
def run_of_0_2(tmp_path) -> Path:
    """The run of version 0.2.0."""
    return extract_run("0_2", tmp_path / "old")


def test_its_policies_are_refused_by_their_version(old):
    folder = old / "policies" / "layout-0"
    message = (
        rf"policy\.json: has format version 2, this code reads version {POLICY_FORMAT_VERSION}; export the policy again"
    )
    with pytest.raises(InputError, match=message):
        jaxnav.load_policy(folder)
    # It is the version that is refused: called by the present one, it fails by what the old one did not write.
    policy = json.loads((folder / "policy.json").read_text())
    (folder / "policy.json").write_text(json.dumps(policy | {"format_version": POLICY_FORMAT_VERSION}))
    with pytest.raises(InputError, match="layout-0") as refused:
        jaxnav.load_policy(folder)
    assert "format version" not in str(refused.value)


@pytest.mark.parametrize("manifest", [False, True])
def test_its_checkpoint_is_refused_by_settings_or_arrays(old, manifest):
    """Asked for with other settings, or with its own and another state."""
    config = json.loads((old / "config.json").read_text()) if manifest else {"method": "org"}
    abstract = jax.eval_shape(lambda: {"params": jnp.zeros(3)})
    with pytest.raises(InputError, match=r"checkpoints/2") as refused:
        checkpoint.restore_checkpoint(old, abstract, make_manifest(config))
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("command", [lambda run, file: train(file, run), lambda run, file: evaluate(run)])
def test_commands_refuse_the_run_and_leave_it_as_it_is(old, tmp_path, capsys, command):
    before = contents(old)
    assert command(old, write_config(tmp_path)) == 2
    assert f"{old}/config.json: " in refusal(capsys)
    files = contents(old)
    assert {name: files[name] for name in before} == before


def test_its_log_and_its_intervals_are_read(old):
    rows = read_log_rows(old / "metrics.jsonl")
    assert [row["step"] for row in rows if row["arm"] == "layout"] == [1, 2]
    interval = Interval.from_json({"mean": 1.0, "ci95": [0.5, 1.5]})
    assert (interval.mean, interval.low, interval.high, interval.seeds) == (1.0, 0.5, 1.5, ())


def test_a_run_of_0_2_is_evaluated_as_by_that_version(run_of_0_2, tmp_path):
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


def test_policies_and_logs_of_0_2_are_read(run_of_0_2):
    assert jaxnav.load_policy(run_of_0_2 / "policies" / "layout-0").spec.method.name == "org"
    assert [row["step"] for row in read_log_rows(run_of_0_2 / "metrics.jsonl") if row["arm"] == "layout"] == [2, 4]


def test_a_checkpoint_of_0_2_is_refused_by_its_version(run_of_0_2, tmp_path, capsys):
    before = contents(run_of_0_2)
    config = tmp_path / "tiny.yaml"
    config.write_text(CONFIG.replace("seeds: 2", "seeds: 1"))
    assert train(config, run_of_0_2) == 2
    assert "has format version 1, this code reads version 2; use the jaxnav that wrote it (0.2.0)" in refusal(capsys)
    after = contents(run_of_0_2)
    assert {name: after[name] for name in before} == before
