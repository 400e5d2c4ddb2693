"""Training on several devices and processes.

`python benchmarks/scaling.py` takes two cores or more, and 3 minutes.

Weak scaling: every device brings as many episodes as the default run has, of one seed of the arm with the layout.

- `processes`: two processes, each pinned to one core, that train alone (one at a time), apart (both, each for itself),
  as one run that divides two seeds, and as one that divides the episodes of a seed, in turns. One run against apart is
  the cost of being one run; apart against alone that of sharing the machine's memory and power. A call does as many
  updates as the default run's, and one where episodes are divided, which is slow.
- `all_reduce`: seconds of a mean over both processes by its bytes, its latency and its bandwidth; with each process
  held to one core (`pinned`), where it takes until the scheduler's next tick, and free to use both.
- `exchanged`: arrays and bytes that one call of either run exchanges, counted in the compiled program.
- `update`: seconds of its rollout and of its learning (what a second epoch adds) alone; bytes of the parameters and of
  a device's episodes; seconds to join, to compile, to save a checkpoint and to log.
- `jitter`: seconds of the work between two sums, over and over; spread of their logarithms.
- `simulated`: 1, 2 and 4 devices that share this machine's cores. They show that nothing but sums is added: the cores
  are the same, so steps per second cannot grow beyond what the cores give.
"""

import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

NUM_EPISODES = 256
#: Updates of a call, as in the default run.
UPDATES_PER_CALL = 16
TURNS = 4
#: Means in a timed call, and bytes of the arrays.
NUM_MEANS = 20
MEAN_BYTES = [2**9, 2**12, 2**14, 2**16, 2**20, 2**24]
#: Short updates that measure the jitter.
NUM_JITTER_RUNS = 100

# Each process imports JAX only after its cores and devices are set, so imports are in the functions.


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        results = run_pair("process", folder)
    results["all_reduce"]["free"] = run_pair("network")
    simulation = start_process(["simulated"], xla_flags="--xla_force_host_platform_device_count=4")
    results["simulated"] = json.loads(simulation.communicate()[0])

    from _common import print_report

    print_report({"episodes_per_device": NUM_EPISODES, "updates_per_call": UPDATES_PER_CALL, **results})


def run_pair(role: str, *arguments: str) -> dict:
    """Run two processes and return the measurements of the first."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    cores = sorted(os.sched_getaffinity(0))
    processes = [start_process([role, address, index, cores[index], *arguments], address) for index in (0, 1)]
    first_output, _ = [process.communicate()[0] for process in processes]
    return json.loads(first_output.splitlines()[-1])  # gloo prints lines before


def start_process(arguments: list, address: str = "", xla_flags: str = "") -> subprocess.Popen:
    """Start this script in a role of `ROLES`."""
    environment = os.environ | {"XLA_FLAGS": xla_flags, "JAX_COORDINATOR_BIND_ADDRESS": address or "127.0.0.1:0"}
    command = [sys.executable, __file__, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def measure_processes(address: str, index: str, core: str, folder: str) -> None:
    """Train as one of two processes; the first prints the results."""
    os.sched_setaffinity(0, {int(core)})  # before JAX counts the cores
    start_time = time.perf_counter()
    from _common import ratio_by_turn, steps_per_second, summarize, time_in_turns
    from _scaling import Training, count_collectives, log_spread, make_local_mesh
    from jax.experimental.multihost_utils import sync_global_devices

    from jaxnav.training.devices import Devices, is_first_process

    devices = Devices(address=address, process=int(index), processes=2)
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
    first_call_s = shared_training.time_train()

    def train_in_turn(name: str) -> None:
        # The second process waits while the first trains alone.
        if is_first_process() or not name.endswith("alone"):
            trainings[name].train()
        sync_global_devices("turn")

    call_times = time_in_turns({name: partial(train_in_turn, name) for name in trainings}, TURNS)
    update_times = {}
    for name, times in call_times.items():
        update_times[name] = [call_time / trainings[name].num_updates for call_time in times]

    # Constants of an update, for `simulate.py`.
    all_reduce = measure_all_reduce(shared_training.mesh)
    save_s = shared_training.time_save(Path(folder))
    log_s = shared_training.time_log(Path(folder))
    short_training = Training(make_local_mesh(), NUM_EPISODES // 16, minibatches=1)
    short_training.train()  # compiles
    jitter = [short_training.time_train() for _ in range(NUM_JITTER_RUNS)]
    if not is_first_process():
        return

    median_update = {name: statistics.median(times) for name, times in update_times.items()}
    shared = ("shared_seeds", "shared_episodes")
    rates = {}
    for name in ("alone", "apart", *shared):
        num_runs = 2 if name == "apart" else 1
        rates[name] = steps_per_second(update_times[name], trainings[name].steps_per_update * num_runs)
    results = {
        "processes": {
            "steps_per_s": rates,
            "to_apart": {name: ratio_by_turn(update_times["apart"], update_times[name]) for name in shared},
            "to_alone": {name: ratio_by_turn(update_times["alone"], update_times[name]) for name in ("apart", *shared)},
        },
        "all_reduce": {"pinned": all_reduce},
        "exchanged": {name: count_collectives(trainings[name].program_text) for name in shared},
        "update": {
            "rollout_s": round(2 * median_update["alone"] - median_update["two_epochs_alone"], 4),
            "learning_s": round(median_update["two_epochs_alone"] - median_update["alone"], 4),
            **shared_training.count_bytes(),
            "join_s": round(join_s, 2),
            "compile_s": round(first_call_s - median_update["shared_episodes"], 2),
            "save_s": round(save_s, 3),
            "log_s": round(log_s, 6),
        },
        "jitter": {"seconds": summarize(jitter), "log_standard_deviation": log_spread(jitter)},
    }
    print(json.dumps(results))


def measure_all_reduce(mesh) -> dict:
    """Return the seconds of means over a mesh by their bytes, with latency and bandwidth."""
    from _common import summarize
    from _scaling import fit_latency_and_bandwidth, time_all_reduce

    times_by_size = {size: time_all_reduce(mesh, size, NUM_MEANS) for size in MEAN_BYTES}
    seconds = {str(size): summarize(times) for size, times in times_by_size.items()}
    return {"seconds": seconds, **fit_latency_and_bandwidth(times_by_size)}


def measure_network(address: str, index: str, _: str) -> None:
    """Compute means over the mesh as one of two processes, free to use all cores."""
    from jaxnav.training.devices import Devices

    devices = Devices(address=address, process=int(index), processes=2)
    devices.connect()
    print(json.dumps(measure_all_reduce(devices.mesh(1, 2, 1))))


def measure_simulated_devices() -> None:
    """Train on 1, 2 and 4 simulated devices of one process."""
    from _common import ratio_by_turn, steps_per_second, time_in_turns
    from _scaling import Training

    from jaxnav.training.devices import Devices

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


#: Functions that a process of this script may run.
ROLES = {"process": measure_processes, "network": measure_network, "simulated": measure_simulated_devices}

if __name__ == "__main__":
    role = ROLES[sys.argv[1]] if len(sys.argv) > 1 else main
    role(*sys.argv[2:])
