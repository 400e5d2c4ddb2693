"""Where the time of one training update goes.

`python benchmarks/profiling.py [ARM]` runs a compiled chunk of updates of one seed under JAX's profiler. Every XLA
operation of the trace is looked up in the compiled program for its kind, its shape and the part of the program it comes
from. Milliseconds are of an update: the median of an operation's runs times their number, so that a disturbance of some
does not count.
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

import jax
from _common import report, seconds, spread
from _setup import set_up

from jaxnav.runs.config import RunConfig

CHUNK, RUNS, LONGEST = 4, 5, 15
OPERATION = re.compile(r"\s*(?:ROOT )?%?([\w.\-]+) = (\S+) ([\w\-]+)\(")
METADATA = re.compile(r'op_name="([^"]*)"')


def main() -> None:
    arm = sys.argv[1] if len(sys.argv) > 1 else "layout"
    config = RunConfig(chunk=CHUNK, seeds=1)
    setup = set_up(config)
    learner, inputs = setup.trainer.learners[arm], setup.arguments(arm)
    compiled = jax.jit(partial(learner.train, num_updates=CHUNK)).lower(*inputs).compile()
    wall = [1e3 * seconds(lambda: compiled(*inputs)) / CHUNK for _ in range(RUNS + 1)][1:]
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(compiled(*inputs))
        (trace,) = Path(folder).rglob("*.trace.json.gz")
        events = json.loads(gzip.decompress(trace.read_bytes()))["traceEvents"]
    rows = operations(compiled.as_text() or "", events, config)
    kinds: collections.Counter[str] = collections.Counter()
    for one in rows:
        kinds[one["kind"]] += one["ms"]
    report(
        {
            "arm": arm,
            "wall_ms_per_update": spread(wall),
            "ms_by_kind": {kind: round(ms, 1) for kind, ms in kinds.most_common()},
            "longest": rows[:LONGEST],
        }
    )


def operations(program: str, events: list[dict], config: RunConfig) -> list[dict]:
    """List the operations of a trace, the longest first."""
    known = {}
    for line in program.splitlines():
        if match := OPERATION.match(line):
            name, shape, operation = match.groups()
            origin = METADATA.search(line)
            known[name] = (shape.split("{")[0], operation, origin[1] if origin else "")
    runs: dict[str, list[float]] = collections.defaultdict(list)
    for event in events:
        # Loops and conditions hold other operations, which are there themselves.
        if event.get("ph") == "X" and known.get(event["name"], ("", "while", ""))[1] not in ("while", "conditional"):
            runs[event["name"]].append(event["dur"])
    rows = [
        {
            "operation": name,
            "shape": known[name][0],
            "kind": kind(known[name][1], name, known[name][2], len(durations) / CHUNK, config),
            "calls": round(len(durations) / CHUNK),
            "ms": round(statistics.median(durations) * len(durations) / CHUNK / 1e3, 3),
        }
        for name, durations in runs.items()
    ]
    return sorted(rows, key=lambda one: -one["ms"])


def kind(operation: str, name: str, origin: str, calls: float, config: RunConfig) -> str:
    """Say what an operation is for.

    How often it runs tells the loop that it is in.
    """
    backward = "backward" if "transpose(jvp" in origin else "forward"
    if calls >= config.ppo.minibatches * config.ppo.rollout:
        return f"loop over steps, {backward}"
    if calls >= config.ppo.rollout:
        return "rollout"
    if operation == "dot" or name.startswith("ynn_fusion"):
        return f"products, {backward}"
    return "transposed copies" if "copy" in name or "transpose" in name else f"element by element, {backward}"


if __name__ == "__main__":
    main()
