"""Profile of one training update.

`python benchmarks/profiling.py [ARM]` runs a compiled chunk of updates of one seed under JAX's profiler. Every XLA
operation of the trace is looked up in the compiled program for its kind, its shape and the part of the program it comes
from. Milliseconds are per update: the median of an operation's runs times their number, which is robust to outliers.
"""

import collections
import gzip
import json
import re
import statistics
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
from _common import print_report, summarize, time_call
from _setup import set_up_training

from jaxnav.runs.config import RunConfig

CHUNK = 4
NUM_RUNS = 5
NUM_LISTED = 15
OPERATION = re.compile(r"\s*(?:ROOT )?%?([\w.\-]+) = (\S+) ([\w\-]+)\(")
METADATA = re.compile(r'op_name="([^"]*)"')


def main() -> None:
    arm = sys.argv[1] if len(sys.argv) > 1 else "layout"
    config = RunConfig(chunk=CHUNK, seeds=1)
    setup = set_up_training(config)
    learner = setup.trainer.learners[arm]
    arguments = setup.update_arguments(arm)

    # Time the compiled chunk without the profiler; the first run warms up.
    compiled = jax.jit(partial(learner.train, num_updates=CHUNK)).lower(*arguments).compile()
    wall_ms = [1e3 * time_call(lambda: compiled(*arguments)) / CHUNK for _ in range(NUM_RUNS + 1)][1:]

    # Trace one more run.
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(compiled(*arguments))
        (trace,) = Path(folder).rglob("*.trace.json.gz")
        events = json.loads(gzip.decompress(trace.read_bytes()))["traceEvents"]

    rows = list_operations(compiled.as_text() or "", events, config)
    ms_by_kind: collections.Counter[str] = collections.Counter()
    for row in rows:
        ms_by_kind[row["kind"]] += row["ms"]
    print_report(
        {
            "arm": arm,
            "wall_ms_per_update": summarize(wall_ms),
            "ms_by_kind": {kind: round(ms, 1) for kind, ms in ms_by_kind.most_common()},
            "longest": rows[:NUM_LISTED],
        }
    )


class Operation(NamedTuple):
    """An operation of a compiled program.

    Attributes:
      shape: of the result, with its dtype.
      opcode: kind of operation in XLA.
      origin: path of the JAX operation that it comes from; empty if unknown.
    """

    shape: str
    opcode: str
    origin: str


def list_operations(program_text: str, events: list[dict], config: RunConfig) -> list[dict]:
    """Return the operations of a trace, the longest first."""
    # Operations of the program, by name.
    operations = {}
    for line in program_text.splitlines():
        match = OPERATION.match(line)
        if match:
            name, shape, opcode = match.groups()
            metadata = METADATA.search(line)
            operations[name] = Operation(shape.split("{")[0], opcode, metadata[1] if metadata else "")

    # Durations of their runs, without loops and conditions: the operations in them have events of their own.
    durations_by_name: dict[str, list[float]] = collections.defaultdict(list)
    for event in events:
        if event.get("ph") != "X" or event["name"] not in operations:
            continue
        if operations[event["name"]].opcode not in ("while", "conditional"):
            durations_by_name[event["name"]].append(event["dur"])

    rows = []
    for name, durations in durations_by_name.items():
        operation = operations[name]
        calls_per_update = len(durations) / CHUNK
        rows.append(
            {
                "operation": name,
                "shape": operation.shape,
                "kind": classify_operation(name, operation, calls_per_update, config),
                "calls": round(calls_per_update),
                "ms": round(statistics.median(durations) * len(durations) / CHUNK / 1e3, 3),
            }
        )
    return sorted(rows, key=lambda row: -row["ms"])


def classify_operation(name: str, operation: Operation, calls_per_update: float, config: RunConfig) -> str:
    """Return the part of the update that an operation belongs to; the number of its calls reveals its loop."""
    direction = "backward" if "transpose(jvp" in operation.origin else "forward"
    if calls_per_update >= config.ppo.minibatches * config.ppo.rollout:
        return f"loop over steps, {direction}"
    if calls_per_update >= config.ppo.rollout:
        return "rollout"
    if operation.opcode == "dot" or name.startswith("ynn_fusion"):
        return f"products, {direction}"
    if "copy" in name or "transpose" in name:
        return "transposed copies"
    return f"element by element, {direction}"


if __name__ == "__main__":
    main()
