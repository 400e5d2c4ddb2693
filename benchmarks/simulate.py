"""Cost of 10^11 environment steps on many hosts.

`python benchmarks/simulate.py` computes it for 1 to 1,000 hosts and puts the tables into docs/scaling.md, with those of
what benchmarks/scaling.py measured (results/performance/scaling.json). From these constants and those stated in
`NETWORKS` and `Assumptions` it adds up an update, term by term, and simulates a run: noise that makes every sum over
the hosts wait for the slowest of them, and hosts that fail, after which all start again from the last checkpoint. A
host is one process on one core.
"""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np

from jaxnav.runs.config import RunConfig

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "results/performance/scaling.json"
DOCUMENT = ROOT / "docs/scaling.md"
NUM_STEPS = 10**11
NUM_HOSTS = (1, 2, 8, 64, 1000)
DEFAULT_CONFIG = RunConfig()
UPDATES_PER_SAVE = DEFAULT_CONFIG.chunk * DEFAULT_CONFIG.save_every
#: Episodes of all hosts if the batch does not grow with their number.
SHARED_EPISODES = 16384
#: Waits that are drawn.
NUM_SAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class Network:
    """A network between hosts.

    Attributes:
      message_s: seconds of one message.
      bytes_per_s: bandwidth.
      tree: whether sums are exchanged along a tree rather than a ring.
    """

    message_s: float
    bytes_per_s: float
    tree: bool = False

    def all_reduce(self, num_hosts: int, num_bytes: float) -> tuple[float, float]:
        """Return the seconds of latency and of transfer of a sum."""
        num_rounds = 2 * math.ceil(math.log2(num_hosts)) if self.tree else 2 * (num_hosts - 1)
        latency = num_rounds * self.message_s
        transfer = 2 * (num_hosts - 1) / num_hosts * num_bytes / self.bytes_per_s
        return latency, transfer


@dataclasses.dataclass(frozen=True)
class Assumptions:
    """Constants that cannot be measured on one machine.

    Attributes:
      days_between_failures: mean, of one host.
      detect_s: seconds until a silent process is noticed.
      disk_bytes_per_s: that all hosts write to the shared file system together.
    """

    days_between_failures: float = 100.0
    detect_s: float = 30.0
    disk_bytes_per_s: float = 1e9


#: Ethernet of 25 Gb/s.
NETWORKS = {"ethernet, ring": Network(30e-6, 2.5e9), "ethernet, tree": Network(30e-6, 2.5e9, tree=True)}


# The model


def simulate_hosts(measured: dict, network: Network, shared_batch: bool) -> list[dict]:
    """Return a row for every number of hosts.

    Args:
      measured: results of benchmarks/scaling.py.
      network: between the hosts.
      shared_batch: whether the hosts divide `SHARED_EPISODES`, rather than adding episodes to the batch.
    """
    rng = np.random.default_rng(0)
    host_episodes = measured["episodes_per_device"]
    restart_s = Assumptions().detect_s + measured["update"]["join_s"] + measured["update"]["compile_s"]

    rows = []
    single_host_s = 0.0
    for num_hosts in NUM_HOSTS:
        # Share of the measured episodes that each host has; every minibatch needs an episode of every host.
        share = SHARED_EPISODES / num_hosts / host_episodes if shared_batch else 1.0
        if share * host_episodes < DEFAULT_CONFIG.ppo.minibatches:
            break

        parts = estimate_update(measured, network, num_hosts, share, rng)
        update_s = sum(parts.values())
        steps_per_update = num_hosts * share * host_episodes * DEFAULT_CONFIG.ppo.rollout
        num_updates = math.ceil(NUM_STEPS / steps_per_update)
        run_s, num_failures = simulate_run(update_s, num_updates, num_hosts, restart_s, rng)
        single_host_s = single_host_s or run_s
        rows.append(
            {
                "hosts": num_hosts,
                "steps_per_update": round(steps_per_update),
                "share_percent": {name: round(100 * part / update_s, 2) for name, part in parts.items()},
                "failures": num_failures,
                "days": run_s / 86400,
                "efficiency": round(single_host_s / run_s / num_hosts, 3),
            }
        )
    return rows


def estimate_update(
    measured: dict, network: Network, num_hosts: int, share: float, rng: np.random.Generator
) -> dict[str, float]:
    """Return the seconds of each part of an update, if every host has `share` of the measured episodes."""
    update = measured["update"]
    rollout = share * update["rollout_s"]
    learning = share * update["learning_s"]

    # Between two minibatches noise slows every host independently, and all wait for the slowest.
    sigma = measured["jitter"]["log_standard_deviation"]
    noise = np.exp(sigma * rng.standard_normal((NUM_SAMPLES, num_hosts)) - sigma**2 / 2)
    slowdown = noise.max(axis=1).mean() / noise.mean()

    # Every array is summed over the hosts on its own.
    all_reduce = measured["exchanged"]["shared_episodes"]["all-reduce"]
    num_sums = all_reduce["arrays"]
    latency = 0.0
    transfer = 0.0
    if num_hosts > 1:
        latency, transfer = network.all_reduce(num_hosts, all_reduce["bytes"] / num_sums)
    save_s = update["save_s"] + num_hosts * share * update["agent_bytes"] / Assumptions().disk_bytes_per_s
    return {
        "rollout": rollout,
        "learning": learning,
        "waiting": (slowdown - 1) * (rollout + learning),
        "latency": num_sums * latency,
        "transfer": num_sums * transfer,
        "checkpoint": save_s / UPDATES_PER_SAVE,
        "log": update["log_s"],
    }


