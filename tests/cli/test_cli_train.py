"""The train command end to end, and all that it refuses."""

import csv
import dataclasses
import gzip
import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from support.commands import contents, evaluate, refusal, train
from support.tiny_run import NUM_SEEDS, POLICY_NAMES, finished_run

from jaxnav.cli import train as train_command
from jaxnav.layout import ESTIMATORS, EstimatorConfig
from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.store.export import load_params
from jaxnav.store.files import read_log_rows
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, layout_priors


@pytest.fixture(scope="module")
def config_file(tmp_path_factory):
    return finished_run(tmp_path_factory)[0]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return finished_run(tmp_path_factory)[1]


# Training


def test_train_writes_policies_and_metrics_of_all_arms_and_seeds(run_dir):
    assert {folder.name for folder in (run_dir / "policies").iterdir()} == set(POLICY_NAMES)
    assert {folder.name for folder in (run_dir / "checkpoints").iterdir()} == {"2", "4"}
    rows = read_log_rows(run_dir / "metrics.jsonl")
    identities = [(row["step"], row["arm"], row["seed"]) for row in rows]
    assert sorted(identities) == sorted(itertools.product((2, 4), ("baseline", "layout"), range(NUM_SEEDS)))
    for row in rows:
        assert row["distil_loss"] > 0
        assert all(math.isfinite(value) for value in row.values() if not isinstance(value, str))
        assert row["env_steps"] == row["step"] * 16 * 8
        assert row["episodes"] > 0
        assert row["skipped_steps"] == 0


def test_exported_policies_record_method_estimator_and_prior(run_dir):
    loaded = {name: load_params(run_dir / "policies" / name) for name in POLICY_NAMES}
    for name, (tensors, spec) in loaded.items():
        assert spec["method"] == "org"
        assert spec["categories"] == list(ITHOR_CATEGORIES)
        assert spec["sizes"]["hidden"] == 16
        if name.startswith("layout"):
            setting = EstimatorConfig(**spec["layout"])
            assert setting == dataclasses.replace(
                ESTIMATORS["calibrated"], strength=setting.strength, reduction=setting.reduction
            )
            assert setting.strength in STRENGTHS
            assert setting.reduction in REDUCTIONS
        else:
            assert spec["layout"] is None
        assert tensors["layout"]["counts"].shape == (5, 22, 22)
        assert spec["prior_steps"] == 64 * 20
        assert 0 < spec["prior_poses"] <= 64 * 21
        assert tensors["layout"]["prior"].shape == (5, 22, 22)
        assert all(np.isfinite(leaf).all() for leaf in tensors["policy"]["core"]["dense_i"].values())
    kernels = [tensors["policy"]["fuse"]["kernel"].tobytes() for tensors, _ in loaded.values()]
    assert len(set(kernels)) == 4


@pytest.mark.slow
def test_train_leaves_a_finished_run_directory_unchanged(run_dir, config_file, capsys):
    before = contents(run_dir)
    assert train(config_file, run_dir) == 0
    assert "resumed after update 4 of 4" in capsys.readouterr().err
    assert contents(run_dir) == before


# Refusals of training


