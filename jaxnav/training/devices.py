"""Devices: one run on many of them.

The devices are of one process or of several; seeds are side by side, and the episodes of each are shared out.

The devices form a mesh (seeds, episodes). Parameters, tables and priors are on all devices; the leaves of an agent are
cut along its episodes. What is computed stays that of one device: random numbers do not depend on where they are drawn,
so that only the order of sums over episodes differs.
"""

import dataclasses
import hashlib
import math
import re
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxnav.errors import InputError
from jaxnav.training.learner import LearnerState
from jaxnav.training.peers import PATIENCE, watch
from jaxnav.training.shares import EPISODES, SEEDS

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True)
class Devices:
    """Name devices to train on.

    Attributes:
      count: so many of this process; None takes all devices of all processes.
      address: `HOST:PORT` where the first of several processes waits for the others; None leaves it to the launcher
        (Slurm, Open MPI, Kubernetes or a TPU pod) to tell which processes there are, unless `count` is given.
      process, processes: index of this process, and how many there are.
    """

    count: int | None = None
    address: str | None = None
    process: int | None = None
    processes: int | None = None

    @classmethod
    def parse(cls, text: str) -> "Devices | None":
        """Read `COUNT`, `cluster` or `HOST:PORT,INDEX,PROCESSES`.

        Returns None if the text is none of these.
        """
        if text == "cluster":
            return cls()
        if re.fullmatch(r"[1-9]\d*", text):
            return cls(count=int(text))
        parts = re.fullmatch(r"(.+:\d+),(\d+),(\d+)", text)
        if parts and int(parts[2]) < int(parts[3]):
            return cls(address=parts[1], process=int(parts[2]), processes=int(parts[3]))
        return None

    def connect(self) -> None:
        """Join the other processes, before anything is computed.

        Raises:
          InputError: no launcher tells of the processes. If one is lost, now or later, this one ends; see `peers`.
        """
        if self.count or jax.distributed.is_initialized():
            return
        jax.config.update("jax_enable_preemption_service", False)  # it would ignore a SIGTERM
        detection = "deactivate" if self.address else None
        watch()
        try:
            jax.distributed.initialize(
                self.address,
                self.processes,
                self.process,
                cluster_detection_method=detection,
                initialization_timeout=PATIENCE,
                heartbeat_timeout_seconds=PATIENCE,
                shutdown_timeout_seconds=PATIENCE,
            )
        except (ValueError, RuntimeError) as error:
            raise InputError(
                f"config: devices: the processes cannot be joined ({error}); give HOST:PORT,INDEX,PROCESSES to each, "
                "with an address of process 0"
            ) from error

    def mesh(self, seeds: int, num_envs: int, minibatches: int) -> Mesh:
        """Make the mesh of devices.

        It has as many groups of devices as divide the seeds, each with an equal share of every minibatch.

        Raises:
          InputError: there are fewer devices, or the episodes cannot be shared out.
        """
        devices = jax.devices()
        count = self.count or len(devices)
        if count > len(devices):
            raise InputError(
                f"config: devices is {count}; there are {len(devices)} (on a CPU as many as "
                f"XLA_FLAGS=--xla_force_host_platform_device_count={count} makes)"
            )
        groups = math.gcd(count, seeds)
        share = count // groups
        if num_envs % (share * minibatches):
            raise InputError(
                f"config: ppo.num_envs is {num_envs}; with {count} devices for {seeds} seeds the episodes of each are "
                f"shared by {share}: give a multiple of {share} x ppo.minibatches ({minibatches})"
            )
        return Mesh(np.array(devices[:count]).reshape(groups, share), (SEEDS, EPISODES))


def replicated(mesh: Mesh) -> NamedSharding:
    """Place whole arrays on every device."""
    return NamedSharding(mesh, PartitionSpec())


def state_sharding(mesh: Mesh, stacked: bool = False) -> LearnerState:
    """Place the leaves of a seed's state.

    Or of `stacked` seeds' states: episodes are divided, stacked seeds as well.
    """
    seeds = (SEEDS,) if stacked else ()
    whole = NamedSharding(mesh, PartitionSpec(*seeds))
    episodes = NamedSharding(mesh, PartitionSpec(*seeds, EPISODES))
    state: Any = LearnerState  # holds places here, not arrays
    return state(params=whole, kept=whole, optimizer=whole, agent=episodes, key=whole, update=whole)


def everywhere(mesh: Mesh, tree: Tree) -> Tree:
    """Copy arrays that every process has to all devices."""
    place = replicated(mesh)
    return jax.jit(lambda tree: tree, in_shardings=place, out_shardings=place)(tree)


def first_process() -> bool:
    """Return whether this is the process that writes."""
    return jax.process_index() == 0


def by_first_process(action: Callable[[], Any]) -> None:
    """Let the first process act while the others wait.

    Raises:
      InputError: in every process, if the first one was refused.
    """
    refusal = None
    if first_process():
        try:
            action()
        except InputError as error:
            refusal = error
    refused = jax.process_count() > 1 and multihost_utils.broadcast_one_to_all(np.bool_(refusal is not None))
    if refusal or refused:
        raise refusal or InputError("process 0 was refused; it says why")


def check_agreement(text: str) -> None:
    """Make sure that every process says the same.

    Raises:
      InputError: some do not.
    """
    if jax.process_count() == 1:
        return
    digest = np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint32)
    told = multihost_utils.process_allgather(digest)
    if others := [index for index, other in enumerate(told) if (other != told[0]).any()]:
        raise InputError(
            f"config: processes {others} have other settings, scenes or versions than process 0; give all the same"
        )
