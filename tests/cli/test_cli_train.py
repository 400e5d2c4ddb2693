"""The train command end to end, and its refusals."""

import csv
import dataclasses
import gzip
import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from support.commands import contents, evaluate, refusal, train
from support.refusals import assert_message_names
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
    log_rows = read_log_rows(run_dir / "metrics.jsonl")
    row_keys = [(row["step"], row["arm"], row["seed"]) for row in log_rows]
    assert sorted(row_keys) == sorted(itertools.product((2, 4), ("baseline", "layout"), range(NUM_SEEDS)))
    for row in log_rows:
        assert row["distil_loss"] > 0
        assert all(math.isfinite(value) for value in row.values() if not isinstance(value, str))
        assert row["env_steps"] == row["step"] * 16 * 8
        assert row["episodes"] > 0
        assert row["skipped_steps"] == 0


def test_exported_policies_record_method_estimator_and_prior(run_dir):
    fuse_kernels = set()
    for policy_name in POLICY_NAMES:
        params, spec = load_params(run_dir / "policies" / policy_name)

        # The method, its categories and sizes.
        assert spec["method"] == "org"
        assert spec["categories"] == list(ITHOR_CATEGORIES)
        assert spec["sizes"]["hidden"] == 16

        # The estimator: calibration chooses strength and reduction.
        if policy_name.startswith("layout"):
            estimator_config = EstimatorConfig(**spec["layout"])
            strength = estimator_config.strength
            reduction = estimator_config.reduction
            assert strength in STRENGTHS
            assert reduction in REDUCTIONS
            calibrated = dataclasses.replace(ESTIMATORS["calibrated"], strength=strength, reduction=reduction)
            assert estimator_config == calibrated
        else:
            assert spec["layout"] is None

        # The prior, [room types, K, K], and the exploration behind it.
        assert params["layout"]["counts"].shape == (5, 22, 22)
        assert params["layout"]["prior"].shape == (5, 22, 22)
        assert spec["prior_steps"] == 64 * 20
        assert 0 < spec["prior_poses"] <= 64 * 21

        assert all(np.isfinite(leaf).all() for leaf in params["policy"]["core"]["dense_i"].values())
        fuse_kernels.add(params["policy"]["fuse"]["kernel"].tobytes())
    assert len(fuse_kernels) == 4


@pytest.mark.slow
def test_train_leaves_a_finished_run_directory_unchanged(run_dir, config_file, capsys):
    files_before = contents(run_dir)
    assert train(config_file, run_dir) == 0
    assert "resumed after update 4 of 4" in capsys.readouterr().err
    assert contents(run_dir) == files_before


# Refusals of training


def test_train_refuses_another_config_in_the_same_directory(run_dir, config_file, capsys):
    files_before = contents(run_dir)
    assert train(config_file, run_dir, "--seeds", 3, "--ppo.gamma", 0.5) == 2
    assert_message_names(refusal(capsys), "holds another run", "ppo.gamma: 0.99 != 0.5", "seeds: 2 != 3")
    assert contents(run_dir) == files_before


#: Settings, and the parts of their refusal, divided by "; ": field, value and remedy.
@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("sede: 1", "sede; did you mean seed?"),
        ("ppo: {num_env: 4}", "ppo.num_env; did you mean ppo.num_envs?"),
        ("seeds: two", "seeds; int; 'two'"),
        ("ppo: {gamma: [1]}", "ppo.gamma; float; [1]"),
        ("counterfactual: maybe", "counterfactual; 'none', 'coin', 'distil'; 'maybe'"),
        ("decision: both", "decision; 'fused', 'streams'; 'both'"),
        ("ppo: {experience: 0}", "ppo.experience is 0.0; give a number above 0, at most 1"),
        ("ppo: {experience: 1.5}", "ppo.experience is 1.5; give a number above 0, at most 1"),
        ("counterfactual_memory: mine", "counterfactual_memory; 'factual', 'own'; 'mine'"),
        (
            "{decision: streams, counterfactual_memory: own}",
            "counterfactual_memory is own; two streams have separate memories already; omit the option",
        ),
        ("ppo: {alone: 1.0}", "ppo.alone is 1.0; give a share from 0 to below 1"),
        (
            "{decision: streams, ppo: {experience: 1.0}}",
            "ppo.experience is 1.0; give a number between 0 and 1, both excluded",
        ),
        ("{method: semexp, done_gate: true}", "done_gate is True; method 'semexp'"),
        ("method: orgy", "method 'orgy': is unknown; did you mean 'org'?"),
        ("method: no_such_package:MINE", "method 'no_such_package:MINE': cannot be imported (ModuleNotFoundError: "),
        ("method: jaxnav.layout:MINE", "method 'jaxnav.layout:MINE': cannot be imported (AttributeError: "),
        ("method: jaxnav.layout:ESTIMATORS", "method 'jaxnav.layout:ESTIMATORS': is of type dict, not jaxnav.Method"),
        ("{method: anonymous, arms: [layout]}", "method 'anonymous' cannot use layout weights; give only baseline"),
        ("method_sizes: {layers: 2}", "method_sizes.layers is 2; this size is unknown, method 'org' has"),
        ("{method: rgb, method_sizes: {layers: 2}}", "this size is unknown, method 'rgb' has no sizes"),
        ("method_sizes: {relation_layers: 0}", "method_sizes.relation_layers is 0; give at least 1"),
        ("method_sizes: {relation_layers: two}", "method_sizes; mapping of str to int"),
        ("sizes: {relation_layers: 2}", "sizes.relation_layers; method_sizes.relation_layers"),
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
        ("worlds: {goals: [Chair, Unicorn]}", "worlds.goals is ['Unicorn']; choose from the categories AlarmClock,"),
        ("{world: houses, scenes: none.jsonl.gz}", "none.jsonl.gz: cannot be read"),
        (
            "{world: houses, worlds: {num_train: 9, shard_scenes: 8}, chunk: 1}",
            "chunk is 1; with streamed scenes a chunk must be at least as long as an episode",
        ),
        ("seeds: 1\nseeds: 2", "line 2: not valid YAML (seeds is given twice)"),
    ],
)
def test_train_refuses_bad_settings_before_writing(tmp_path, capsys, line, problem):
    bad_config = tmp_path / "bad.yaml"
    bad_config.write_text(line)
    assert train(bad_config, tmp_path / "run", "--cache", tmp_path / "cache") == 2
    assert_message_names(refusal(capsys), *problem.split("; "))
    assert not (tmp_path / "run").exists()


