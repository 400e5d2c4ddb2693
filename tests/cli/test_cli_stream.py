"""Training and evaluation from shards on disk: the order of the shards, equal shapes, resuming, and equal numbers."""

import dataclasses
import io
import json
import time

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny
from support.commands import evaluate, train
from support.tiny_run import write_config

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.layout import EstimatorConfig
from jaxnav.policies.method import Knowledge
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.runs.train import make_trainer
from jaxnav.runs.worlds import compile_evaluation_world, compile_training_world, draw_bank_order, prefetch_env_params
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.store.files import read_log_rows
from jaxnav.training.config import PPOConfig
from jaxnav.training.trainer import Trainer

#: Three shards of three scenes, and 8 updates.
OPTIONS = ("--worlds.num-train", 9, "--worlds.shard-scenes", 3, "--total-steps", 1024, "--arms", "layout")


@pytest.fixture(scope="module")
def cache_dir(tmp_path_factory):
    return tmp_path_factory.getbasetemp() / "cache"


@pytest.fixture(scope="module")
def config_file(tmp_path_factory):
    return write_config(tmp_path_factory.mktemp("stream"), num_seeds=1)


@pytest.fixture(scope="module")
def finished_run_dir(config_file, cache_dir, tmp_path_factory):
    """Directory of a run that the train command has finished from shards."""
    run_dir = tmp_path_factory.mktemp("stream") / "run"
    assert train(config_file, run_dir, *OPTIONS, "--cache", cache_dir) == 0
    return run_dir


@pytest.fixture(scope="module")
def sharded_world(cache_dir):
    """Nine scenes in three banks of at most four."""
    config = RunConfig(worlds=WorldConfig(num_train=9, shard_scenes=4), cache=cache_dir)
    return compile_training_world(config, Console(file=io.StringIO()))


def leaf_shapes(env_params):
    """Shape and dtype of each leaf of the environment's parameters."""
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), env_params)


def test_streamed_banks_are_padded_to_one_shape(sharded_world):
    assert len(sharded_world.banks) == 3
    shapes = [leaf_shapes(sharded_world.make_env_params(bank_index)) for bank_index in range(3)]
    assert shapes[0] == shapes[1] == shapes[2]

    # The tables begin with the rows of their bank, and zeros follow.
    for bank_index, bank in enumerate(sharded_world.banks):
        tables = sharded_world.make_env_params(bank_index).tables
        np.testing.assert_array_equal(tables.rows[: len(bank.rows)], bank.rows)
        assert not tables.rows[len(bank.rows) :].any()


def test_draw_bank_order_visits_every_bank_once_per_pass(sharded_world):
    order = draw_bank_order(sharded_world, 1, 30)
    passes = [tuple(order[start : start + 3]) for start in range(0, 30, 3)]
    assert all(sorted(bank_pass) == [0, 1, 2] for bank_pass in passes)
    assert len(set(passes)) > 2

    # The order depends on the seed, and a shorter training sees the beginning of the order.
    assert order != draw_bank_order(sharded_world, 2, 30)
    assert draw_bank_order(sharded_world, 1, 7) == order[:7]


def test_prefetch_env_params_reads_one_bank_ahead(sharded_world, monkeypatch):
    requested_banks = []
    make_env_params = type(sharded_world).make_env_params

    def record_and_make(self, bank_index):
        requested_banks.append(bank_index)
        return make_env_params(self, bank_index)

    monkeypatch.setattr(type(sharded_world), "make_env_params", record_and_make)
    order = [2, 0, 0, 1]
    # The banks that have been requested in each turn: the second 0 needs no new read.
    expected_requests = [[2, 0], [2, 0], [2, 0, 1], [2, 0, 1]]
    prefetched_params = prefetch_env_params(sharded_world, order)
    for turn_index, bank_index in enumerate(order):
        chex.assert_trees_all_equal(next(prefetched_params), make_env_params(sharded_world, bank_index))
        time.sleep(0.2)  # the thread that reads
        assert requested_banks == expected_requests[turn_index]
    assert list(prefetched_params) == list(prefetch_env_params(sharded_world, [])) == []


