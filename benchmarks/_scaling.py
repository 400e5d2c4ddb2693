"""Measurements that `scaling.py` makes in its processes."""

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
from _setup import set_up_training
from jax.sharding import Mesh, PartitionSpec

from jaxnav.runs.config import LayoutConfig, RunConfig
from jaxnav.store.checkpoint import save_checkpoint
from jaxnav.store.files import append_log_rows


class Training:
    """Training of the default arm with the layout on a mesh.

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

    def time_train(self) -> float:
        """Return the seconds of one call of `train`."""
        start_time = time.perf_counter()
        self.train()
        return time.perf_counter() - start_time

    def time_save(self, folder: Path) -> float:
        """Return the seconds to save a checkpoint."""
        start_time = time.perf_counter()
        save_checkpoint(folder, 1, self._trainer.unpack(self._states), {})
        return time.perf_counter() - start_time

    def time_log(self, folder: Path) -> float:
        """Return the seconds to log a row."""
        row = {"step": 1, **{str(number): 1.0 for number in range(12)}}
        start_time = time.perf_counter()
        for _ in range(100):
            append_log_rows(folder / "log", [row])
        return (time.perf_counter() - start_time) / 100

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
    return Mesh(np.array(jax.local_devices())[None], ("seeds", "episodes"))


def time_all_reduce(mesh: Mesh, num_bytes: int, repeats: int) -> list[float]:
    """Return the seconds of a mean of an array over the mesh, measured several times.

    Args:
      mesh: of devices.
      num_bytes: size of the array.
      repeats: means in each measurement.
    """

    @jax.jit
    @partial(jax.shard_map, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec())
    def repeat_means(array: jax.Array) -> jax.Array:
        def step(_: Any, array: jax.Array) -> jax.Array:
            return jax.lax.pmean(array + jax.lax.axis_index("episodes"), "episodes")

        return jax.lax.fori_loop(0, repeats, step, array)

    # The array is float32; the first call compiles.
    array = jnp.zeros(num_bytes // 4)
    jax.block_until_ready(repeat_means(array))
    times = []
    for _ in range(5):
        start_time = time.perf_counter()
        jax.block_until_ready(repeat_means(array))
        times.append((time.perf_counter() - start_time) / repeats)
    return times


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


def log_spread(values: Sequence[float]) -> float:
    """Return the standard deviation of the logarithms."""
    return round(float(np.log(values).std()), 4)


#: Operations of XLA by which devices exchange arrays.
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter", "collective-broadcast")


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
                sizes = [_count_array_bytes(dtype, shape) for dtype, shape in arrays]
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


def _count_array_bytes(dtype: str, shape: str) -> int:
    """Return the bytes of an array such as f32[3,4]."""
    bits = re.search(r"\d+", dtype)
    num_elements = math.prod(int(size) for size in shape.split(",") if size)
    return num_elements * (int(bits[0]) // 8 if bits else 1)