def simulate_run(
    update_s: float, num_updates: int, num_hosts: int, restart_s: float, rng: np.random.Generator
) -> tuple[float, int]:
    """Return the seconds and the number of failures of a run."""
    # The run consists of intervals from checkpoint to checkpoint.
    interval_s = UPDATES_PER_SAVE * update_s
    num_intervals = math.ceil(num_updates / UPDATES_PER_SAVE)
    mean_time_to_failure = Assumptions().days_between_failures * 86400 / num_hosts

    # The number of failures before an interval completes is geometric; each loses the time since the checkpoint.
    attempts = rng.geometric(math.exp(-interval_s / mean_time_to_failure), num_intervals)
    num_failures = int(attempts.sum()) - num_intervals
    failure_quantiles = rng.random(num_failures) * math.expm1(-interval_s / mean_time_to_failure)
    lost_s = -mean_time_to_failure * np.log1p(failure_quantiles)
    return num_intervals * interval_s + lost_s.sum() + num_failures * restart_s, num_failures


# The document


def format_simulation(rows: list[dict]) -> str:
    """Return a Markdown table of updates and runs."""
    parts = ("rollout", "learning", "waiting", "latency", "transfer", "checkpoint")
    headings = ["hosts", "steps per update", *(f"{part} %" for part in parts), "failures", "days", "efficiency"]
    lines = [" | ".join(headings), " | ".join("--:" for _ in headings)]
    for row in rows:
        shares = [f"{row['share_percent'][part]:.1f}" for part in parts]
        cells = [f"{row['hosts']:,}", f"{row['steps_per_update']:,}", *shares, f"{row['failures']:,}"]
        lines.append(" | ".join([*cells, f"{row['days']:,.3g}", f"{row['efficiency']:.2f}"]))
    return "\n".join(f"| {line} |" for line in lines)


def format_measurements(measured: dict) -> str:
    """Return Markdown tables of the measured constants."""
    simulated = measured["simulated"]
    update = measured["update"]
    rates = measured["processes"]["steps_per_s"]
    to_apart = measured["processes"]["to_apart"]
    to_alone = measured["processes"]["to_alone"]

    def row(name: str, rate: dict, efficiency: dict | None) -> str:
        cell = f"{efficiency['median']:.2f} ({efficiency['min']:.2f}-{efficiency['max']:.2f})" if efficiency else ""
        return f"| {name} | {rate['median']:,.0f} | {cell} |"

    # Sums over the processes, and exchanges of seeds that are divided over them.
    free = measured["all_reduce"]["free"]
    pinned = measured["all_reduce"]["pinned"]
    sums = measured["exchanged"]["shared_episodes"]["all-reduce"]
    seed_exchanges = measured["exchanged"]["shared_seeds"].values()
    calls = sum(exchange["calls"] for exchange in seed_exchanges)
    arrays = sum(exchange["arrays"] for exchange in seed_exchanges)
    jitter = measured["jitter"]["log_standard_deviation"]
    join_s = update["join_s"]
    compile_s = update["compile_s"]
    save_s = update["save_s"]
    megabytes = free["bytes_per_s"] / 1e6
    num_updates = measured["updates_per_call"]
    free_us = 1e6 * free["latency_s"]
    return "\n".join(
        [
            "| weak scaling | steps/s | efficiency |",
            "| :-- | --: | --: |",
            row("one process on one core, the other core idle", rates["alone"], None),
            row("two separate runs, relative to one alone", rates["apart"], to_alone["apart"]),
            row(
                "one run, a seed on each core, relative to two separate runs",
                rates["shared_seeds"],
                to_apart["shared_seeds"],
            ),
            row(
                "one run of one seed, relative to two separate runs",
                rates["shared_episodes"],
                to_apart["shared_episodes"],
            ),
            row("one device on both cores", simulated["1"]["steps_per_s"], None),
            *(
                row(
                    f"{number} simulated devices on both cores, relative to one device",
                    simulated[number]["steps_per_s"],
                    simulated[number]["efficiency_of_the_same_cores"],
                )
                for number in ("2", "4")
            ),
            "",
            "| constant | measured |",
            "| :-- | --: |",
            f"| rollout and learning of one update | {update['rollout_s']:.3f} s, {update['learning_s']:.3f} s |",
            f"| parameters | {update['parameter_bytes']:,} bytes |",
            f"| sums, seed shared, one update | {sums['calls']}, of {sums['arrays']} arrays, {sums['bytes']:,} bytes |",
            f"| exchanges in {num_updates} updates, a seed on each core | {calls}, of {arrays} arrays |",
            f"| one sum (gloo), each process held to one core | {1e6 * pinned['latency_s']:,.0f} us |",
            f"| one sum (gloo), processes free to use both cores | {free_us:.0f} us, {megabytes:,.0f} MB/s |",
            f"| noise between two minibatches, log-normal sigma | {jitter:.3f} |",
            f"| time to join, to compile, to save | {join_s:.1f} s, {compile_s:.1f} s, {save_s:.2f} s |",
        ]
    )


def main() -> None:
    DOCUMENT.write_text(fill_page(DOCUMENT.read_text()))


def fill_page(text: str) -> str:
    """Return the page with every table that a comment names taken from the results."""
    measured = json.loads(MEASURED.read_text())

    def make_table(match: re.Match) -> str:
        kind, _, name = match[2].partition(": ")
        if kind == "measured":
            table = format_measurements(measured)
        else:
            table = format_simulation(simulate_hosts(measured, NETWORKS[name], shared_batch=kind == "batch_shared"))
        return f"{match[1]}\n{table}\n"

    pattern = r"(<!-- (measured|batch_\w+: .+?) -->)\n(?:\|.*\n|\n(?=\| constant))*"
    return re.sub(pattern, make_table, text)


if __name__ == "__main__":
    main()
