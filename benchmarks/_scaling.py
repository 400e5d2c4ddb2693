"""What `scaling.py` measures in its processes."""

import dataclasses
import math
import re
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _setup import set_up
from jax.sharding import Mesh, PartitionSpec

from jaxnav.runs.config import LayoutConfig, RunConfig
from jaxnav.store.checkpoint import save
from jaxnav.store.runlog import append_rows


class Training:
    """Train the default arm with the layout on a mesh."""

    def __init__(self, mesh: Mesh, episodes: int, seeds: int = 1, updates: int = 1, **ppo: int) -> None:
        base = RunConfig(seeds=seeds, arms=("layout",), chunk=updates, layout=LayoutConfig(walks=64, steps=20))
        config = dataclasses.replace(base, ppo=dataclasses.replace(base.ppo, num_envs=episodes, **ppo))
        self.mesh, self.updates, self.steps = mesh, updates, config.update_steps * seeds  # of an update
        setup = set_up(config, mesh)
        self._trainer, self._params = setup.trainer, setup.params
        self._states = self._trainer.init(self._params)

    def train(self) -> None:
        self._states, _ = self._trainer.train(self._states, self._params)

    def seconds(self) -> float:
        began = time.perf_counter()
        self.train()
        return time.perf_counter() - began

    def save(self, folder: Path) -> float:
        """Return the seconds to save a checkpoint."""
        began = time.perf_counter()
        save(folder, 1, self._trainer.unpack(self._states), {})
        return time.perf_counter() - began

    def log(self, folder: Path) -> float:
        """Return the seconds to log a row."""
        row = {"step": 1, **{str(number): 1.0 for number in range(12)}}
        began = time.perf_counter()
        for _ in range(100):
            append_rows(folder / "log", [row])
        return (time.perf_counter() - began) / 100

    def sizes(self) -> dict[str, int]:
        """Return the bytes of parameters and of a device's episodes."""
        state = self._trainer.unpack(self._states)["layout"][0]
        agent = sum(leaf.nbytes for leaf in jax.tree.leaves(state.agent))
        return {
            "parameter_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(state.params)),
            "agent_bytes": agent // self.mesh.size,
        }

    @property
    def program(self) -> str:
        """Return the text of the compiled updates."""
        return self._trainer._compiled["layout", 0].as_text()


def local_mesh() -> Mesh:
    """Return a mesh of this process's devices."""
    return Mesh(np.array(jax.local_devices())[None], ("seeds", "episodes"))


def all_reduce(mesh: Mesh, size: int, sums: int) -> list[float]:
    """Return the seconds of means of `size` bytes, repeated."""

    @jax.jit
    @partial(jax.shard_map, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec())
    def means(x: jax.Array) -> jax.Array:
        def step(_: Any, x: jax.Array) -> jax.Array:
            return jax.lax.pmean(x + jax.lax.axis_index("episodes"), "episodes")

        return jax.lax.fori_loop(0, sums, step, x)

    x = jnp.zeros(size // 4)
    jax.block_until_ready(means(x))
    taken = []
    for _ in range(5):
        began = time.perf_counter()
        jax.block_until_ready(means(x))
        taken.append((time.perf_counter() - began) / sums)
    return taken


def line(sums: Mapping[int, Sequence[float]]) -> dict[str, float]:
    """Return latency and bandwidth.

    The median over arrays of up to 64 kB, and from what the largest array takes longer.
    """
    times = {size: float(np.median(values)) for size, values in sums.items()}
    latency, largest = float(np.median([time for size, time in times.items() if size <= 2**16])), max(times)
    return {
        "latency_s": float(f"{latency:.3g}"),
        "bytes_per_s": float(f"{largest / max(times[largest] - latency, 1e-6):.3g}"),
    }


def log_spread(values: Sequence[float]) -> float:
    """Return the standard deviation of the logarithms."""
    return round(float(np.log(values).std()), 4)


def collectives(program: str) -> dict[str, dict[str, int]]:
    """Count what one call of a compiled program exchanges.

    Calls, their arrays and bytes by kind; those in a loop count once a turn.
    """
    kinds = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter", "collective-broadcast")
    bodies: dict[str, list[str]] = {}
    name = ""
    for text in program.splitlines():
        if head := re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", text):
            name = "ENTRY" if head[1] else head[2]
            bodies[name] = []
        elif name:
            bodies[name].append(text)

    def count(name: str) -> np.ndarray:
        total = np.zeros((len(kinds), 3), int)
        for text in bodies[name]:
            if exchange := re.search(rf"= (.*?) ({'|'.join(kinds)})\(", text):
                sizes = [_bytes(*array) for array in re.findall(r"([a-z]+\d*)\[([\d,]*)\]", exchange[1])]
                total[kinds.index(exchange[2])] += 1, len(sizes), sum(sizes)
            turns = re.search(r'"known_trip_count":\{"n":"(\d+)"\}', text)
            for called in re.findall(r"(?:body|calls|to_apply|branch_computations)=\{?%?([\w.\-]+)", text):
                total += count(called) * (int(turns[1]) if turns else 1)
        return total

    rows = zip(kinds, count("ENTRY").tolist(), strict=True)
    return {kind: dict(zip(("calls", "arrays", "bytes"), row, strict=True)) for kind, row in rows if row[0]}


def _bytes(kind: str, shape: str) -> int:
    """Return the bytes of an array such as f32[3,4]."""
    bits = re.search(r"\d+", kind)
    return math.prod(int(size) for size in shape.split(",") if size) * (int(bits[0]) // 8 if bits else 1)
