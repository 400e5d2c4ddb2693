"""Training on several devices and processes.

`python benchmarks/scaling.py` takes two cores or more, and 3 minutes; `simulate.py` computes with its results.

Weak scaling: every device brings as many episodes as the default run has, of one seed of the arm with the layout.

- `processes`: two processes, each pinned to one core, that train alone (one at a time), apart (both, each for itself),
  as one run that divides two seeds, and as one that divides the episodes of a seed, in turns. One run against apart is
  the cost of being one run; apart against alone that of sharing the machine's memory and power. A call does as many
  updates as the default run's, and one where episodes are divided, which is slow.
- `all_reduce`: latency and bandwidth of a mean over both processes; with each process held to one core (`pinned`),
  where it takes until the scheduler's next tick, and free to use both.
- `exchanged`: arrays and bytes that one call of either run exchanges, counted in the compiled program.
- `update`: seconds of its rollout and of its learning (what a second epoch adds) alone; bytes of the parameters and of
  a device's episodes; seconds to join, to compile, to save a checkpoint and to log.
- `jitter`: spread of the logarithms of the seconds of the work between two sums, over and over.
- `simulated`: 1, 2 and 4 devices that share this machine's cores. They show that nothing but sums is added: the cores
  are the same, so steps per second cannot grow beyond what the cores give.
"""

import dataclasses
import json
import math
import os
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report, ratio_by_turn, steps_per_second, time_call, time_in_turns
from _setup import set_up_training
from jax.experimental.multihost_utils import sync_global_devices
from jax.sharding import Mesh, PartitionSpec

from jaxnav.numerics.device_means import ENV_AXIS, SEED_AXIS
from jaxnav.runs.config import LayoutConfig, RunConfig
from jaxnav.store.checkpoint import save_checkpoint
from jaxnav.store.files import append_log_rows, make_manifest
from jaxnav.training.devices import Devices, is_first_process

NUM_EPISODES = 256
#: Updates of a call, as in the default run.
UPDATES_PER_CALL = 16
TURNS = 4
#: Means in a timed call, and bytes of the arrays.
NUM_MEANS = 20
MEAN_BYTES = [2**9, 2**12, 2**14, 2**16, 2**20, 2**24]
#: Short updates that measure the jitter.
NUM_JITTER_RUNS = 100
#: Operations of XLA by which devices exchange arrays.
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter", "collective-broadcast")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        results = run_pair("process", folder, pinned=True)
    results["all_reduce"]["free"] = run_pair("network")
    simulation = start_process(["simulated"], XLA_FLAGS="--xla_force_host_platform_device_count=4")
    results["simulated"] = json.loads(simulation.communicate()[0])
    print_report({"episodes_per_device": NUM_EPISODES, "updates_per_call": UPDATES_PER_CALL, **results})


def run_pair(role: str, *arguments: str, pinned: bool = False) -> dict:
    """Run two processes, pinned to one core each or free, and return the measurements of the first."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"

    # A process inherits the cores that its parent may use when it starts, and JAX counts them once.
    all_cores = os.sched_getaffinity(0)
    processes = []
    for index, core in zip((0, 1), sorted(all_cores), strict=False):
        os.sched_setaffinity(0, {core} if pinned else all_cores)
        command = [role, address, str(index), *arguments]
        processes.append(start_process(command, JAX_COORDINATOR_BIND_ADDRESS=address))
    os.sched_setaffinity(0, all_cores)
    first_output, _ = [process.communicate()[0] for process in processes]

    # gloo prints lines of its own, before the report and sometimes after it.
    reports = [line for line in first_output.splitlines() if line.startswith("{")]
    return json.loads(reports[-1])


def start_process(arguments: list[str], **variables: str) -> subprocess.Popen:
    """Start this script in a role of `ROLES`, with these environment variables."""
    command = [sys.executable, __file__, *arguments]
    return subprocess.Popen(command, env=os.environ | variables, stdout=subprocess.PIPE, text=True)


# Training


class Training:
    """Training of the arm with the layout on a mesh.

    Attributes:
      mesh: of devices.
      num_updates: updates of one call of `train`.
      steps_per_update: environment steps of all seeds.
    """

    def __init__(self, mesh: Mesh, num_episodes: int, seeds: int = 1, num_updates: int = 1, **ppo: int) -> None:
        config = RunConfig(seeds=seeds, arms=("layout",), chunk=num_updates, layout=LayoutConfig(walks=64, steps=20))
        config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=num_episodes, **ppo))
        self.mesh = mesh
        self.num_updates = num_updates
        self.steps_per_update = config.steps_per_update * seeds

        setup = set_up_training(config, mesh)
        self._trainer = setup.trainer
        self._params = setup.params
        self._states = self._trainer.init(self._params)

    def train(self) -> None:
        self._states, _ = self._trainer.train(self._states, self._params)

    def save(self, folder: Path) -> None:
        save_checkpoint(folder, 1, self._trainer.unpack(self._states), make_manifest({}))

    def count_bytes(self) -> dict[str, int]:
        """Return the bytes of the parameters and of a device's episodes."""
        state = self._trainer.unpack(self._states)["layout"][0]
        agent_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(state.agent))
        return {
            "parameter_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(state.params)),
            "agent_bytes": agent_bytes // self.mesh.size,
        }

    @property
    def program_text(self) -> str:
        """Text of the compiled updates."""
        return self._trainer._compiled["layout", 0].as_text()


