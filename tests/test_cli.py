"""The train and eval commands end to end on a few small rooms, and all that they refuse."""

import csv
import gzip
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxnav.cli import eval as eval_command
from jaxnav.cli import train as train_command
from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.store.export import load_params
from jaxnav.store.runlog import read_rows

REPOSITORY = Path(__file__).parents[1]
CONFIG = """
method: org
seeds: 2
total_steps: 512  # 4 updates, 2 chunks
counterfactual: distil
chunk: 2
save_every: 1
worlds: {num_train: 4, num_val: 4, num_test: 4, train_step_limit: 10, step_limit: 12, large_step_limit: 14}
layout: {setting: calibrated, walks: 64, steps: 20}
sizes: {hidden: 16, view_outputs: 8, appearance: 4, row_hidden: 8, row_outputs: 2, relation_layers: 1}
ppo: {num_envs: 16, rollout: 8, epochs: 1, minibatches: 2, learning_rate: 1e-2, distil: 0.1}
"""
SEEDS, POLICIES = 2, {"baseline-0", "baseline-1", "layout-0", "layout-1"}


@pytest.fixture(scope="module")
def config_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def run_dir(config_file, tmp_path_factory):
    """A finished run. Its directory holds what a kill while the config was being written leaves."""
    run_dir = tmp_path_factory.mktemp("run")
    (run_dir / ".config.json.123.tmp").write_text("{")
    assert train(config_file, run_dir) == 0
    return run_dir


def train(config_file, run_dir, *options):
    return train_command.main(["--config", str(config_file), "--run-dir", str(run_dir), *map(str, options)])


def evaluate(*options):
    return eval_command.main([*map(str, options)])


def refusal(capsys):
    """The message of a refusal, one line."""
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    return error


