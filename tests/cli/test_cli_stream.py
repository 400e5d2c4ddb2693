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

OPTIONS = ("--worlds.num-train", 9, "--worlds.shard-scenes", 3, "--total-steps", 1024, "--arms", "layout")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.getbasetemp() / "cache"


@pytest.fixture(scope="module")
def config_file(tmp_path_factory):
    return write_config(tmp_path_factory.mktemp("stream"), num_seeds=1)


@pytest.fixture(scope="module")
def finished(config_file, cache, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("stream") / "run"
    assert train(config_file, run_dir, *OPTIONS, "--cache", cache) == 0
    return run_dir


@pytest.fixture(scope="module")
def world(cache):
    config = RunConfig(worlds=WorldConfig(num_train=9, shard_scenes=4), cache=cache)
    return compile_training_world(config, Console(file=io.StringIO()))


def test_streamed_banks_are_padded_to_one_shape(world):
    assert len(world.banks) == 3
    shapes = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), world.make_env_params(i)) for i in range(3)]
    assert shapes[0] == shapes[1] == shapes[2]
    # And hold what their own banks hold, then nothing.
    for i, bank in enumerate(world.banks):
        tables = world.make_env_params(i).tables
        np.testing.assert_array_equal(tables.rows[: len(bank.rows)], bank.rows)
        assert not tables.rows[len(bank.rows) :].any()


def test_draw_bank_order_visits_every_bank_once_per_pass(world):
    order = draw_bank_order(world, 1, 30)
    other = draw_bank_order(world, 2, 30)
    passes = [tuple(order[start : start + 3]) for start in range(0, 30, 3)]
    assert all(sorted(one) == [0, 1, 2] for one in passes)
    assert len(set(passes)) > 2
    assert order != other
    assert draw_bank_order(world, 1, 7) == order[:7]


def test_prefetch_env_params_reads_one_bank_ahead(world, monkeypatch):
    asked = []
    params = type(world).make_env_params
    monkeypatch.setattr(type(world), "make_env_params", lambda self, bank: asked.append(bank) or params(self, bank))
    order = [2, 0, 0, 1]
    given = prefetch_env_params(world, order)
    for turn, bank in enumerate(order):
        chex.assert_trees_all_equal(next(given), params(world, bank))
        time.sleep(0.2)  # the thread that reads
        assert asked == [[2, 0], [2, 0], [2, 0, 1], [2, 0, 1]][turn]
    assert list(given) == list(prefetch_env_params(world, [])) == []


@pytest.mark.exhaustive
def test_trainer_restart_draws_new_episodes_and_keeps_the_learner(world):
    """Restarting draws episodes by the update's own key; parameters and optimizer stay."""
    ppo = PPOConfig(num_envs=32, rollout=4, minibatches=2)
    config = RunConfig(ppo=ppo, seeds=1, sizes=tiny.SIZES, worlds=WorldConfig(near_starts=0.5))
    trainer = make_trainer(config, world.env, EstimatorConfig(), Knowledge(jnp.ones((NUM_PRIORS, 22, 22))))
    assert (trainer.learners["layout"].agent_loop.env.near_starts, world.env.near_starts) == (0.5, 0.0)
    assert [RunConfig(world=name).near_starts for name in ("rooms", "apartments", "houses")] == [0.0, 0.5, 0.5]
    before = trainer.init(world.make_env_params(0))
    copied = jax.tree.map(np.array, before["layout"][0].replace(key=None))
    after = trainer.restart(before, world.make_env_params(1))["layout"][0]
    chex.assert_trees_all_equal(
        (after.params, after.opt_state, after.update), (copied.params, copied.opt_state, copied.update)
    )
    assert not np.array_equal(after.agent.state.pose, copied.agent.state.pose)
    assert not np.asarray(after.agent.state.time).any()
    assert (np.asarray(after.agent.state.scene) < len(world.banks[1].names)).all()


@pytest.mark.slow
def test_streamed_run_resumes_bit_for_bit(finished, config_file, cache, tmp_path, monkeypatch, capsys):
    """8 updates in chunks of 2 go through four turns of three shards; the second half comes after a stop."""
    stopped = tmp_path / "stopped"
    calls = []
    whole = Trainer.train

    def train_twice(self, states, params, stage):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return whole(self, states, params, stage)

    monkeypatch.setattr(Trainer, "train", train_twice)
    assert train(config_file, stopped, *OPTIONS, "--cache", cache) == 130
    assert [row["step"] for row in read_log_rows(stopped / "metrics.jsonl")] == [2, 4]
    capsys.readouterr()
    assert train(config_file, stopped, *OPTIONS, "--cache", cache) == 0
    assert "resumed after update 4 of 8" in capsys.readouterr().err
    assert len(calls) == 5  # two, the one that stopped, and two more
    assert read_log_rows(finished / "metrics.jsonl")[-1]["step"] == 8
    for name in ("metrics.jsonl", "policies/layout-0/params.safetensors"):
        assert (stopped / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.exhaustive
def test_streamed_evaluation_compiles_once_and_visits_all_scenes(finished, tmp_path):
    target = tmp_path / "train.json"
    assert evaluate(finished, "--split", "train", "--episodes", 24, "--json", target) == 0
    report = json.loads(target.read_text())
    assert report["compilations"] == 1
    scenes = {line.split(",")[5] for line in target.with_name("train.episodes.csv").read_text().splitlines()[1:]}
    assert scenes == {f"train-{room}-{i:03d}" for i, room in enumerate((2 * ROOM_TYPES + ROOM_TYPES)[:9])}


@pytest.mark.slow
def test_sharded_world_equals_the_world_in_memory(world, cache):
    whole = RunConfig(worlds=WorldConfig(num_train=9), cache=cache)
    memory = compile_training_world(whole, Console(file=io.StringIO()))
    assert len(memory.banks) == 1
    np.testing.assert_array_equal(np.concatenate([bank.rows for bank in world.banks]), memory.banks[0].rows)
    assert memory.fingerprint != world.fingerprint
    shifted = dataclasses.replace(whole, worlds=dataclasses.replace(whole.worlds, num_val=4))
    straight, turned = (
        compile_evaluation_world(shifted, "val", None, shift, Console(file=io.StringIO())) for shift in (0.0, 1.0)
    )
    assert straight.fingerprint != turned.fingerprint
