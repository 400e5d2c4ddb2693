"""What earlier versions wrote is read, or refused by name and left as it is.

`tests/data` holds a run of version 0.1.0: two chunks of a tiny policy, its checkpoint and its exports, as `train.py` of
that version left them.
"""

import json
import tarfile
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support.commands import contents, evaluate, refusal, train, write_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.store import checkpoint
from jaxnav.store.export import FORMAT_VERSION
from jaxnav.store.manifest import make_manifest
from jaxnav.store.runlog import read_rows

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture
def old(tmp_path) -> Path:
    """The run of version 0.1.0."""
    with tarfile.open(DATA / "run_of_version_0_1.tar.xz") as archive:
        archive.extractall(tmp_path / "old", filter="data")
    return tmp_path / "old"


def test_its_policies_are_refused_by_their_version(old):
    folder = old / "policies" / "layout-0"
    message = rf"policy\.json: has format version 2, this code reads version {FORMAT_VERSION}; export the policy again"
    with pytest.raises(InputError, match=message):
        jaxnav.load_policy(folder)
    # It is the version that is refused: called by the present one, it fails by what the old one did not write.
    told = json.loads((folder / "policy.json").read_text())
    (folder / "policy.json").write_text(json.dumps(told | {"format_version": FORMAT_VERSION}))
    with pytest.raises(InputError, match="layout-0") as refused:
        jaxnav.load_policy(folder)
    assert "format version" not in str(refused.value)


@pytest.mark.parametrize("manifest", [False, True])
def test_its_checkpoint_is_refused_by_settings_or_arrays(old, manifest):
    """Asked for with other settings, or with its own and another state."""
    config = json.loads((old / "config.json").read_text()) if manifest else {"method": "org"}
    abstract = jax.eval_shape(lambda: {"params": jnp.zeros(3)})
    with pytest.raises(InputError, match=r"checkpoints/2") as refused:
        checkpoint.restore(old, abstract, make_manifest(config))
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("command", [lambda run, file: train(file, run), lambda run, file: evaluate(run)])
def test_commands_refuse_the_run_and_leave_it_as_it_is(old, tmp_path, capsys, command):
    before = contents(old)
    assert command(old, write_config(tmp_path)) == 2
    assert f"{old}/config.json: " in refusal(capsys)
    kept = contents(old)
    assert {name: kept[name] for name in before} == before


def test_its_log_and_its_intervals_are_read(old):
    rows = read_rows(old / "metrics.jsonl")
    assert [row["step"] for row in rows if row["arm"] == "layout"] == [1, 2]
    interval = Interval.from_json({"mean": 1.0, "ci95": [0.5, 1.5]})
    assert (interval.mean, interval.low, interval.high, interval.seeds) == (1.0, 0.5, 1.5, ())
