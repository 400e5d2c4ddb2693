"""Trainings on small file systems; `python -m support.disks` in the folder `tests` prints the last line of each."""

import contextlib
import io
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

from support.commands import contents, train
from support.processes import start_python
from support.tiny_run import write_config

#: Options of `mount` that limit bytes or files, from next to nothing to nearly enough for the tiny run.
SIZE_LIMITS = tuple(f"size={kilobytes}k" for kilobytes in (4, 12, 24, 48, 96, 160, 240, 320, 400, 480))
FILE_LIMITS = tuple(f"nr_inodes={count}" for count in (2, 4, 6, 8, 12, 16, 24, 32, 48, 64))

#: First words of the lines about a training of the tiny run.
STATUS_LINES = (
    "4 scenes",
    "layout ",
    "calibrating ",
    "learning ",
    "compiling ",
    "compiled ",
    "random walks",
    "update ",
)


class DiskAttempt(NamedTuple):
    """A training on a small disk, and its repetition on a larger one.

    Attributes:
      exit_code: exit code of the first call.
      message: last line that it printed.
      output: the whole output of its process.
      exit_code_with_room: exit code of the second call.
      files: files of the run after the second call, by relative path.
    """

    exit_code: int
    message: str
    output: str
    exit_code_with_room: int
    files: dict[str, bytes]


def foreign_lines(attempt: DiskAttempt) -> list[str]:
    """Lines that neither describe the training nor are its error message."""
    lines = attempt.output.splitlines()[:-1]
    return [line for line in lines if not line.startswith(STATUS_LINES)]


def can_mount(folder: Path) -> bool:
    """True if a file system can be mounted."""
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "tmpfs", folder], check=False, capture_output=True).returncode:
        return False
    subprocess.run(["umount", folder], check=True)
    return True


def train_on_small_disk(config_file: Path, disk: Path, limit: str) -> DiskAttempt:
    """Train on a small disk, then enlarge the disk and train again.

    Args:
      config_file: settings of the run.
      disk: folder on which the small file system is mounted.
      limit: option of `mount` that limits bytes or files.
    """
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", limit, "tmpfs", disk], check=True)
    try:
        # Threads of libraries may print until the process ends, so the training has a process of its own.
        process = start_python(["-m", "jaxnav", "train", "--config", config_file, "--run-dir", disk / "run"])
        output = "".join(process.communicate())
        exit_code = process.returncode

        # The second training, with enough room.
        subprocess.run(["mount", "-o", "remount,size=90m,nr_inodes=9000", disk], check=True)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            exit_code_with_room = train(config_file, disk / "run")
        lines = output.splitlines() or [""]
        return DiskAttempt(exit_code, lines[-1], output, exit_code_with_room, contents(disk / "run"))
    finally:
        subprocess.run(["umount", disk], check=True)


if __name__ == "__main__":
    for limit in (*SIZE_LIMITS, *FILE_LIMITS):
        with tempfile.TemporaryDirectory() as folder:
            attempt = train_on_small_disk(write_config(Path(folder)), Path(folder) / "disk", limit)
        counts = f"exit {attempt.exit_code}, then {attempt.exit_code_with_room}"
        num_foreign = len(foreign_lines(attempt))
        print(f"{limit}: {counts}, {num_foreign} lines of libraries: {attempt.message}", flush=True)
