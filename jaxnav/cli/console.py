"""What all commands share."""

import ctypes
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from jaxnav.errors import InputError

#: Where compiled programs are kept, unless JAX has been told another folder.
PROGRAMS = "~/.cache/jaxnav/xla"

_LONG_S = 0.5  # of a compilation that is worth the effort


def exit_code(command: Callable[[Console], object]) -> int:
    """Run a command and return its exit code.

    The command gets a console to tell of its progress on. The code is 0, or 2 after bad input, told in one line.
    """
    console = Console(stderr=True, highlight=False)
    if "jax" in sys.modules:  # otherwise the command compiles nothing
        _keep_programs(console)
        _give_memory_back()
    try:
        command(console)
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def result_console() -> Console:
    """Return the console for a result, 120 columns wide."""
    return Console(width=120, highlight=False)


def _keep_programs(console: Console) -> None:
    """Keep compiled programs on disk for the next command.

    JAX's own settings count: another folder, and whether anything is kept.
    """
    import jax

    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] is not None or not settings["jax_enable_compilation_cache"]:
        return
    try:
        folder = Path(PROGRAMS).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:
        console.print(f"warning: compiled programs are not kept: {error}", style="yellow", markup=False, soft_wrap=True)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LONG_S)


@functools.cache
def _give_memory_back() -> None:
    """Give the system back what each long compilation has freed.

    glibc keeps it, up to half a gigabyte. Other C libraries are left alone.
    """
    import jax

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is None:
        return

    def give_back(event: str, duration_secs: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and duration_secs > _LONG_S:
            trim(0)

    jax.monitoring.register_event_duration_secs_listener(give_back)
