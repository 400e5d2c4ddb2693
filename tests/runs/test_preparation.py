"""Knowledge from before training is learned once per run, and read from the run directory afterwards."""

import dataclasses
import io
from typing import Any

import chex
import jax.numpy as jnp
import numpy as np
import pytest
from support.tiny_run import DRAWN_ESTIMATOR

import jaxnav.runs.train as training
from jaxnav.errors import InputError
from jaxnav.gaps import CooccurrenceEvidence
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.method import Knowledge
from jaxnav.runs.preparation import Preparation, has_preparation, load_preparation, save_preparation
from jaxnav.store.files import make_manifest
from jaxnav.training.calibration import Exploration

MANIFEST = make_manifest({"seed": 0, "scenes_fingerprint": "a"})
MATRICES = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3, 3)), jnp.float32)
KNOWLEDGE = Knowledge(
    MATRICES, {"graph": {"edges": jnp.arange(3)}}, CooccurrenceEvidence(MATRICES + 1, MATRICES + 2, MATRICES[:, None])
)
PREPARATION = Preparation(
    Exploration(MATRICES, MATRICES * 2, jnp.int32(640), jnp.int32(99)), DRAWN_ESTIMATOR, KNOWLEDGE
)
#: Training scenes, which neither test of `prepare_training` reads.
NO_WORLD: Any = None


def test_a_preparation_is_read_back_bit_for_bit(tmp_path):
    assert not has_preparation(tmp_path)
    save_preparation(tmp_path, PREPARATION, MANIFEST)
    assert has_preparation(tmp_path)
    loaded = load_preparation(tmp_path, MANIFEST)
    assert loaded is not None
    assert loaded.estimator_config == PREPARATION.estimator_config
    chex.assert_trees_all_equal(loaded.knowledge, PREPARATION.knowledge, strict=True)
    chex.assert_trees_all_equal(loaded.exploration, PREPARATION.exploration, strict=True)


def test_a_baseline_has_no_evidence(tmp_path):
    baseline = PREPARATION._replace(knowledge=Knowledge(MATRICES))
    save_preparation(tmp_path, baseline, MANIFEST)
    loaded = load_preparation(tmp_path, MANIFEST)
    assert loaded is not None
    assert loaded.knowledge.cooccurrence is None


def test_a_preparation_of_other_scenes_is_refused(tmp_path):
    save_preparation(tmp_path, PREPARATION, MANIFEST)
    with pytest.raises(InputError, match="scenes_fingerprint: 'a' != 'b'"):
        load_preparation(tmp_path, make_manifest({"seed": 0, "scenes_fingerprint": "b"}))


@pytest.mark.parametrize("file_name", ["params.safetensors", "policy.json"])
def test_training_learns_a_damaged_preparation_again(tmp_path, config, monkeypatch, file_name):
    save_preparation(tmp_path, PREPARATION, MANIFEST)
    damaged_file = tmp_path / "knowledge" / file_name
    intact_content = damaged_file.read_bytes()
    damaged_file.write_bytes(intact_content[:-9] + b"123456789")

    for name, result in (
        ("explore_world", PREPARATION.exploration),
        ("calibrate_estimator", PREPARATION.estimator_config),
        ("learn_knowledge", KNOWLEDGE),
    ):
        monkeypatch.setattr(training, name, lambda *_, result=result: result)
    output = io.StringIO()
    run_config = dataclasses.replace(config, run_dir=tmp_path)
    training.prepare_training(run_config, NO_WORLD, MANIFEST, PlainConsole(file=output, width=500))
    assert f"{tmp_path / 'knowledge'}: is damaged, so it is learned again" in output.getvalue()
    assert damaged_file.read_bytes() == intact_content


def test_training_reads_a_preparation_instead_of_learning_it(tmp_path, config, monkeypatch):
    save_preparation(tmp_path, PREPARATION, MANIFEST)

    def refuse_to_learn(*_):
        raise AssertionError("the run has learned this already")

    for name in ("explore_world", "calibrate_estimator", "learn_knowledge"):
        monkeypatch.setattr(training, name, refuse_to_learn)
    run_config = dataclasses.replace(config, run_dir=tmp_path)
    preparation = training.prepare_training(run_config, NO_WORLD, MANIFEST, PlainConsole(quiet=True))
    chex.assert_trees_all_equal(preparation.knowledge, KNOWLEDGE, strict=True)
