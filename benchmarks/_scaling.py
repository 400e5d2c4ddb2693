"""What benchmarks/scaling.py measures in its processes."""

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
from jax.sharding import Mesh, PartitionSpec

from jaxnav.env.make import make
from jaxnav.layout import SETTINGS
from jaxnav.runs.config import RunConfig
from jaxnav.store.checkpoint import save
from jaxnav.store.runlog import append_row
from jaxnav.training.calibration import layout_priors
from jaxnav.training.exploration import explore
from jaxnav.training.trainer import ShardedArms


class Training:
    """The default run with the arm with the layout alone, on a mesh; some updates at a time."""

    def __init__(self, mesh: Mesh, episodes: int, seeds: int = 1, updates: int = 1, **ppo: int) -> None:
        base = RunConfig()
        config = dataclasses.replace(base, seeds=seeds, arms=("layout",), chunk=updates)
        config = dataclasses.replace(config, ppo=dataclasses.replace(base.ppo, num_envs=episodes, **ppo))
        env, self._params = make(config.world)
        setting = SETTINGS[config.layout.setting]
        counts = jax.jit(explore, static_argnums=(0, 3, 4))(env, self._params, jax.random.key(0), 64, 20).counts
        self.mesh, self.updates, self.steps = mesh, updates, config.update_steps * seeds  # of an update
        self._arms = ShardedArms(config, env, setting, layout_priors(counts, setting), mesh)
        self._states = self._arms.init(self._params)

    def train(self) -> None:
        self._states, _ = self._arms.train(self._states, self._params)

    def seconds(self) -> float:
        began = time.perf_counter()
        self.train()
        return time.perf_counter() - began

    def save(self, folder: Path) -> float:
        """Seconds to save a checkpoint."""
        began = time.perf_counter()
        save(folder, 1, self._states, {})
        return time.perf_counter() - began

    def log(self, folder: Path) -> float:
        """Seconds to log a row."""
        row = {"step": 1, **{str(number): 1.0 for number in range(12)}}
        began = time.perf_counter()
        for _ in range(100):
            append_row(folder / "log", row)
        return (time.perf_counter() - began) / 100

    def sizes(self) -> dict[str, int]:
        """Bytes of the parameters, and of each device's episodes."""
        state = self._states["layout"][0]
        agent = sum(leaf.nbytes for leaf in jax.tree.leaves(state.agent))
        return {
            "parameter_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(state.params)),
            "agent_bytes": agent // self.mesh.size,
        }

    @property
    def program(self) -> str:
        """The compiled updates."""
        return self._arms._compiled["layout"].as_text()


def local_mesh() -> Mesh:
    """This process's devices."""
    return Mesh(np.array(jax.local_devices())[None], ("seeds", "episodes"))


def all_reduce(mesh: Mesh, size: int, sums: int) -> list[float]:
    """Seconds of a mean of `size` bytes over the mesh, one after the other; of several repeats."""

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
    """Latency, the median over arrays of up to 64 kB; and bandwidth, from what the largest array takes longer."""
    times = {size: float(np.median(values)) for size, values in sums.items()}
    latency, largest = float(np.median([time for size, time in times.items() if size <= 2**16])), max(times)
    return {
        "latency_s": float(f"{latency:.3g}"),
        "bytes_per_s": float(f"{largest / max(times[largest] - latency, 1e-6):.3g}"),
    }


def log_spread(values: Sequence[float]) -> float:
    """Standard deviation of the logarithms."""
    return round(float(np.log(values).std()), 4)


def collectives(program: str) -> dict[str, dict[str, int]]:
    """What one call of a compiled program exchanges: calls, their arrays and bytes by kind, loops by their turns."""
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
            if found := re.search(rf"= (.*?) ({'|'.join(kinds)})\(", text):
                sizes = [_bytes(*array) for array in re.findall(r"([a-z]+\d*)\[([\d,]*)\]", found[1])]
                total[kinds.index(found[2])] += 1, len(sizes), sum(sizes)
            turns = re.search(r'"known_trip_count":\{"n":"(\d+)"\}', text)
            for called in re.findall(r"(?:body|calls|to_apply|branch_computations)=\{?%?([\w.\-]+)", text):
                total += count(called) * (int(turns[1]) if turns else 1)
        return total

    rows = zip(kinds, count("ENTRY").tolist(), strict=True)
    return {kind: dict(zip(("calls", "arrays", "bytes"), row, strict=True)) for kind, row in rows if row[0]}


def _bytes(kind: str, shape: str) -> int:
    """Of an array such as f32[3,4]."""
    bits = re.search(r"\d+", kind)
    return math.prod(int(size) for size in shape.split(",") if size) * (int(bits[0]) // 8 if bits else 1)
