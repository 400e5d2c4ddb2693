"""Peers: how a process ends when another one of its run is lost."""

import atexit
import contextlib
import ctypes
import os
import signal
import sys
import tempfile
from collections.abc import Iterator

import jax

#: Seconds until a process that does not come, or says nothing, counts as lost.
PATIENCE = 30

_TO_LOG = ""  # where XLA writes, once `watch` was called


def watch() -> None:
    """Tell of a lost process in one line.

    JAX knows no other answer to it than to abort, from one of its own threads and with a page of addresses. What it and
    gloo write goes to a file from here on, which the line names, and which a run that ends well removes.
    """
    global _TO_LOG
    descriptor, _TO_LOG = tempfile.mkstemp(prefix="jaxnav-", suffix=".log")
    atexit.register(os.unlink, _TO_LOG)
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    os.dup2(descriptor, 2)
    ctypes.pythonapi.PyOS_setsig(signal.SIGABRT, _aborted)  # Python's own handlers wait for the main thread


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """End the process where an exchange with another one fails."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, TimeoutError, ValueError) as error:
        # Where a collective fails at once, JAX raises a ValueError that its text alone tells from others.
        mistake = isinstance(error, ValueError) and "Gloo" not in str(error)
        if mistake or not _TO_LOG:
            raise
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
        _end()


@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _aborted(_: int) -> None:
    _end()


def _end() -> None:
    """End with the code of bad input; JAX's own end would wait for the lost process."""
    sys.stderr.write(
        "error: config: devices: another process of this run ended, cannot be reached or has other versions "
        f"(details: {_TO_LOG}); start all again, the run goes on from its last checkpoint\n"
    )
    sys.stderr.flush()
    os._exit(2)
