"""One run on several devices and in several processes is the run of one device, but for the order of sums."""

import functools
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import chex
import numpy as np
import pytest
from support.commands import evaluate, refusal, train, write_config

from jaxnav.store.export import load_params
from jaxnav.store.runlog import read_rows
from jaxnav.training.devices import Devices

REPOSITORY = Path(__file__).parents[2]
#: Parameters are of the order of 0.1 to 1, and four updates move them by up to 0.04 with this learning rate.
TOLERANCE = 1e-5

# Two seeds on one device, on two (a seed each) and on four (a pair for each seed, which shares its episodes).
AGREEMENT = """
import contextlib, dataclasses, json, sys
import jax, numpy as np
from support import tiny_world as tiny
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import make_trainer
from jaxnav.errors import InputError
from jaxnav.layout import SETTINGS
from jaxnav.numerics.product import product
from jaxnav.training.config import PPOConfig
from jaxnav.training.devices import Devices

config = dataclasses.replace(
    RunConfig(), arms=("layout",), seeds=2, chunk=2, sizes=tiny.SIZES,
    ppo=PPOConfig(num_envs=16, rollout=6, minibatches=2, learning_rate=1e-2),
)
env, params = tiny.world()

def policies(count):
    parts = config, env, SETTINGS["calibrated"], tiny.knowledge()
    mesh = Devices(count=count).mesh(seeds=2, num_envs=16, minibatches=2)
    trainer = make_trainer(*parts, mesh if count > 1 else None)
    states = trainer.init(params)
    shards = trainer.unpack(states)["layout"][0].agent.state.pose.addressable_shards
    assert [shard.data.shape[0] for shard in shards] == {1: [16], 2: [16, 16], 4: [8, 8, 8, 8]}[count]
    for _ in range(2):
        states, metrics = trainer.train(states, params)
    return [
        {
            "params": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state.params)]).tolist(),
            "poses": np.asarray(state.agent.state.pose).tolist(),
            "metrics": values,
        }
        for state, values in zip(trainer.unpack(states)["layout"], metrics["layout"])
    ]

def collectives(within):
    # What a kernel's gradient exchanges whose rows' episodes are shared by two devices.
    mesh = Devices(count=2).mesh(seeds=1, num_envs=16, minibatches=2)
    place = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(None, "episodes"))
    rows, kernel = jax.device_put(np.ones((6, 16, 3), np.float32), place), np.ones((3, 5), np.float32)
    with jax.set_mesh(mesh) if within else contextlib.nullcontext():
        text = jax.jit(jax.grad(lambda k, r: product(r, k).sum())).lower(kernel, rows).compile().as_text()
    return {name: name + "(" in text for name in ("all-gather", "all-reduce")}

found = {count: policies(count) for count in map(int, sys.argv[1:])}
found |= {"within": collectives(True), "without": collectives(False)}
try:
    Devices(count=4).mesh(seeds=2, num_envs=18, minibatches=2)
except InputError as error:
    found["refused"] = str(error)
print(json.dumps(found))
"""


def run(command, **environment):
    environment = os.environ | {name: str(value) for name, value in environment.items()}
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        cwd=REPOSITORY,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@functools.cache
def trained(*counts):
    """Policies of runs on so many devices each, by their number."""
    path = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])
    flags = "--xla_force_host_platform_device_count=4"
    process = run(["-c", AGREEMENT, *counts], PYTHONPATH=path, XLA_FLAGS=flags, JAX_PLATFORMS="cpu")
    output, error = process.communicate(timeout=200)
    assert process.returncode == 0, error
    return json.loads(output)


def distance(a, b):
    return np.abs(np.subtract(a["params"], b["params"])).max()


@pytest.mark.slow
@pytest.mark.parametrize("devices", [2, 4])
def test_any_number_of_devices_trains_the_same_policies(devices):
    found = trained(1, 4) | (trained(devices) if devices != 4 else {})
    for ours, theirs in zip(found["1"], found[str(devices)], strict=True):
        assert distance(ours, theirs) < TOLERANCE
        assert ours["poses"] == theirs["poses"]
        assert theirs["metrics"] == pytest.approx(ours["metrics"], rel=1e-3, abs=TOLERANCE)


