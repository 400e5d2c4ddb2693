"""Training and evaluation from shards on disk: the order of the shards, equal shapes, resuming, and equal numbers."""

import dataclasses
import io
import json

import jax
import numpy as np
import pytest
from commands import CONFIG, evaluate, train
from rich.console import Console

from jaxnav.cli.config import RunConfig, WorldConfig
from jaxnav.cli.worlds import Stream, evaluation_world, training_world

OPTIONS = ("--worlds.num-train", 9, "--worlds.shard-scenes", 3, "--total-steps", 1024)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.getbasetemp() / "cache"


@pytest.fixture(scope="module")
def config_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("stream") / "tiny.yaml"
    path.write_text(CONFIG.replace("seeds: 2", "seeds: 1"))
    return path


@pytest.fixture(scope="module")
def finished(config_file, cache, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("stream") / "run"
    assert train(config_file, run_dir, *OPTIONS, "--cache", cache) == 0
    return run_dir


@pytest.fixture(scope="module")
def world(cache):
    config = RunConfig(worlds=WorldConfig(num_train=9, shard_scenes=4), cache=cache)
    return training_world(config, Console(file=io.StringIO()))


def test_all_banks_have_one_shape_on_the_device(world):
    assert len(world.banks) == 3
    shapes = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), world.params(i)) for i in range(3)]
    assert shapes[0] == shapes[1] == shapes[2]
    # And hold what their own banks hold, then nothing.
    for i, bank in enumerate(world.banks):
        tables = world.params(i).tables
        np.testing.assert_array_equal(tables.rows[: len(bank.rows)], bank.rows)
        assert not tables.rows[len(bank.rows) :].any()


def test_every_pass_meets_every_bank_in_an_order_of_its_own(world):
    stream, other = Stream(world, seed=1), Stream(world, seed=2)
    passes = [tuple(stream.bank(turn) for turn in range(start, start + 3)) for start in range(0, 30, 3)]
    assert all(sorted(order) == [0, 1, 2] for order in passes)
    assert len(set(passes)) > 2
    assert passes != [tuple(other.bank(turn) for turn in range(start, start + 3)) for start in range(0, 30, 3)]
    for turn in (0, 1, 2, 7):
        assert np.array_equal(stream.params(turn).tables.num_cells, world.params(stream.bank(turn)).tables.num_cells)


def test_a_streamed_run_resumes_to_the_same_numbers(finished, config_file, cache, tmp_path):
    """8 updates in chunks of 2 go through four turns of three shards; the second half comes after a stop."""
    rows = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["step"] == 8
    half = tmp_path / "half"
    assert train(config_file, half, *OPTIONS, "--cache", cache) == 0
    for step in half.glob("checkpoints/*"):
        if step.name.isdigit() and int(step.name) > 4:
            for file in sorted(step.rglob("*"), reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
            step.rmdir()
    resumed = train(config_file, half, *OPTIONS, "--cache", cache)
    assert resumed == 0
    assert (half / "metrics.jsonl").read_bytes() == (finished / "metrics.jsonl").read_bytes()


def test_streamed_evaluation_is_one_compilation_and_knows_all_scenes(finished, tmp_path):
    target = tmp_path / "train.json"
    assert evaluate(finished, "--split", "train", "--episodes", 24, "--json", target) == 0
    report = json.loads(target.read_text())
    assert report["compilations"] == 1
    scenes = {line.split(",")[5] for line in target.with_name("train.episodes.csv").read_text().splitlines()[1:]}
    assert scenes == {f"train-{room}-{i:03d}" for i, room in enumerate(4 * list(ROOMS))} & scenes
    assert len(scenes) == 9


ROOMS = ("kitchen", "living_room", "bedroom", "bathroom")


def test_shards_hold_what_memory_would(world, cache):
    whole = RunConfig(worlds=WorldConfig(num_train=9), cache=cache)
    memory = training_world(whole, Console(file=io.StringIO()))
    assert len(memory.banks) == 1
    np.testing.assert_array_equal(np.concatenate([bank.rows for bank in world.banks]), memory.banks[0].rows)
    assert memory.fingerprint != world.fingerprint
    shifted = dataclasses.replace(whole, worlds=dataclasses.replace(whole.worlds, num_val=4))
    straight, turned = (
        evaluation_world(shifted, "val", None, shift, Console(file=io.StringIO())) for shift in (0.0, 1.0)
    )
    assert straight.fingerprint != turned.fingerprint