def test_train_refuses_another_config_in_the_same_directory(run_dir, config_file, capsys):
    before = contents(run_dir)
    assert train(config_file, run_dir, "--seeds", 3, "--ppo.gamma", 0.5) == 2
    error = refusal(capsys)
    assert "holds another run (there != asked for): ppo.gamma: 0.99 != 0.5; seeds: 2 != 3;" in error
    assert contents(run_dir) == before


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("sede: 1", "unknown key sede; did you mean seed?"),
        ("ppo: {num_env: 4}", "unknown key ppo.num_env; did you mean ppo.num_envs?"),
        ("seeds: two", "seeds must be int, but is 'two' (str)"),
        ("ppo: {gamma: [1]}", "ppo.gamma must be float, but is [1] (list)"),
        ("counterfactual: maybe", "counterfactual must be one of 'none', 'coin', 'distil', but is 'maybe'"),
        ("decision: both", "decision must be one of 'fused', 'streams', but is 'both'"),
        ("ppo: {experience: 0}", "ppo.experience is 0.0; give a number between 0 and 1, both excluded"),
        ("ppo: {alone: 1.0}", "ppo.alone is 1.0; give a share from 0 to below 1"),
        ("ppo: {experience: 1.0}", "ppo.experience is 1.0; give a number between 0 and 1, both excluded"),
        ("{method: semexp, done_gate: true}", "done_gate is True; what method 'semexp' chooses are no actions"),
        ("{method: vtnet, imitation: 1}", "imitation is 1.0; give a share between 0 and 1, both excluded"),
        ("{method: vtnet, total_steps: 9}", "total_steps is 9; stage 2 of method 'vtnet', a share of 0.8, gets none"),
        ("imitation: 0.2", "imitation is 0.2; 'org' has no stages of both kinds; leave it out"),
        ("method: orgy", "method 'orgy': is unknown; did you mean 'org'?"),
        ("method: no_such_package:MINE", "method 'no_such_package:MINE': cannot be imported (ModuleNotFoundError: "),
        ("method: jaxnav.layout:MINE", "method 'jaxnav.layout:MINE': cannot be imported (AttributeError: "),
        ("method: jaxnav.layout:ESTIMATORS", "method 'jaxnav.layout:ESTIMATORS': is dict, no jaxnav Method"),
        ("{method: anonymous, arms: [layout]}", "method 'anonymous' cannot host the layout; give baseline alone"),
        ("method_sizes: {layers: 2}", "method_sizes.layers is 2; is unknown; 'org' has relation_layers"),
        ("{method: rgb, method_sizes: {layers: 2}}", "'rgb' has no sizes of its own"),
        ("method_sizes: {relation_layers: 0}", "method_sizes.relation_layers is 0; give at least 1"),
        ("method_sizes: {relation_layers: two}", "method_sizes must be a mapping of str to int"),
        ("sizes: {relation_layers: 2}", "unknown key sizes.relation_layers; it is method_sizes.relation_layers now"),
        ("seeds: 0", "seeds is 0; give at least 1"),
        ("sizes: {hidden: -8}", "sizes.hidden is -8; give at least 1"),
        ("worlds: {num_train: 0}", "worlds.num_train is 0; give at least 1"),
        (
            "ppo: {num_envs: 10, minibatches: 4}",
            "ppo.num_envs is 10; give a multiple of ppo.minibatches (4), such as 8 or 12",
        ),
        ("ppo: {rollout: 101}", "ppo.rollout is 101; give at most worlds.train_step_limit (100)"),
        ("ppo: {learning_rate: .inf}", "ppo.learning_rate is inf; give a positive number"),
        ("detector: {miss_far: 1.5}", "detector.miss_far is 1.5; give a probability"),
        ("seed: -1", "seed is -1; give a whole number from 0 to 2**32 - 1"),
        ("seed: 4294967296", "seed is 4294967296; give a whole number from 0"),
        ("worlds: {seed: -1}", "worlds.seed is -1; give a whole number from 0"),
        ("detector: {seed: -1}", "detector.seed is -1; give a whole number from 0"),
        ("worlds: {shift: 1.5}", "worlds.shift is 1.5; give a number from 0 to 1"),
        ("worlds: {shaping: .inf}", "worlds.shaping is inf; give 0 or more"),
        ("worlds: {near_starts: 1.5}", "worlds.near_starts is 1.5; give a probability from 0 to 1"),
        ("worlds: {categories: [Chair]}", "worlds.categories is ('Chair',); give at least 2"),
        (
            "worlds: {categories: [Chair, Sink, Chair]}",
            "worlds.categories is ('Chair', 'Sink', 'Chair'); give each once",
        ),
        ("worlds: {goals: [Chair, Unicorn]}", "worlds.goals is ['Unicorn']; give some of the categories AlarmClock,"),
        ("{world: houses, scenes: none.jsonl.gz}", "none.jsonl.gz: cannot be read"),
        (
            "{world: houses, worlds: {num_train: 9, shard_scenes: 8}, chunk: 1}",
            "chunk is 1; where scenes are streamed it",
        ),
        ("seeds: 1\nseeds: 2", "line 2: not valid YAML (seeds is given twice)"),
    ],
)
def test_train_refuses_bad_settings_before_writing(tmp_path, capsys, line, problem):
    file = tmp_path / "bad.yaml"
    file.write_text(line)
    assert train(file, tmp_path / "run", "--cache", tmp_path / "cache") == 2
    assert problem in refusal(capsys)
    assert not (tmp_path / "run").exists()


