"""Trainings on small file systems: `python -m support.disks` in the folder `tests` prints what each of them says."""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from support.commands import contents, train

#: Options of `mount`: bytes, and numbers of files, from nothing to nearly enough for the tiny run.
SIZE_LIMITS = tuple(f"size={kilobytes}k" for kilobytes in (4, 12, 24, 48, 96, 160, 240, 320, 400, 480))
FILE_LIMITS = tuple(f"nr_inodes={count}" for count in (2, 4, 6, 8, 12, 16, 24, 32, 48, 64))


class DiskAttempt(NamedTuple):
    """A training on a small disk, and its repetition with room.

    Attributes:
      exit_code: exit code of the first call.
      message: last line that it printed.
      output: everything that it printed.
      exit_code_with_room: exit code of the second call.
      files: files of the run after the second call, by relative path.
    """

    exit_code: int
    message: str
    output: str
    exit_code_with_room: int
    files: dict[str, bytes]


def can_mount(folder: Path) -> bool:
    """True if a file system can be mounted."""
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "tmpfs", folder], check=False, capture_output=True).returncode:
        return False
    subprocess.run(["umount", folder], check=True)
    return True


def train_on_small_disk(config_file: Path, disk: Path, limit: str, read_output: Callable[[], Any]) -> DiskAttempt:
    """Train where there is little room, then make room and train again.

    Args:
      config_file: settings of the run.
      disk: folder on which the small file system is mounted.
      limit: option of `mount` that limits bytes or files.
      read_output: returns what was printed since its last call, with `out` and `err`.
    """
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", limit, "tmpfs", disk], check=True)
    try:
        read_output()
        exit_code = train(config_file, disk / "run")
        printed = read_output()
        output = printed.out + printed.err
        subprocess.run(["mount", "-o", "remount,size=90m,nr_inodes=9000", disk], check=True)
        exit_code_with_room = train(config_file, disk / "run")
        read_output()
        lines = output.splitlines() or [""]
        return DiskAttempt(exit_code, lines[-1], output, exit_code_with_room, contents(disk / "run"))
    finally:
        subprocess.run(["umount", disk], check=True)


def _main() -> None:
    """Print a line for each limit."""
    import contextlib
    import io

    from support.tiny_run import write_config

    class Printed(NamedTuple):
        out: str
        err: str

    for limit in (*SIZE_LIMITS, *FILE_LIMITS):
        with tempfile.TemporaryDirectory() as folder:
            out, err = io.StringIO(), io.StringIO()

            def read_output(out: io.StringIO = out, err: io.StringIO = err) -> Printed:
                printed = Printed(out.getvalue(), err.getvalue())
                for stream in (out, err):
                    stream.seek(0)
                    stream.truncate()
                return printed

            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                attempt = train_on_small_disk(write_config(Path(folder)), Path(folder) / "disk", limit, read_output)
            counts = f"exit {attempt.exit_code}, then {attempt.exit_code_with_room}"
            print(f"{limit}: {counts}, {len(attempt.output.splitlines())} lines: {attempt.message}", flush=True)


if __name__ == "__main__":
    sys.exit(_main())
