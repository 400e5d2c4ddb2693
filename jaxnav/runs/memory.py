"""Memory that a run needs, against what is free.

Linux grants more memory than exists and later kills a process without a message, so runs compare need and supply first.
"""

from collections.abc import Iterator
from pathlib import Path

import jax

from jaxnav.errors import InputError

_MEMINFO = Path("/proc/meminfo")
_GROUPS_OF_PROCESS = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")
#: By version of control groups: folder below `_GROUPS`, files of limit and use, and the count of reclaimable bytes.
_GROUP_FILES = {
    "v1": ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    "v2": ("", "memory.max", "memory.current", "inactive_file"),
}


def read_free_bytes() -> int | None:
    """Return the bytes that arrays may still take; None where the system does not say.

    For a CPU, these are the bytes of the machine or of a control group of this process, whichever has fewest, and for
    an accelerator those of the first device.
    """
    if jax.default_backend() != "cpu":
        device_stats = jax.local_devices()[0].memory_stats() or {}
        if "bytes_limit" not in device_stats:
            return None
        return device_stats["bytes_limit"] - device_stats["bytes_in_use"]

    limits = list(_read_free_bytes_of_groups())
    available_kb = _read_table(_MEMINFO).get("MemAvailable:")
    if available_kb is not None:
        limits.append(1024 * available_kb)
    return min(limits, default=None)


def require_memory(num_bytes: int, purpose: str, remedy: str) -> None:
    """Raise an error if fewer than `num_bytes` are free.

    Raises:
      InputError: fewer bytes are free.
    """
    free_bytes = read_free_bytes()
    if free_bytes is not None and num_bytes > free_bytes:
        raise InputError(
            f"{purpose} needs {format_bytes(num_bytes)} of memory, but {format_bytes(free_bytes)} are free; {remedy}"
        )


def format_bytes(num_bytes: int) -> str:
    """Return bytes in kB, MB or GB."""
    if num_bytes < 1e6:
        return f"{num_bytes / 1e3:.0f} kB"
    if num_bytes < 1e9:
        return f"{num_bytes / 1e6:.0f} MB"
    return f"{num_bytes / 1e9:,.1f} GB"


def _read_free_bytes_of_groups() -> Iterator[int]:
    """Yield the free bytes of every control group with a limit that holds this process."""
    if not _GROUPS_OF_PROCESS.exists():
        return
    for line in _GROUPS_OF_PROCESS.read_text().splitlines():
        # Each line is `number:controllers:path`; version 2 names no controllers.
        _, controllers, group_path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        folder, limit_name, use_name, reclaimable_name = _GROUP_FILES["v1" if controllers else "v2"]

        # A group is limited by the groups that contain it, too.
        root = _GROUPS / folder
        group = root / group_path.lstrip("/")
        for parent in (group, *group.parents):
            limit = _read_number(parent / limit_name)
            use = _read_number(parent / use_name)
            if limit is not None and use is not None:
                # Cached files count as used, but are given up when memory is short.
                reclaimable = _read_table(parent / "memory.stat").get(reclaimable_name, 0)
                yield max(0, limit - use + reclaimable)
            if parent == root:
                break


def _read_number(path: Path) -> int | None:
    """Return the number in a file; None without the file or for the word `max`."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _read_table(path: Path) -> dict[str, int]:
    """Return the numbers of a file with lines of a name and a number; other lines, or a missing file, have none."""
    if not path.exists():
        return {}
    table = {}
    for line in path.read_text().splitlines():
        words = line.split()
        if len(words) >= 2 and words[1].isdigit():
            table[words[0]] = int(words[1])
    return table