@pytest.mark.exhaustive
def test_trainer_restart_draws_new_episodes_and_keeps_the_learner(sharded_world):
    """Restarting draws episodes by the update's own key; parameters and optimizer stay."""
    ppo = PPOConfig(num_envs=32, rollout=4, minibatches=2)
    config = RunConfig(ppo=ppo, seeds=1, sizes=tiny.SIZES, worlds=WorldConfig(near_starts=0.5))
    trainer = make_trainer(config, sharded_world.env, EstimatorConfig(), Knowledge(jnp.ones((NUM_PRIORS, 22, 22))))

    # A share of the training episodes starts near the goals, by default in all worlds but rooms.
    assert (trainer.learners["layout"].agent_loop.env.near_starts, sharded_world.env.near_starts) == (0.5, 0.0)
    assert [RunConfig(world=name).near_starts for name in ("rooms", "apartments", "houses")] == [0.0, 0.5, 0.5]

    # The restart donates the states, so the state before it is copied; NumPy cannot hold its key.
    states = trainer.init(sharded_world.make_env_params(0))
    state_before = jax.tree.map(np.array, states["layout"][0].replace(key=None))
    state_after = trainer.restart(states, sharded_world.make_env_params(1))["layout"][0]

    # The learner stays, and its episodes are new ones in the scenes of the second bank.
    chex.assert_trees_all_equal(
        (state_after.params, state_after.opt_state, state_after.update),
        (state_before.params, state_before.opt_state, state_before.update),
    )
    new_episodes = state_after.agent.state
    assert not np.array_equal(new_episodes.pose, state_before.agent.state.pose)
    assert not np.asarray(new_episodes.time).any()
    assert (np.asarray(new_episodes.scene) < len(sharded_world.banks[1].names)).all()


@pytest.mark.slow
def test_streamed_run_resumes_bit_for_bit(finished_run_dir, config_file, cache_dir, tmp_path, monkeypatch, capsys):
    """8 updates in chunks of 2 go through four turns of three shards; the second half comes after a stop."""
    stopped_run_dir = tmp_path / "stopped"
    calls = []
    train_chunk = Trainer.train

    def interrupt_third_chunk(self, states, env_params, stage_index):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return train_chunk(self, states, env_params, stage_index)

    # The first command is interrupted after two chunks.
    monkeypatch.setattr(Trainer, "train", interrupt_third_chunk)
    assert train(config_file, stopped_run_dir, *OPTIONS, "--cache", cache_dir) == 130
    assert [row["step"] for row in read_log_rows(stopped_run_dir / "metrics.jsonl")] == [2, 4]
    capsys.readouterr()

    # The second one trains the other two chunks.
    assert train(config_file, stopped_run_dir, *OPTIONS, "--cache", cache_dir) == 0
    assert "resumed after update 4 of 8" in capsys.readouterr().err
    assert len(calls) == 5  # two chunks, the one that was interrupted, and two more

    # Metrics and policies are those of the run that was not interrupted.
    assert read_log_rows(finished_run_dir / "metrics.jsonl")[-1]["step"] == 8
    for name in ("metrics.jsonl", "policies/layout-0/params.safetensors"):
        assert (stopped_run_dir / name).read_bytes() == (finished_run_dir / name).read_bytes()


@pytest.mark.exhaustive
def test_streamed_evaluation_compiles_once_and_visits_all_scenes(finished_run_dir, tmp_path):
    report_path = tmp_path / "train.json"
    assert evaluate(finished_run_dir, "--split", "train", "--episodes", 24, "--json", report_path) == 0
    report = json.loads(report_path.read_text())
    assert report["compilations"] == 1

    # The sixth column of the episodes is the scene; the room types of generated rooms take turns.
    episode_lines = report_path.with_name("train.episodes.csv").read_text().splitlines()[1:]
    scene_names = {line.split(",")[5] for line in episode_lines}
    room_types = (3 * ROOM_TYPES)[:9]
    assert scene_names == {f"train-{room_type}-{index:03d}" for index, room_type in enumerate(room_types)}


@pytest.mark.slow
def test_sharded_world_equals_the_world_in_memory(sharded_world, cache_dir):
    config = RunConfig(worlds=WorldConfig(num_train=9), cache=cache_dir)
    world_in_memory = compile_training_world(config, Console(file=io.StringIO()))
    assert len(world_in_memory.banks) == 1
    sharded_rows = np.concatenate([bank.rows for bank in sharded_world.banks])
    np.testing.assert_array_equal(sharded_rows, world_in_memory.banks[0].rows)
    assert world_in_memory.fingerprint != sharded_world.fingerprint

    # Scenes with another layout have another fingerprint.
    val_config = dataclasses.replace(config, worlds=dataclasses.replace(config.worlds, num_val=4))
    fingerprints = set()
    for shift in (0.0, 1.0):
        val_world = compile_evaluation_world(val_config, "val", None, shift, Console(file=io.StringIO()))
        fingerprints.add(val_world.fingerprint)
    assert len(fingerprints) == 2
