"""The cost of 10^11 environment steps on many hosts.

`python benchmarks/simulate.py [--document]` computes it for 1 to 1,000 hosts. From the constants that
benchmarks/scaling.py measured (results/performance/scaling.json) and those stated in `NETWORKS` and `Assumed`, it adds
up an update, term by term, and simulates a run: noise that makes every sum over the hosts wait for the slowest of them,
and hosts that fail, after which all start again from the last checkpoint. A host is one process on one core.
`--document` puts the tables into docs/scaling.md instead of printing JSON.
"""

import dataclasses
import json
import math
import re
import sys
from pathlib import Path

import numpy as np

from jaxnav.runs.config import RunConfig

ROOT = Path(__file__).parents[1]
MEASURED = "results/performance/scaling.json"
STEPS, HOSTS = 10**11, (1, 2, 8, 64, 1000)
DEFAULT = RunConfig()
UPDATES_PER_SAVE = DEFAULT.chunk * DEFAULT.save_every
SHARED_EPISODES = 16384  # where the batch does not grow with the hosts
SAMPLES = 2000  # waits that are drawn


@dataclasses.dataclass(frozen=True)
class Network:
    """Describe a network.

    Seconds of one message, bytes per second, and whether a sum goes around in a tree or a ring.
    """

    message_s: float
    bytes_per_s: float
    tree: bool = False

    def all_reduce(self, hosts: int, size: float) -> tuple[float, float]:
        """Return the seconds of latency and transfer of a sum."""
        rounds = 2 * math.ceil(math.log2(hosts)) if self.tree else 2 * (hosts - 1)
        return rounds * self.message_s, 2 * (hosts - 1) / hosts * size / self.bytes_per_s


@dataclasses.dataclass(frozen=True)
class Assumed:
    """Hold what cannot be measured on one machine.

    Attributes:
      days_between_failures: of one host, in the mean.
      detect_s: until a silent process is noticed.
      disk_bytes_per_s: that all hosts write to the shared file system together.
    """

    days_between_failures: float = 100.0
    detect_s: float = 30.0
    disk_bytes_per_s: float = 1e9


def networks(measured: dict) -> dict[str, Network]:
    """Return the networks: one measured, the others stated.

    The loopback of this machine, Ethernet of 25 Gb/s, and what GPUs have.
    """
    line = measured["all_reduce"]["free"]
    return {
        "loopback, ring": Network(line["latency_s"] / 2, line["bytes_per_s"]),
        "ethernet, ring": Network(30e-6, 2.5e9),
        "ethernet, tree": Network(30e-6, 2.5e9, tree=True),
        "infiniband, tree": Network(5e-6, 20e9, tree=True),
    }


def update(measured: dict, network: Network, hosts: int, share: float, generator: np.random.Generator) -> dict:
    """Return the seconds of each part of an update.

    Every host has `share` of the default run's episodes.
    """
    alone = measured["update"]
    rollout, learning = share * alone["rollout_s"], share * alone["learning_s"]
    sigma = measured["jitter"]["log_standard_deviation"]
    # Between two minibatches noise slows every host independently, and all wait for the slowest.
    noise = np.exp(sigma * generator.standard_normal((SAMPLES, hosts)) - sigma**2 / 2)
    slowest = noise.max(axis=1).mean() / noise.mean()
    exchanged = measured["exchanged"]["shared_episodes"]["all-reduce"]
    sums = exchanged["arrays"]
    latency, transfer = network.all_reduce(hosts, exchanged["bytes"] / sums) if hosts > 1 else (0, 0)
    saving = alone["save_s"] + hosts * share * alone["agent_bytes"] / Assumed().disk_bytes_per_s
    return {
        "rollout": rollout,
        "learning": learning,
        "waiting": (slowest - 1) * (rollout + learning),
        "latency": sums * latency,
        "transfer": sums * transfer,
        "checkpoint": saving / UPDATES_PER_SAVE,
        "log": alone["log_s"],
    }


def run(parts: dict, updates: int, hosts: int, restart_s: float, generator: np.random.Generator) -> tuple[float, int]:
    """Return the seconds and the failures of a run."""
    stretch = UPDATES_PER_SAVE * sum(parts.values())  # from checkpoint to checkpoint
    between = Assumed().days_between_failures * 86400 / hosts
    stretches = math.ceil(updates / UPDATES_PER_SAVE)
    # Failures before a stretch is through: each loses what was done of it. Their number is geometric.
    tries = generator.geometric(math.exp(-stretch / between), stretches)
    failures = int(tries.sum()) - stretches
    lost = -between * np.log1p(generator.random(failures) * math.expm1(-stretch / between))  # given that it fails
    return stretches * stretch + lost.sum() + failures * restart_s, failures


def simulate(measured: dict, network: Network, shared_batch: bool) -> list[dict]:
    """Return a row for every number of hosts."""
    generator = np.random.default_rng(0)
    episodes = measured["episodes_per_device"]
    restart_s = Assumed().detect_s + measured["update"]["join_s"] + measured["update"]["compile_s"]
    rows, alone = [], 0.0
    for hosts in HOSTS:
        share = SHARED_EPISODES / hosts / episodes if shared_batch else 1.0
        if share * episodes < DEFAULT.ppo.minibatches:
            break  # less than an episode of each minibatch for a host
        parts = update(measured, network, hosts, share, generator)
        steps = hosts * share * episodes * DEFAULT.ppo.rollout
        updates = math.ceil(STEPS / steps)
        seconds, failures = run(parts, updates, hosts, restart_s, generator)
        alone = alone or seconds
        total = sum(parts.values())
        rows.append(
            {
                "hosts": hosts,
                "steps_per_update": round(steps),
                "updates": updates,
                "update_s": round(total, 4),
                "share_percent": {name: round(100 * part / total, 2) for name, part in parts.items()},
                "failures": failures,
                "days": float(f"{seconds / 86400:.3g}"),
                "steps_per_s": round(STEPS / seconds),
                "efficiency": round(alone / seconds / hosts, 3),
            }
        )
    return rows