def make_local_mesh() -> Mesh:
    """Return a mesh of this process's devices."""
    return Mesh(np.array(jax.local_devices())[None], (SEED_AXIS, ENV_AXIS))


def measure_processes(address: str, index: str, folder: str) -> None:
    """Train as one of two processes; the first prints the results."""
    devices = Devices(address=address, process=int(index), processes=2)
    start_time = time.perf_counter()
    devices.connect()
    join_s = time.perf_counter() - start_time

    # Both processes compile all trainings.
    trainings = {
        "alone": Training(make_local_mesh(), NUM_EPISODES, num_updates=UPDATES_PER_CALL),
        "apart": Training(make_local_mesh(), NUM_EPISODES, num_updates=UPDATES_PER_CALL),
        "shared_seeds": Training(devices.mesh(2, NUM_EPISODES, 1), NUM_EPISODES, seeds=2, num_updates=UPDATES_PER_CALL),
        "shared_episodes": Training(devices.mesh(1, 2 * NUM_EPISODES, 1), 2 * NUM_EPISODES),
        "two_epochs_alone": Training(make_local_mesh(), NUM_EPISODES, num_updates=UPDATES_PER_CALL, epochs=2),
    }
    shared_training = trainings["shared_episodes"]
    first_call_s = time_call(shared_training.train)

    def train_in_turn(name: str) -> None:
        # The second process waits while the first trains alone.
        if is_first_process() or not name.endswith("alone"):
            trainings[name].train()
        sync_global_devices("turn")

    call_times = time_in_turns({name: partial(train_in_turn, name) for name in trainings}, TURNS)
    update_times = {}
    for name, times in call_times.items():
        update_times[name] = [call_time / trainings[name].num_updates for call_time in times]
    median_update = {name: statistics.median(times) for name, times in update_times.items()}

    # Constants of an update, for `simulate.py`.
    all_reduce = measure_all_reduce(shared_training.mesh)
    save_s = time_call(partial(shared_training.save, Path(folder)))
    num_bytes = shared_training.count_bytes()
    log_row = {"step": 1, **{str(number): 1.0 for number in range(12)}}
    log_s = time_call(partial(append_log_rows, Path(folder, "log"), [log_row]))
    short_training = Training(make_local_mesh(), NUM_EPISODES // 16, minibatches=1)
    short_training.train()  # compiles
    jitter = [time_call(short_training.train) for _ in range(NUM_JITTER_RUNS)]
    if not is_first_process():
        return

    rates = {}
    for name in ("alone", "apart", "shared_seeds", "shared_episodes"):
        num_runs = 2 if name == "apart" else 1
        rates[name] = steps_per_second(update_times[name], trainings[name].steps_per_update * num_runs)
    to_apart = {}
    exchanged = {}
    for name in ("shared_seeds", "shared_episodes"):
        to_apart[name] = ratio_by_turn(update_times["apart"], update_times[name])
        exchanged[name] = count_collectives(trainings[name].program_text)
    results = {
        "processes": {
            "steps_per_s": rates,
            "to_apart": to_apart,
            "to_alone": {"apart": ratio_by_turn(update_times["alone"], update_times["apart"])},
        },
        "all_reduce": {"pinned": all_reduce},
        "exchanged": exchanged,
        "update": {
            "rollout_s": round(2 * median_update["alone"] - median_update["two_epochs_alone"], 4),
            "learning_s": round(median_update["two_epochs_alone"] - median_update["alone"], 4),
            **num_bytes,
            "join_s": round(join_s, 2),
            "compile_s": round(first_call_s - median_update["shared_episodes"], 2),
            "save_s": round(save_s, 3),
            "log_s": round(log_s, 6),
        },
        "jitter": {"log_standard_deviation": round(float(np.log(jitter).std()), 4)},
    }
    print(json.dumps(results))


def measure_simulated_devices() -> None:
    """Train on 1, 2 and 4 simulated devices of one process."""
    trainings = {}
    for num_devices in (1, 2, 4):
        num_episodes = num_devices * NUM_EPISODES // 2
        trainings[num_devices] = Training(Devices(count=num_devices).mesh(1, num_episodes, 1), num_episodes)

    # All share the same cores, so n devices ideally take n times as long as one.
    times = time_in_turns({str(num_devices): training.train for num_devices, training in trainings.items()}, TURNS)
    results = {}
    for num_devices, training in trainings.items():
        device_times = times[str(num_devices)]
        results[str(num_devices)] = {"steps_per_s": steps_per_second(device_times, training.steps_per_update)}
        if num_devices > 1:
            ideal_times = [num_devices * seconds for seconds in times["1"]]
            efficiency = ratio_by_turn(ideal_times, device_times)
            results[str(num_devices)]["efficiency_of_the_same_cores"] = efficiency
    print(json.dumps(results))


# Means over processes


def measure_network(address: str, index: str) -> None:
    """Compute means over the mesh as one of two processes, free to use all cores."""
    devices = Devices(address=address, process=int(index), processes=2)
    devices.connect()
    print(json.dumps(measure_all_reduce(devices.mesh(1, 2, 1))))


def measure_all_reduce(mesh: Mesh) -> dict[str, float]:
    """Return latency and bandwidth of means over a mesh."""
    return fit_latency_and_bandwidth({size: time_all_reduce(mesh, size) for size in MEAN_BYTES})


def time_all_reduce(mesh: Mesh, num_bytes: int) -> list[float]:
    """Return the seconds of a mean of an array of so many bytes over the mesh, measured several times."""

    @jax.jit
    @partial(jax.shard_map, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec())
    def repeat_means(array: jax.Array) -> jax.Array:
        def step(_: Any, array: jax.Array) -> jax.Array:
            return jax.lax.pmean(array + jax.lax.axis_index(ENV_AXIS), ENV_AXIS)

        return jax.lax.fori_loop(0, NUM_MEANS, step, array)

    # The array is float32; the first call compiles.
    array = jnp.zeros(num_bytes // 4)
    jax.block_until_ready(repeat_means(array))
    return [time_call(lambda: repeat_means(array)) / NUM_MEANS for _ in range(5)]


def fit_latency_and_bandwidth(times_by_size: Mapping[int, Sequence[float]]) -> dict[str, float]:
    """Return the latency and the bandwidth of means over a mesh.

    The latency is the median over arrays of up to 64 kB; the bandwidth follows from how much longer the largest takes.

    Args:
      times_by_size: seconds by bytes.
    """
    medians = {size: float(np.median(times)) for size, times in times_by_size.items()}
    latency = float(np.median([seconds for size, seconds in medians.items() if size <= 2**16]))
    largest_size = max(medians)
    transfer_time = max(medians[largest_size] - latency, 1e-6)
    return {
        "latency_s": float(f"{latency:.3g}"),
        "bytes_per_s": float(f"{largest_size / transfer_time:.3g}"),
    }


# Exchanges in a compiled program


def count_collectives(program_text: str) -> dict[str, dict[str, int]]:
    """Return calls, arrays and bytes that one call of a compiled program exchanges, by kind of operation.

    Operations in a loop count once per iteration.
    """
    # Divide the text into its computations, by name.
    computations: dict[str, list[str]] = {}
    name = ""
    for line in program_text.splitlines():
        header = re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", line)
        if header:
            name = "ENTRY" if header[1] else header[2]
            computations[name] = []
        elif name:
            computations[name].append(line)

    def count(name: str) -> np.ndarray:
        """Return calls, arrays and bytes of a computation and of those it calls, int [kinds, 3]."""
        total = np.zeros((len(COLLECTIVES), 3), int)
        for line in computations[name]:
            collective = re.search(rf"= (.*?) ({'|'.join(COLLECTIVES)})\(", line)
            if collective:
                arrays = re.findall(r"([a-z]+\d*)\[([\d,]*)\]", collective[1])
                sizes = [count_array_bytes(dtype, shape) for dtype, shape in arrays]
                total[COLLECTIVES.index(collective[2])] += 1, len(sizes), sum(sizes)

            trip_count = re.search(r'"known_trip_count":\{"n":"(\d+)"\}', line)
            repeats = int(trip_count[1]) if trip_count else 1
            for callee in re.findall(r"(?:body|calls|to_apply|branch_computations)=\{?%?([\w.\-]+)", line):
                total += count(callee) * repeats
        return total

    counts = {}
    for kind, (num_calls, num_arrays, num_bytes) in zip(COLLECTIVES, count("ENTRY").tolist(), strict=True):
        if num_calls:
            counts[kind] = {"calls": num_calls, "arrays": num_arrays, "bytes": num_bytes}
    return counts


def count_array_bytes(dtype: str, shape: str) -> int:
    """Return the bytes of an array such as f32[3,4]."""
    bits = re.search(r"\d+", dtype)
    num_elements = math.prod(int(size) for size in shape.split(",") if size)
    return num_elements * (int(bits[0]) // 8 if bits else 1)


#: Functions that a process of this script may run.
ROLES = {"process": measure_processes, "network": measure_network, "simulated": measure_simulated_devices}

if __name__ == "__main__":
    role = ROLES[sys.argv[1]] if len(sys.argv) > 1 else main
    role(*sys.argv[2:])
