"""Training on several devices and processes.

`python benchmarks/scaling.py` takes two cores or more, and 3 minutes.

Weak scaling: every device brings as many episodes as the default run has, of one seed of the arm with the layout.

- `processes`: two processes, each held to one core, that train alone (one at a time), apart (both, each for itself),
  as one run that shares out two seeds, and as one that shares the episodes of a seed, in turns. As one against apart is
  the price of being one run; apart against alone that of sharing the machine's memory and power. A call does as many
  updates as the default run's; where episodes are shared, which is slow, it does one.
- `all_reduce`: seconds of a mean over both processes by its bytes, its latency and its bandwidth; with each process
  held to one core (`pinned`), where it takes until the scheduler's next tick, and free to use both.
- `exchanged`: what one call of either exchanges, counted in the compiled program.
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

EPISODES, CALL, TURNS, SUMS, SHORT = 256, 16, 4, 20, 100  # CALL: updates of a call, as in the default run
BYTES = [2**9, 2**12, 2**14, 2**16, 2**20, 2**24]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        results = pair("process", folder)
    results["all_reduce"]["free"] = pair("network")
    simulated = start(["simulated"], flags="--xla_force_host_platform_device_count=4")
    results["simulated"] = json.loads(simulated.communicate()[0])

    from _common import report

    report({"episodes_per_device": EPISODES, "updates_per_call": CALL, **results})


def pair(role: str, *arguments: str) -> dict:
    """Return what the first of two processes measures."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    cores = sorted(os.sched_getaffinity(0))
    both = [start([role, address, index, cores[index], *arguments], address) for index in (0, 1)]
    said, _ = [process.communicate()[0] for process in both]
    return json.loads(said.splitlines()[-1])  # gloo speaks first


def start(arguments: list, address: str = "", flags: str = "") -> subprocess.Popen:
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_COORDINATOR_BIND_ADDRESS": address or "127.0.0.1:0"}
    command = [sys.executable, __file__, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def process(address: str, index: str, core: str, folder: str) -> None:
    """Be one of two processes; the first one prints."""
    os.sched_setaffinity(0, {int(core)})  # before JAX counts the cores
    began = time.perf_counter()
    from _common import in_turns, rates, ratios, spread
    from _scaling import Training, collectives, local_mesh, log_spread
    from jax.experimental.multihost_utils import sync_global_devices

    from jaxnav.training.devices import Devices, first_process

    devices = Devices(address=address, process=int(index), processes=2)
    devices.connect()
    joining = time.perf_counter() - began
    trainings = {
        "alone": Training(local_mesh(), EPISODES, updates=CALL),
        "apart": Training(local_mesh(), EPISODES, updates=CALL),
        "shared_seeds": Training(devices.mesh(2, EPISODES, 1), EPISODES, seeds=2, updates=CALL),
        "shared_episodes": Training(devices.mesh(1, 2 * EPISODES, 1), 2 * EPISODES),
        "two_epochs_alone": Training(local_mesh(), EPISODES, updates=CALL, epochs=2),
    }
    together = trainings["shared_episodes"]
    compiling = together.seconds()

    def turn(name: str) -> None:
        if first_process() or not name.endswith("alone"):
            trainings[name].train()
        sync_global_devices("turn")

    calls = in_turns({name: partial(turn, name) for name in trainings}, TURNS)
    taken = {name: [one / trainings[name].updates for one in times] for name, times in calls.items()}
    sums = means(together.mesh)
    saving, logging = together.save(Path(folder)), together.log(Path(folder))
    short = Training(local_mesh(), EPISODES // 16, minibatches=1)
    short.train()  # compiles
    jitter = [short.seconds() for _ in range(SHORT)]
    if not first_process():
        return
    update = {name: statistics.median(times) for name, times in taken.items()}
    as_one = ("shared_seeds", "shared_episodes")
    steps = {name: trainings[name].steps * (2 if name == "apart" else 1) for name in ("alone", "apart", *as_one)}
    results = {
        "processes": {
            "steps_per_s": {name: rates(taken[name], count) for name, count in steps.items()},
            "to_apart": {name: ratios(taken["apart"], taken[name]) for name in as_one},
            "to_alone": {name: ratios(taken["alone"], taken[name]) for name in ("apart", *as_one)},
        },
        "all_reduce": {"pinned": sums},
        "exchanged": {name: collectives(trainings[name].program) for name in as_one},
        "update": {
            "rollout_s": round(2 * update["alone"] - update["two_epochs_alone"], 4),
            "learning_s": round(update["two_epochs_alone"] - update["alone"], 4),
            **together.sizes(),
            "join_s": round(joining, 2),
            "compile_s": round(compiling - update["shared_episodes"], 2),
            "save_s": round(saving, 3),
            "log_s": round(logging, 6),
        },
        "jitter": {"seconds": spread(jitter), "log_standard_deviation": log_spread(jitter)},
    }
    print(json.dumps(results))


def means(mesh) -> dict:
    """Return the seconds of means over a mesh."""
    from _common import spread
    from _scaling import all_reduce, line

    sums = {size: all_reduce(mesh, size, SUMS) for size in BYTES}
    return {"seconds": {str(size): spread(times) for size, times in sums.items()}, **line(sums)}


def network(address: str, index: str, _: str) -> None:
    """Be one of two processes that only take means."""
    from jaxnav.training.devices import Devices

    devices = Devices(address=address, process=int(index), processes=2)
    devices.connect()
    print(json.dumps(means(devices.mesh(1, 2, 1))))


def simulated() -> None:
    """Train on 1, 2 and 4 devices of one process."""
    from _common import in_turns, rates, ratios
    from _scaling import Training

    from jaxnav.training.devices import Devices

    trainings = {n: Training(Devices(count=n).mesh(1, n * EPISODES // 2, 1), n * EPISODES // 2) for n in (1, 2, 4)}
    taken = in_turns({str(n): training.train for n, training in trainings.items()}, TURNS)
    results = {name: {"steps_per_s": rates(times, trainings[int(name)].steps)} for name, times in taken.items()}
    for name in ("2", "4"):
        results[name]["efficiency_of_the_same_cores"] = ratios([int(name) * one for one in taken["1"]], taken[name])
    print(json.dumps(results))


if __name__ == "__main__":
    role = {"process": process, "network": network, "simulated": simulated}[sys.argv[1]] if len(sys.argv) > 1 else main
    role(*sys.argv[2:])