def results() -> dict:
    measured = json.loads((ROOT / MEASURED).read_text())
    known = networks(measured)
    return {
        "steps": STEPS,
        "networks": {name: dataclasses.asdict(network) for name, network in known.items()},
        "assumed": dataclasses.asdict(Assumed()),
        "batch_grows": {name: simulate(measured, network, False) for name, network in known.items()},
        "batch_shared": {name: simulate(measured, network, True) for name, network in known.items()},
    }


def table(rows: list[dict]) -> str:
    """Return a Markdown table of updates and runs."""
    names = ("rollout", "learning", "waiting", "latency", "transfer", "checkpoint")
    head = ["hosts", "steps an update", *(f"{name} %" for name in names), "failures", "days", "efficiency"]
    lines = [" | ".join(head), " | ".join("--:" for _ in head)]
    for row in rows:
        parts = [f"{row['share_percent'][name]:.1f}" for name in names]
        numbers = [f"{row['hosts']:,}", f"{row['steps_per_update']:,}", *parts, f"{row['failures']:,}"]
        lines.append(" | ".join([*numbers, f"{row['days']:,.3g}", f"{row['efficiency']:.2f}"]))
    return "\n".join(f"| {line} |" for line in lines)


def measured_table(measured: dict) -> str:
    """Return Markdown tables of what was measured."""
    processes, simulated, alone = measured["processes"], measured["simulated"], measured["update"]
    rates, to_apart, to_alone = (processes[name] for name in ("steps_per_s", "to_apart", "to_alone"))

    def row(name: str, rate: dict, efficiency: dict | None) -> str:
        shown = f"{efficiency['median']:.2f} ({efficiency['min']:.2f}-{efficiency['max']:.2f})" if efficiency else ""
        return f"| {name} | {rate['median']:,.0f} | {shown} |"

    free, pinned = measured["all_reduce"]["free"], measured["all_reduce"]["pinned"]
    sums = measured["exchanged"]["shared_episodes"]["all-reduce"]
    seeds = measured["exchanged"]["shared_seeds"].values()
    calls, arrays = (sum(kind[unit] for kind in seeds) for unit in ("calls", "arrays"))
    jitter, megabytes = measured["jitter"]["log_standard_deviation"], free["bytes_per_s"] / 1e6
    return "\n".join(
        [
            "| weak scaling | steps/s | efficiency |",
            "| :-- | --: | --: |",
            row("one process on one core, the other idle", rates["alone"], None),
            row("two processes apart, to one alone", rates["apart"], to_alone["apart"]),
            row("two as one run, a seed each, to two apart", rates["shared_seeds"], to_apart["shared_seeds"]),
            row("two as one run of one seed, to two apart", rates["shared_episodes"], to_apart["shared_episodes"]),
            row("one device on both cores", simulated["1"]["steps_per_s"], None),
            *(
                row(
                    f"{number} simulated devices on both cores, to one",
                    simulated[number]["steps_per_s"],
                    simulated[number]["efficiency_of_the_same_cores"],
                )
                for number in ("2", "4")
            ),
            "",
            "| constant | measured |",
            "| :-- | --: |",
            f"| an update alone: rollout, learning | {alone['rollout_s']:.3f} s, {alone['learning_s']:.3f} s |",
            f"| parameters | {alone['parameter_bytes']:,} bytes |",
            f"| sums in an update of one seed | {sums['calls']}, of {sums['arrays']} arrays, {sums['bytes']:,} bytes |",
            f"| exchanges in {measured['updates_per_call']} updates of a seed each | {calls}, of {arrays} arrays |",
            f"| a sum of an array (gloo), each process held to one core | {1e6 * pinned['latency_s']:,.0f} us |",
            f"| the same, free to use both; bandwidth | {1e6 * free['latency_s']:.0f} us, {megabytes:,.0f} MB/s |",
            f"| noise between two minibatches, log-normal sigma | {jitter:.3f} |",
            f"| join, compile, save | {alone['join_s']:.1f} s, {alone['compile_s']:.1f} s, {alone['save_s']:.2f} s |",
        ]
    )


def document(computed: dict) -> None:
    """Replace every table of docs/scaling.md that a comment names."""
    path = ROOT / "docs/scaling.md"
    measured = json.loads((ROOT / MEASURED).read_text())

    def fill(match: re.Match) -> str:
        kind, _, network = match[2].partition(": ")
        return f"{match[1]}\n{table(computed[kind][network]) if network else measured_table(measured)}\n"

    named = r"(<!-- (measured|batch_\w+: .+?) -->)\n(?:\|.*\n|\n(?=\| constant))*"
    path.write_text(re.sub(named, fill, path.read_text()))


if __name__ == "__main__":
    if sys.argv[1:] == ["--document"]:
        document(results())
    else:
        print(json.dumps(results(), indent=2))