@pytest.mark.slow
def test_another_seed_is_another_policy():
    assert distance(*trained(1, 4)["1"]) > 100 * TOLERANCE


@pytest.mark.slow
def test_devices_share_episodes_without_gathering_them():
    """Only sums are exchanged; without the mesh made known, the rows are made one axis and gathered."""
    found = trained(1, 4)
    assert found["within"] == {"all-gather": False, "all-reduce": True}
    assert found["without"]["all-gather"]


@pytest.mark.slow
def test_devices_that_cannot_be_shared_out_are_refused():
    assert trained(1, 4)["refused"] == (
        "config: ppo.num_envs is 18; with 4 devices for 2 seeds the episodes of each are shared by 2: "
        "give a multiple of 2 x ppo.minibatches (2)"
    )


@pytest.mark.parametrize(
    ("text", "devices"),
    [
        ("8", Devices(count=8)),
        ("cluster", Devices()),
        ("10.0.0.1:1234,0,2", Devices(address="10.0.0.1:1234", process=0, processes=2)),
    ],
)
def test_devices_are_read(text, devices):
    assert Devices.parse(text) == devices


@pytest.mark.parametrize("text", ["0", "-1", "two", "host:1,2,2", "host,0,2", "host:1,0", ""])
def test_other_devices_are_refused(text, tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / "run", f"--devices={text}") == 2
    message = refusal(capsys).replace("'", "")  # what reads as a number is not quoted
    assert f"devices is {text}; give a number, `cluster` or HOST:PORT,INDEX,PROCESSES" in message


def test_more_devices_than_there_are_are_refused(tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / "run", "--devices", 99) == 2
    assert "devices is 99; there are 1 (on a CPU as many as XLA_FLAGS=" in refusal(capsys)
    assert not (tmp_path / "run").exists()


def two_processes(config_file, run_dir, *options):
    """Exit codes and messages of two processes on this machine that train one run, each given its own options."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    command = ["train.py", "--config", config_file, "--run-dir", run_dir, "--seeds", 1]
    processes = [
        run(
            [*command, f"--devices={address},{index},2", *(options[index] if options else ())],
            JAX_COORDINATOR_BIND_ADDRESS=address,
            XLA_FLAGS="",
        )
        for index in range(2)
    ]
    try:
        messages = [process.communicate(timeout=200)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], messages


@pytest.mark.slow
def test_two_processes_train_the_run_of_one(tmp_path, capsys):
    config_file, one, two = write_config(tmp_path), tmp_path / "one", tmp_path / "two"
    assert train(config_file, one, "--seeds", 1) == 0
    codes, messages = two_processes(config_file, two)
    assert codes == [0, 0], messages
    assert "done in" in messages[0]
    assert "done in" not in messages[1]
    assert_same_run(one, two)

    # One process goes on where two stopped, and the run can be evaluated.
    shutil.rmtree(two / "checkpoints" / "4")
    shutil.rmtree(two / "policies")
    assert train(config_file, two, "--seeds", 1) == 0
    assert "resumed after update 2 of 4" in capsys.readouterr().err
    assert_same_run(one, two)
    assert evaluate(two, "--episodes", 10) == 0


@pytest.mark.slow
def test_processes_that_disagree_are_refused(tmp_path):
    codes, messages = two_processes(write_config(tmp_path), tmp_path / "run", (), ("--seed", 1))
    assert codes == [2, 2], messages
    assert "processes [1] have other settings, scenes or versions than process 0" in messages[0]
    assert not (tmp_path / "run").exists()


def assert_same_run(one, two):
    for name in ("baseline-0", "layout-0"):
        ours, theirs = (load_params(folder / "policies" / name)[0] for folder in (one, two))
        chex.assert_trees_all_close(ours, theirs, rtol=0, atol=TOLERANCE)
    ours, theirs = (read_rows(folder / "metrics.jsonl") for folder in (one, two))
    for row, other in zip(ours, theirs, strict=True):
        assert row.pop("arm") == other.pop("arm")
        assert row == pytest.approx(other, rel=1e-3, abs=TOLERANCE)
