"""One run on several devices is the run of one device, but for the order of sums."""

import functools
import json
import os

import numpy as np
import pytest
from support.commands import refusal, train
from support.processes import REPOSITORY, run
from support.tiers import params_by_tier
from support.tiny_run import write_config

from jaxnav.training.devices import Devices

#: Parameters are of the order of 0.1 to 1, and four updates move them by up to 0.04 with this learning rate.
TOLERANCE = 1e-5

# Two seeds on one device, on two (a seed each) and on four (a pair for each seed, which shares its episodes).
AGREEMENT = """
import collections, dataclasses, json, re, sys
import jax, numpy as np
from support import tiny_world as tiny
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import make_trainer
from jaxnav.errors import InputError
from jaxnav.layout import ESTIMATORS
from jaxnav.training.config import PPOConfig
from jaxnav.training.devices import Devices

config = dataclasses.replace(
    RunConfig(), arms=("layout",), seeds=2, chunk=2, sizes=tiny.SIZES,
    ppo=PPOConfig(num_envs=16, rollout=6, minibatches=2, learning_rate=1e-2),
)
env, params = tiny.world()

exchanged = {}

def policies(count):
    parts = config, env, ESTIMATORS["calibrated"], tiny.knowledge()
    mesh = Devices(count=count).mesh(num_seeds=2, num_envs=16, minibatches=2)
    trainer = make_trainer(*parts, mesh if count > 1 else None)
    states = trainer.init(params)
    shards = trainer.unpack(states)["layout"][0].agent.state.pose.addressable_shards
    assert [shard.data.shape[0] for shard in shards] == {1: [16], 2: [16, 16], 4: [8, 8, 8, 8]}[count]
    for _ in range(2):
        states, metrics = trainer.train(states, params)
    exchanged[count] = exchanges(trainer._compiled["layout", 0].as_text())
    return [
        {
            "params": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state.params)]).tolist(),
            "poses": np.asarray(state.agent.state.pose).tolist(),
            "metrics": values,
        }
        for state, values in zip(trainer.unpack(states)["layout"], metrics["layout"])
    ]

def exchanges(text):
    # How often each stands in a compiled program.
    found = re.findall(r"= (\\(?).*? (all-reduce|all-gather|all-to-all|collective-permute)\\(", text)
    assert not any(several for several, _ in found)  # gloo would walk the arrays one by one
    return collections.Counter(kind for _, kind in found)

found = {count: policies(count) for count in map(int, sys.argv[1:])}
found["exchanged"] = exchanged
try:
    Devices(count=4).mesh(num_seeds=2, num_envs=18, minibatches=2)
except InputError as error:
    found["refused"] = str(error)
print(json.dumps(found))
"""


@functools.cache
def trained(*counts):
    """Policies of runs on so many devices each, by their number."""
    path = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    process = run(["-c", AGREEMENT, *counts], PYTHONPATH=path, XLA_FLAGS=flags, JAX_PLATFORMS="cpu")
    output, error = process.communicate(timeout=200)
    assert process.returncode == 0, error
    return json.loads(output)


def distance(a, b):
    return np.abs(np.subtract(a["params"], b["params"])).max()


@pytest.mark.parametrize("devices", params_by_tier([2, 4], slow=[4]))
def test_any_number_of_devices_trains_the_same_policies(devices):
    result = trained(1, 4) | (trained(devices) if devices != 4 else {})
    for ours, theirs in zip(result["1"], result[str(devices)], strict=True):
        assert distance(ours, theirs) < TOLERANCE
        assert ours["poses"] == theirs["poses"]
        assert theirs["metrics"] == pytest.approx(ours["metrics"], rel=1e-3, abs=TOLERANCE)


@pytest.mark.slow
def test_another_seed_is_another_policy():
    assert distance(*trained(1, 4)["1"]) > 100 * TOLERANCE


@pytest.mark.slow
def test_devices_exchange_a_few_single_arrays():
    """By seeds the metrics of a call; by episodes also, of a minibatch, moments and gradient, and sums of episodes."""
    assert trained(2)["exchanged"] == {"2": {"all-gather": 1}}
    assert trained(1, 4)["exchanged"] == {"1": {}, "4": {"all-gather": 1, "all-reduce": 3}}


@pytest.mark.exhaustive
def test_devices_that_cannot_be_shared_out_are_refused():
    assert trained(1, 4)["refused"] == (
        "config: ppo.num_envs is 18; with 4 devices and 2 seeds, 2 devices share the episodes of a seed: "
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


@pytest.mark.parametrize(
    "text",
    ["0", "-1", "two", "host:1,2,2", "host,0,2", "host:1,0", "", "1000001", "host:65536,0,2", "host:1,0,1000001"],
)
def test_other_devices_are_refused(text, tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / "run", f"--devices={text}") == 2
    message = refusal(capsys).replace("'", "")  # what reads as a number is not quoted
    assert f"devices is {text}; give a number, `cluster` or HOST:PORT,INDEX,PROCESSES" in message


def test_more_devices_than_there_are_are_refused(tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / "run", "--devices", 99) == 2
    assert "devices is 99, but JAX has 1; give fewer, or divide a CPU by XLA_FLAGS=" in refusal(capsys)
    assert not (tmp_path / "run").exists()
