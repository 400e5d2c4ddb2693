"""A run on several devices equals the run on one device up to the order of sums; the option `--devices` is checked."""

import functools
import json
import os

import numpy as np
import pytest
from support.commands import refusal, train
from support.processes import REPOSITORY, start_python
from support.tiers import params_by_tier
from support.tiny_run import write_config

from jaxnav.training.devices import Devices

#: Parameters are of the order of 0.1 to 1, and four updates move them by up to 0.04 with this learning rate.
TOLERANCE = 1e-5

#: Program that trains two seeds on one device, on two devices (a seed each) and on four devices (two for each seed,
#: which share its episodes), and prints the results as JSON.
TRAINING_PROGRAM = """
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

collectives_by_count = {}

def train_policies(num_devices):
    mesh = Devices(count=num_devices).mesh(num_seeds=2, num_envs=16, minibatches=2)
    if num_devices == 1:
        mesh = None
    trainer = make_trainer(config, env, ESTIMATORS["calibrated"], tiny.knowledge(), mesh)

    # Each device holds the episodes of a seed, or half of them.
    states = trainer.init(params)
    shards = trainer.unpack(states)["layout"][0].agent.state.pose.addressable_shards
    expected_sizes = {1: [16], 2: [16, 16], 4: [8, 8, 8, 8]}
    assert [shard.data.shape[0] for shard in shards] == expected_sizes[num_devices]

    for _ in range(2):
        states, metrics = trainer.train(states, params)
    collectives_by_count[num_devices] = count_collectives(trainer._compiled["layout", 0].as_text())

    policies = []
    for state, values in zip(trainer.unpack(states)["layout"], metrics["layout"]):
        policies.append({
            "params": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state.params)]).tolist(),
            "poses": np.asarray(state.agent.state.pose).tolist(),
            "metrics": values,
        })
    return policies

def count_collectives(program_text):
    # Number of collective operations of each kind in a compiled program.
    matches = re.findall(r"= (\\(?).*? (all-reduce|all-gather|all-to-all|collective-permute)\\(", program_text)
    assert not any(is_tuple for is_tuple, _ in matches)  # gloo would exchange the arrays of a tuple one by one
    return collections.Counter(kind for _, kind in matches)

results = {num_devices: train_policies(num_devices) for num_devices in map(int, sys.argv[1:])}
results["collectives"] = collectives_by_count
try:
    Devices(count=4).mesh(num_seeds=2, num_envs=18, minibatches=2)
except InputError as error:
    results["refusal"] = str(error)
print(json.dumps(results))
"""


@functools.cache
def train_on_devices(*device_counts):
    """Policies of one run for each number of devices, by this number as a string."""
    path = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    process = start_python(
        ["-c", TRAINING_PROGRAM, *device_counts], PYTHONPATH=path, XLA_FLAGS=flags, JAX_PLATFORMS="cpu"
    )
    output, error = process.communicate(timeout=200)
    assert process.returncode == 0, error
    return json.loads(output)


def params_distance(policy, other_policy):
    """Largest absolute difference between the parameters of two policies."""
    return np.abs(np.subtract(policy["params"], other_policy["params"])).max()


@pytest.mark.parametrize("num_devices", params_by_tier([2, 4], slow=[4]))
def test_any_number_of_devices_trains_equal_policies(num_devices):
    results = train_on_devices(1, 4)
    if num_devices != 4:
        results = results | train_on_devices(num_devices)
    for single_policy, shared_policy in zip(results["1"], results[str(num_devices)], strict=True):
        assert params_distance(single_policy, shared_policy) < TOLERANCE
        assert single_policy["poses"] == shared_policy["poses"]
        assert shared_policy["metrics"] == pytest.approx(single_policy["metrics"], rel=1e-3, abs=TOLERANCE)


@pytest.mark.slow
def test_another_seed_is_another_policy():
    assert params_distance(*train_on_devices(1, 4)["1"]) > 100 * TOLERANCE


@pytest.mark.slow
def test_devices_exchange_a_few_single_arrays():
    """Devices that divide the seeds gather the metrics of a call.

    Devices that divide the episodes of a seed also sum the moments and the gradient of a minibatch, and the sums over
    episodes.
    """
    assert train_on_devices(2)["collectives"] == {"2": {"all-gather": 1}}
    assert train_on_devices(1, 4)["collectives"] == {"1": {}, "4": {"all-gather": 1, "all-reduce": 3}}


@pytest.mark.exhaustive
def test_devices_that_cannot_share_the_episodes_evenly_are_refused():
    assert train_on_devices(1, 4)["refusal"] == (
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
def test_devices_option_is_parsed(text, devices):
    assert Devices.parse(text) == devices


@pytest.mark.parametrize(
    "text",
    ["0", "-1", "two", "host:1,2,2", "host,0,2", "host:1,0", "", "1000001", "host:65536,0,2", "host:1,0,1000001"],
)
def test_devices_option_in_another_form_is_refused(text, tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / "run", f"--devices={text}") == 2
    message = refusal(capsys).replace("'", "")  # the message quotes only texts that are no numbers
    assert f"devices is {text}; give a number, `cluster` or HOST:PORT,INDEX,PROCESSES" in message


def test_more_devices_than_the_machine_has_are_refused(tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / "run", "--devices", 99) == 2
    assert "devices is 99, but JAX has 1; give fewer, or divide a CPU by XLA_FLAGS=" in refusal(capsys)
    assert not (tmp_path / "run").exists()