BROKEN = """
import jax.numpy as jnp
from jaxnav import Experience, Method

class Width(Experience):
    def __init__(self, spec, rngs):
        self.width = 3

    def encode(self, features, appearance, weights, reading):
        return jnp.zeros((*weights.shape[:-1], 4))

class Raising(Width):
    def encode(self, features, appearance, weights, reading):
        raise RuntimeError("first line\\nsecond line")

WIDTH, RAISING = Method(Width), Method(Raising)
"""


@pytest.mark.parametrize(("name", "reason"), [("WIDTH", "TypeError: "), ("RAISING", "RuntimeError: first line); mend")])
def test_train_refuses_methods_that_fail_check_method(tmp_path, monkeypatch, capsys, name, reason):
    (tmp_path / "broken_method.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(tmp_path)
    options = ["--method", f"broken_method:{name}", "--run-dir", str(tmp_path / "run")]
    assert train_command.main(options) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: method 'broken_method:{name}': fails check_method ({reason}")
    assert error.endswith("; mend it\n")
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


WHOLE = gzip.compress(b'{"name": "a"}\n' * 9, mtime=0)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (None, "cannot be read (No such file or directory)"),
        (b"not compressed", "line 1: not JSON"),
        (WHOLE[:-9], "is cut short or damaged"),
        (gzip.compress(b"{]\n", mtime=0), "line 1: not JSON"),
        (WHOLE, "line 1, scene 'a': world is missing; add it"),
        (gzip.compress(b"", mtime=0), "holds no scene"),
    ],
)
def test_train_names_bad_scene_files(tmp_path, capsys, data, problem):
    file = tmp_path / "scenes.jsonl.gz"
    if data is not None:
        file.write_bytes(data)
    assert train_command.main(["--run-dir", str(tmp_path / "new"), "--scenes", str(file)]) == 2
    error = refusal(capsys)
    assert str(file) in error
    assert problem in error
    assert not (tmp_path / "new").exists()


def test_train_refuses_directories_that_hold_no_run(tmp_path, config_file, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert train(config_file, file) == 2
    assert f"{file}: is a file; choose another --run-dir" in refusal(capsys)
    assert train(config_file, tmp_path) == 2
    assert f"{tmp_path}: is not empty and holds no run" in refusal(capsys)
    assert contents(tmp_path) == {"file": b"mine"}


def test_train_names_a_damaged_config_file(tmp_path, run_dir, config_file, capsys):
    text = (run_dir / "config.json").read_text()
    (tmp_path / "config.json").write_text(text[: len(text) // 2])
    assert train(config_file, tmp_path) == 2
    assert f"{tmp_path}/config.json" in refusal(capsys)


@pytest.mark.slow
def test_custom_categories_are_trained_resumed_and_evaluated(tmp_path, config_file, capsys):
    """Three categories, two of them goals, in a run that is then found finished and evaluated."""
    run_dir = tmp_path / "own"
    options = ("--seeds", 1, "--total-steps", 256, "--worlds.categories", "Chair", "Sink", "LightSwitch",
               "--worlds.goals", "Sink", "LightSwitch")  # fmt: skip
    assert train(config_file, run_dir, *options) == 0
    assert train(config_file, run_dir, *options) == 0
    assert "resumed after update 2 of 2" in capsys.readouterr().err
    task = load_params(run_dir / "policies" / "layout-0")[1]["task"]
    assert (task["categories"], task["goals"]) == (["Chair", "Sink", "LightSwitch"], ["Sink", "LightSwitch"])
    assert evaluate(run_dir, "--episodes", 8) == 0
    with (run_dir / "eval-val.episodes.csv").open() as file:
        assert {row["goal"] for row in csv.DictReader(file)} == {"Sink", "LightSwitch"}


def test_layout_priors_pool_rooms_without_training_scenes():
    counts = np.zeros((3, 2, 2), np.float32)
    counts[0], counts[2] = [[5, 3], [3, 4]], [[2, 1], [1, 2]]
    # By the letter of the paper the prior is the counts and one: 3 + 1, 3 + 1 + 1, 1 + 1.
    priors = layout_priors(jnp.asarray(counts), "paper")
    np.testing.assert_array_equal(priors[:, 0, 1], [4, 5, 2])