def contents(folder):
    """Every file below a folder, byte for byte."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# Training


def test_a_run_writes_policies_and_metrics_of_all_arms_and_seeds(run_dir):
    assert {folder.name for folder in (run_dir / "policies").iterdir()} == POLICIES
    assert {folder.name for folder in (run_dir / "checkpoints").iterdir()} == {"2", "4"}
    rows = read_rows(run_dir / "metrics.jsonl")
    identities = [(row["step"], row["arm"], row["seed"]) for row in rows]
    assert sorted(identities) == sorted((s, a, i) for s in (2, 4) for a in ("baseline", "layout") for i in range(SEEDS))
    for row in rows:
        assert row["distil_loss"] > 0
        assert all(math.isfinite(value) for value in row.values() if not isinstance(value, str))
        assert row["env_steps"] == row["step"] * 16 * 8
        assert row["episodes"] > 0
        assert row["skipped_steps"] == 0


def test_policies_say_how_they_are_used(run_dir):
    loaded = {name: load_params(run_dir / "policies" / name) for name in POLICIES}
    for name, (tensors, spec) in loaded.items():
        assert spec["method"] == "org"
        assert spec["categories"] == list(ITHOR_CATEGORIES)
        assert spec["sizes"]["hidden"] == 16
        assert spec["layout"] == ("calibrated" if name.startswith("layout") else None)
        assert spec["prior_steps"] == 64 * 20
        assert 0 < spec["prior_poses"] <= 64 * 21
        assert tensors["layout"]["prior"].shape == (5, 22, 22)
        assert all(np.isfinite(leaf).all() for leaf in tensors["policy"]["core"]["dense_i"].values())
    kernels = [tensors["policy"]["fuse"]["kernel"].tobytes() for tensors, _ in loaded.values()]
    assert len(set(kernels)) == 4


def test_a_finished_run_is_left_as_it_is(run_dir, config_file, capsys):
    before = contents(run_dir)
    assert train(config_file, run_dir) == 0
    assert "resumed after update 4 of 4" in capsys.readouterr().err
    assert contents(run_dir) == before


# Refusals of training


def test_another_config_in_the_same_directory_is_refused(run_dir, config_file, capsys):
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
        ("method: orgy", "method is 'orgy'; choose one of rgb, org"),
        ("seeds: 0", "seeds is 0; give at least 1"),
        ("sizes: {hidden: -8}", "sizes.hidden is -8; give at least 1"),
        ("worlds: {num_train: 0}", "worlds.num_train is 0; give at least 1"),
        ("ppo: {num_envs: 10, minibatches: 4}", "ppo.num_envs is 10; give a multiple of ppo.minibatches (4)"),
        ("ppo: {rollout: 31}", "ppo.rollout is 31; give at most worlds.train_step_limit (30)"),
        ("ppo: {learning_rate: .inf}", "ppo.learning_rate is inf; give a positive number"),
        ("detector: {miss_far: 1.5}", "detector.miss_far is 1.5; give a probability"),
        ("seed: -1", "seed is -1; give a whole number from 0 to 2**32 - 1"),
        ("seed: 4294967296", "seed is 4294967296; give a whole number from 0"),
        ("worlds: {seed: -1}", "worlds.seed is -1; give a whole number from 0"),
        ("detector: {seed: -1}", "detector.seed is -1; give a whole number from 0"),
        ("seeds: 1\nseeds: 2", "line 2: not valid YAML (seeds is given twice)"),
    ],
)
def test_bad_settings_are_refused_before_anything_is_made(tmp_path, capsys, line, problem):
    file = tmp_path / "bad.yaml"
    file.write_text(line)
    assert train(file, tmp_path / "run") == 2
    assert problem in refusal(capsys)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("option", ["--ppo.gamma", "--seeds", "--layout.setting"])
def test_bad_options_are_refused(tmp_path, capsys, option):
    with pytest.raises(SystemExit) as exit:
        train_command.main(["--run-dir", str(tmp_path / "run"), option, "nonsense"])
    assert exit.value.code == 2
    assert option in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


WHOLE = gzip.compress(b'{"name": "a"}\n' * 9, mtime=0)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (None, "cannot be read (No such file or directory)"),
        (b"not compressed", "is not gzip-compressed"),
        (WHOLE[:-9], "is cut short or damaged"),
        (gzip.compress(b"{]\n"), "line 1: not JSON"),
        (WHOLE, "line 1, scene 'a': world is missing; add it"),
        (gzip.compress(b""), "holds no scene"),
    ],
)
def test_bad_scene_files_are_refused_by_name(tmp_path, run_dir, capsys, data, problem):
    file = tmp_path / "scenes.jsonl.gz"
    if data is not None:
        file.write_bytes(data)
    assert train_command.main(["--run-dir", str(tmp_path / "new"), "--scenes", str(file)]) == 2
    error = refusal(capsys)
    assert str(file) in error
    assert problem in error
    assert not (tmp_path / "new").exists()
    before = contents(run_dir)
    assert evaluate(run_dir, "--scenes", file) == 2
    assert problem in refusal(capsys)
    assert contents(run_dir) == before


def test_directories_that_are_something_else_are_refused(tmp_path, config_file, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert train(config_file, file) == 2
    assert f"{file}: is a file; choose another --run-dir" in refusal(capsys)
    assert train(config_file, tmp_path) == 2
    assert f"{tmp_path}: is not empty and holds no run" in refusal(capsys)
    assert contents(tmp_path) == {"file": b"mine"}


def test_a_damaged_config_is_named(tmp_path, run_dir, config_file, capsys):
    text = (run_dir / "config.json").read_text()
    (tmp_path / "config.json").write_text(text[: len(text) // 2])
    assert train(config_file, tmp_path) == 2
    assert f"{tmp_path}/config.json" in refusal(capsys)
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/config.json" in refusal(capsys)


# Evaluation

ROWS = 2 * (2 + 1 + 2) + 1  # of each decoding baseline, layout, TDE and sTDE at two epsilons; Random


@pytest.fixture(scope="module")
def evaluated(run_dir, tmp_path_factory):
    """The report and the episodes of an evaluation, written into a folder that is not there yet."""
    target = tmp_path_factory.mktemp("eval") / "new" / "table.json"
    assert evaluate(run_dir, "--episodes", 18, "--epsilon", 0, 0.5, "--json", target) == 0
    return target


def test_the_report_holds_all_rows_and_differences(evaluated):
    report = json.loads(evaluated.read_text())
    assert list(report) == ["rows", "differences", "compilations", "versions", "format"]
    assert report["compilations"] == 1
    assert len(report["rows"]) == ROWS
    for row in report["rows"]:
        assert (row["method"], row["world"], row["split"], row["seeds"]) == ("ORG", "rooms", "val", SEEDS)
        assert row["episodes"] == 20  # rounded up to a multiple of the four room types
        for metric in ("sr", "spl", "dts", "sae"):
            low, high = row[metric]["ci95"]
            assert low <= row[metric]["mean"] <= high
    settings = [(row["variant"], row["epsilon"], row["decoding"], row["form"]) for row in report["rows"]]
    assert len(set(settings)) == ROWS
    assert ("stde", 0.5, "argmax", "residual") in settings
    # Layout against baseline, the others against layout: four rows of each decoding, three metrics.
    assert len(report["differences"]) == 2 * 4 * 3


def test_the_episodes_are_written_row_by_row(evaluated):
    with evaluated.with_suffix(".episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == ROWS * SEEDS * 20
    report = json.loads(evaluated.read_text())
    for row in report["rows"]:
        epsilon = "" if row["epsilon"] is None else str(row["epsilon"])
        own = [
            r for r in rows if (r["variant"], r["epsilon"], r["decoding"]) == (row["variant"], epsilon, row["decoding"])
        ]
        assert len(own) == SEEDS * 20
        for metric, scale in (("sr", 100), ("spl", 100), ("dts", 1)):
            assert scale * np.mean([float(r[metric]) for r in own]) == pytest.approx(row[metric]["mean"], rel=1e-4)
    for row in rows:
        limit = 14 if row["room"] == "living_room" else 12
        assert 1 <= int(row["length"]) <= limit
        assert row["goal"] in ITHOR_CATEGORIES
        assert 0 <= float(row["mean_weight"]) <= 1


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--epsilon", "nan"], "--epsilon nan: give numbers from 0 to below infinity"),
        (["--epsilon", "0.5", "-0.5"], "--epsilon -0.5: give"),
        (["--epsilon", "inf"], "--epsilon inf: give"),
        (["--episodes", "0"], "--episodes 0: give at least 1"),
        (["--seed", "-1"], "--seed -1: give a whole number from 0"),
    ],
)
def test_bad_evaluations_are_refused_and_write_nothing(run_dir, capsys, options, problem):
    before = contents(run_dir)
    assert evaluate(run_dir, *options) == 2
    assert problem in refusal(capsys)
    assert contents(run_dir) == before


def test_a_directory_without_a_run_is_refused(tmp_path, capsys):
    for folder in (tmp_path, tmp_path / "none"):
        assert evaluate(folder) == 2
        assert f"{folder}: holds no run (config.json is missing); train one there first" in refusal(capsys)
    assert not (tmp_path / "none").exists()


def test_a_run_that_is_not_finished_is_refused(tmp_path, run_dir, capsys):
    shutil.copy(run_dir / "config.json", tmp_path)
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/policies/baseline-0: is missing, so training has not finished" in refusal(capsys)
    # One policy is missing still: training was ended while it exported them.
    shutil.copytree(run_dir / "policies", tmp_path / "policies")
    (tmp_path / "policies" / "layout-1" / "policy.json").unlink()
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/policies/layout-1: not an exported policy" in refusal(capsys)
    assert not list(tmp_path.glob("eval*"))


@pytest.mark.slow
def test_evaluations_are_equal_byte_for_byte(run_dir, evaluated, tmp_path):
    for seed, equal in ((0, True), (1, False)):
        again = tmp_path / f"{seed}.json"
        assert evaluate(run_dir, "--episodes", 18, "--epsilon", 0, 0.5, "--json", again, "--seed", seed) == 0
        assert (again.read_bytes() == evaluated.read_bytes()) == equal
        episodes = [path.with_suffix(".episodes.csv").read_bytes() for path in (again, evaluated)]
        assert (episodes[0] == episodes[1]) == equal


# Kills


def start(config_file, run_dir, cache, *options):
    """The command in a process of its own; compiled code is kept, or every start would take its time."""
    command = [sys.executable, "train.py", "--config", str(config_file), "--run-dir", str(run_dir), *options]
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.Popen(command, cwd=REPOSITORY, env=environment, stderr=subprocess.PIPE, text=True)


def finish(process):
    _, error = process.communicate()
    assert process.returncode == 0, error
    return error


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_killed_and_resumed_run_is_an_uninterrupted_one_bit_for_bit(config_file, tmp_path):
    cache, long = tmp_path / "cache", ("--total-steps", "7680")  # 60 updates, 30 chunks
    whole, killed, other = tmp_path / "whole", tmp_path / "killed", tmp_path / "other"
    finish(start(config_file, whole, cache, *long))
    generator = random.Random(0)
    for seen in (0, 2, 10, 24, 40):  # the update after whose checkpoint it is killed, at a random moment
        process = start(config_file, killed, cache, *long)
        while (
            seen
            and process.poll() is None
            and not any(int(path.name) >= seen for path in killed.glob("checkpoints/*") if path.name.isdigit())
        ):
            time.sleep(0.001)
        time.sleep(generator.uniform(0, 0.3) if seen else generator.uniform(1, 4))
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    assert "resumed after update" in finish(start(config_file, killed, cache, *long))
    names = ["metrics.jsonl", *(f"policies/{name}/params.safetensors" for name in sorted(POLICIES))]
    for name in names:
        assert (killed / name).read_bytes() == (whole / name).read_bytes(), name
    assert len(read_rows(killed / "metrics.jsonl")) == 30 * 2 * SEEDS
    finish(start(config_file, other, cache, *long, "--seed", "1"))
    for name in names:
        assert (other / name).read_bytes() != (whole / name).read_bytes(), name
