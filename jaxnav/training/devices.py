"""Training one run on several devices, of one process or of several.

The devices form a mesh (seeds, episodes): seeds are divided among groups of devices, and the episodes of a seed among
the devices of its group. Parameters, tables and priors are copied to all devices. Results do not depend on the number
of devices, because random numbers do not depend on where they are drawn; only the order of sums over episodes differs.

`Devices` connects the processes and makes the mesh. `replicate_on_devices`, `replicated_sharding` and `state_sharding`
place arrays on it. `is_first_process`, `run_on_first_process` and `check_agreement` coordinate processes, and
`exit_if_process_lost` ends a process when another one of its run is lost.
"""

import atexit
import contextlib
import ctypes
import dataclasses
import hashlib
import math
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxnav.errors import InputError
from jaxnav.numerics.device_means import ENV_AXIS, SEED_AXIS
from jaxnav.training.ppo import LearnerState

Tree = TypeVar("Tree")

#: Upper bound of the numbers of devices and processes.
MAX_DEVICES = 10**6
#: Largest port of a network address.
_MAX_PORT = 2**16 - 1
#: Seconds after which a process that does not connect, or does not respond, counts as lost.
TIMEOUT_SECONDS = 30

#: File that JAX's own messages go to; empty before `redirect_crash_output`.
_crash_log = ""


@dataclasses.dataclass(frozen=True)
class Devices:
    """Devices to train on.

    Attributes:
      count: number of devices of this process; None for all devices of all processes.
      address: `HOST:PORT` where the first of several processes waits for the rest; None without `count` leaves the
        discovery of processes to the launcher (Slurm, Open MPI, Kubernetes or a TPU pod).
      process: index of this process.
      processes: number of processes.
    """

    count: int | None = None
    address: str | None = None
    process: int | None = None
    processes: int | None = None

    @classmethod
    def parse(cls, text: str) -> "Devices | None":
        """Parse `COUNT`, `cluster` or `HOST:PORT,INDEX,PROCESSES`; None if the text is none of these."""
        if text == "cluster":
            return cls()
        # Python converts no text of several thousand digits.
        if re.fullmatch(r"[1-9]\d{0,6}", text) and int(text) <= MAX_DEVICES:
            return cls(count=int(text))
        match = re.fullmatch(r"(.+:(\d{1,5})),(\d{1,7}),(\d{1,7})", text)
        if match and int(match[2]) <= _MAX_PORT and int(match[3]) < int(match[4]) <= MAX_DEVICES:
            return cls(address=match[1], process=int(match[3]), processes=int(match[4]))
        return None

    def connect(self) -> None:
        """Join the other processes; call before anything is computed.

        From then on, the loss of a process ends this one; see `exit_if_process_lost`.

        Raises:
          InputError: the processes cannot be discovered or joined.
        """
        if self.count or jax.distributed.is_initialized():
            return

        jax.config.update("jax_enable_preemption_service", False)  # which would ignore a SIGTERM
        redirect_crash_output()
        try:
            jax.distributed.initialize(
                self.address,
                self.processes,
                self.process,
                cluster_detection_method="deactivate" if self.address else None,
                initialization_timeout=TIMEOUT_SECONDS,
                heartbeat_timeout_seconds=TIMEOUT_SECONDS,
                shutdown_timeout_seconds=TIMEOUT_SECONDS,
            )
        except (ValueError, RuntimeError) as error:
            raise InputError(
                f"config: devices: the processes cannot be joined ({error}); give HOST:PORT,INDEX,PROCESSES to each, "
                "with the address of process 0"
            ) from error

    def mesh(self, num_seeds: int, num_envs: int, minibatches: int) -> Mesh:
        """Mesh (seeds, episodes) of the devices.

        The number of groups is the greatest that divides both devices and seeds. Each device of a group gets an equal
        share of every minibatch.

        Raises:
          InputError: there are fewer devices, or the episodes cannot be divided equally.
        """
        devices = jax.devices()
        count = self.count or len(devices)
        if count > len(devices):
            raise InputError(
                f"config: devices is {count}, but JAX has {len(devices)}; give fewer, or divide a CPU by "
                f"XLA_FLAGS=--xla_force_host_platform_device_count={count}"
            )

        num_groups = math.gcd(count, num_seeds)
        group_size = count // num_groups
        if num_envs % (group_size * minibatches):
            raise InputError(
                f"config: ppo.num_envs is {num_envs}; with {count} devices and {num_seeds} seeds, {group_size} devices "
                f"share the episodes of a seed: give a multiple of {group_size} x ppo.minibatches ({minibatches})"
            )
        return Mesh(np.array(devices[:count]).reshape(num_groups, group_size), (SEED_AXIS, ENV_AXIS))


