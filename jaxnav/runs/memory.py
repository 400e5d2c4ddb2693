"""Memory that a run needs, against what is free.

Linux promises more memory than there is and later ends a process without a word, so runs compare before they start.
"""

from pathlib import Path

import jax

from jaxnav.errors import InputError

_MEMINFO = Path("/proc/meminfo")
_CONTROL_GROUP = Path("/sys/fs/cgroup")


def free_bytes() -> int | None:
    """Bytes that arrays may still take on the first device; None where the system does not say.

    For a CPU, this is the memory of the machine or of the control group of this process, whichever has less.
    """
    device_stats = jax.local_devices()[0].memory_stats()
    if device_stats is not None:
        return device_stats["bytes_limit"] - device_stats["bytes_in_use"]

    limits = []
    if _MEMINFO.exists():
        for line in _MEMINFO.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                limits.append(1024 * int(line.split()[1]))
    group_limit = _read_number(_CONTROL_GROUP / "memory.max")
    group_use = _read_number(_CONTROL_GROUP / "memory.current")
    if group_limit is not None and group_use is not None:
        limits.append(max(0, group_limit - group_use))
    return min(limits, default=None)


def require_memory(num_bytes: int, purpose: str, remedy: str) -> None:
    """Check that so many bytes are free.

    Raises:
      InputError: fewer are.
    """
    free = free_bytes()
    if free is not None and num_bytes > free:
        raise InputError(
            f"{purpose} needs {format_bytes(num_bytes)} of memory, but {format_bytes(free)} are free; {remedy}"
        )


def format_bytes(num_bytes: int) -> str:
    """Return bytes in kB, MB or GB."""
    if num_bytes < 1e6:
        return f"{num_bytes / 1e3:.0f} kB"
    if num_bytes < 1e9:
        return f"{num_bytes / 1e6:.0f} MB"
    return f"{num_bytes / 1e9:,.1f} GB"


def _read_number(path: Path) -> int | None:
    """Return the number in a file; None without the file or for the word `max`."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