BROKEN_METHODS = """
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


@pytest.mark.parametrize(
    ("method_name", "reason"), [("WIDTH", "TypeError: "), ("RAISING", "RuntimeError: first line)")]
)
def test_train_refuses_methods_that_fail_check_method(tmp_path, monkeypatch, capsys, method_name, reason):
    (tmp_path / "broken_method.py").write_text(BROKEN_METHODS)
    monkeypatch.syspath_prepend(tmp_path)
    options = ["--method", f"broken_method:{method_name}", "--run-dir", str(tmp_path / "run")]
    assert train_command.main(options) == 2
    error = capsys.readouterr().err
    assert_message_names(
        error, f"error: method 'broken_method:{method_name}'", "check_method", reason, "fix the method"
    )
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


NAMELESS_SCENES = gzip.compress(b'{"name": "a"}\n' * 9, mtime=0)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (None, "cannot be read (No such file or directory)"),
        (b"not compressed", "line 1: not JSON"),
        (NAMELESS_SCENES[:-9], "is cut short or damaged"),
        (gzip.compress(b"{]\n", mtime=0), "line 1: not JSON"),
        (NAMELESS_SCENES, "line 1, scene 'a': world is missing; add it"),
        (gzip.compress(b"", mtime=0), "holds no scene"),
    ],
)
def test_train_names_bad_scene_files(tmp_path, capsys, data, problem):
    scene_file = tmp_path / "scenes.jsonl.gz"
    if data is not None:
        scene_file.write_bytes(data)
    assert train_command.main(["--run-dir", str(tmp_path / "new"), "--scenes", str(scene_file)]) == 2
    assert_message_names(refusal(capsys), str(scene_file), problem)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_train_refuses_directories_that_hold_no_run(tmp_path, config_file, capsys):
    foreign_file = tmp_path / "file"
    foreign_file.write_text("mine")
    assert train(config_file, foreign_file) == 2
    assert_message_names(refusal(capsys), f"{foreign_file}: is a file", "--run-dir")
    assert train(config_file, tmp_path) == 2
    assert_message_names(refusal(capsys), f"{tmp_path}: ", "holds no run")
    assert contents(tmp_path) == {"file": b"mine"}


def test_train_names_a_damaged_config_file(tmp_path, run_dir, config_file, capsys):
    config_text = (run_dir / "config.json").read_text()
    (tmp_path / "config.json").write_text(config_text[: len(config_text) // 2])
    assert train(config_file, tmp_path) == 2
    assert f"{tmp_path}/config.json" in refusal(capsys)


# Categories and priors


@pytest.mark.exhaustive
def test_custom_categories_are_trained_resumed_and_evaluated(tmp_path, config_file, capsys):
    """Three categories, two of them goals, in a run that the second command finds finished."""
    run_dir = tmp_path / "own"
    budget = ("--seeds", 1, "--total-steps", 256)
    categories = ("Chair", "Sink", "LightSwitch")
    goals = ("Sink", "LightSwitch")
    options = (*budget, "--worlds.categories", *categories, "--worlds.goals", *goals)
    assert train(config_file, run_dir, *options) == 0
    assert train(config_file, run_dir, *options) == 0
    assert "resumed after update 2 of 2" in capsys.readouterr().err

    _, spec = load_params(run_dir / "policies" / "layout-0")
    assert spec["task"]["categories"] == list(categories)
    assert spec["task"]["goals"] == list(goals)
    assert evaluate(run_dir, "--episodes", 8) == 0
    with (run_dir / "eval-val-episodes8.episodes.csv").open() as file:
        assert {row["goal"] for row in csv.DictReader(file)} == set(goals)


def test_layout_priors_pool_rooms_without_training_scenes():
    counts = np.zeros((3, 2, 2), np.float32)
    counts[0] = [[5, 3], [3, 4]]
    counts[2] = [[2, 1], [1, 2]]
    # By the letter of the paper the prior is the counts and one: 3 + 1, 3 + 1 + 1, 1 + 1.
    priors = layout_priors(jnp.asarray(counts), "paper")
    np.testing.assert_array_equal(priors[:, 0, 1], [4, 5, 2])