# Placing arrays on a mesh


def require_float32() -> None:
    """Refuse the 64-bit mode of JAX, in which arrays that are not given a dtype are float64 and int64.

    Raises:
      InputError: the mode is on.
    """
    if jax.config.values["jax_enable_x64"]:
        raise InputError(
            "JAX_ENABLE_X64: is on, but policies compute in float32; unset it, or call "
            "jax.config.update('jax_enable_x64', False) first"
        )


def replicated_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding that copies whole arrays to all devices."""
    return NamedSharding(mesh, PartitionSpec())


def state_sharding(mesh: Mesh, stacked: bool = False) -> LearnerState:
    """Sharding of a seed's state, a pytree prefix: episodes are divided, all else is copied to all devices.

    Args:
      mesh: mesh of the devices of the run.
      stacked: for the stacked states of several seeds, whose seeds are divided among the groups of devices too.
    """
    seed_axes = (SEED_AXIS,) if stacked else ()
    copied = NamedSharding(mesh, PartitionSpec(*seed_axes))
    divided = NamedSharding(mesh, PartitionSpec(*seed_axes, ENV_AXIS))

    # Untyped, because the fields hold shardings here rather than arrays.
    state_type: Any = LearnerState
    return state_type(params=copied, best=copied, opt_state=copied, agent=divided, key=copied, update=copied)


def replicate_on_devices(mesh: Mesh, tree: Tree) -> Tree:
    """Copy arrays that every process has to all devices."""
    sharding = replicated_sharding(mesh)
    return jax.jit(lambda tree: tree, in_shardings=sharding, out_shardings=sharding)(tree)


# Coordinating processes


def is_first_process() -> bool:
    """True in the process that writes files and messages."""
    return jax.process_index() == 0


def run_on_first_process(action: Callable[[], Any]) -> None:
    """Run an action in the first process while the rest wait.

    Raises:
      InputError: the action raised one in the first process; then every process raises it.
    """
    error = None
    if is_first_process():
        try:
            action()
        except InputError as action_error:
            error = action_error

    # All processes learn whether the action failed; only the first one has the error itself.
    has_failed = error is not None
    if jax.process_count() > 1:
        has_failed = bool(multihost_utils.broadcast_one_to_all(np.bool_(has_failed)))
    if has_failed:
        raise error or InputError("process 0 stopped with an error; read its output")


def check_agreement(text: str) -> None:
    """Check that a text is the same in all processes.

    Raises:
      InputError: some processes have a different text.
    """
    if jax.process_count() == 1:
        return

    digest = np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint32)
    digests = multihost_utils.process_allgather(digest)
    others = np.flatnonzero((digests != digests[0]).any(axis=1)).tolist()
    if others:
        raise InputError(
            f"config: processes {others} have other settings, scenes or versions than process 0; start all processes "
            "with the same settings"
        )


# Losing a process


def redirect_crash_output() -> None:
    """Report the loss of a process in one line instead of JAX's own output.

    When a process is lost, JAX aborts from one of its own threads, with a page of addresses. From here on, output that
    JAX and gloo write to the file descriptor of stderr goes to a file, which the line names and which is removed when
    the run ends well. Python's `sys.stderr` still writes to the terminal.
    """
    global _crash_log
    log_descriptor, _crash_log = tempfile.mkstemp(prefix="jaxnav-", suffix=".log")
    atexit.register(os.unlink, _crash_log)
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    os.dup2(log_descriptor, 2)
    ctypes.pythonapi.PyOS_setsig(signal.SIGABRT, _on_abort)  # Python's own handlers wait for the main thread


@contextlib.contextmanager
def exit_if_process_lost() -> Iterator[None]:
    """Exit with a message where communication with another process fails; also usable as a decorator."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, TimeoutError, ValueError) as error:
        # A failed collective may raise a ValueError; only its text distinguishes it from a mistake in the program.
        is_other_error = isinstance(error, ValueError) and "Gloo" not in str(error)
        if is_other_error or not _crash_log:
            raise
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
        _exit_with_message()


@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _on_abort(_: int) -> None:
    _exit_with_message()


def _exit_with_message() -> None:
    """Exit at once with the code of invalid input; JAX's own exit would wait for the lost process."""
    sys.stderr.write(
        "error: config: devices: another process of this run ended, cannot be reached or has other versions "
        f"(details: {_crash_log}); start all processes again, and the run resumes from its last checkpoint\n"
    )
    sys.stderr.flush()
    os._exit(2)
