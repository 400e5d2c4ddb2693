"""One writer of a folder at a time."""

import os
import socket
from pathlib import Path

from jaxnav.errors import InputError

try:
    import fcntl
except ImportError:  # not a POSIX system: nothing is locked there
    fcntl = None

#: File in a folder that its writer holds.
LOCK_FILE = ".lock"


class Lock:
    """Hold a folder, so that no other process writes to it.

    The system lets go of it when the process ends, however it ends: a file that is left behind locks nothing. Where
    the file system knows no locks, nothing is locked.
    """

    def __init__(self, folder: Path) -> None:
        """Name the folder; it is not held yet."""
        self._path = folder / LOCK_FILE
        self._file: int | None = None

    def acquire(self) -> None:
        """Hold the folder, which must exist.

        Raises:
          InputError: another process, or another lock of this one, holds it.
          OSError: the folder is missing or cannot be written.
        """
        file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(file, 200).decode(errors="replace") or "another process"
            os.close(file)
            raise InputError(
                f"{self._path.parent}: {holder} writes to it; wait for that, end it, or choose another run directory"
            ) from error
        except OSError:
            pass
        self._file = file
        os.truncate(file, 0)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())

    def check(self) -> None:
        """Make sure that the folder is still the one that is held.

        Raises:
          InputError: it was removed or replaced.
        """
        if self._file is None:
            return
        try:
            there = os.path.samestat(os.fstat(self._file), os.stat(self._path))
        except FileNotFoundError:
            there = False
        if not there:
            raise InputError(
                f"{self._path.parent}: was removed or replaced, or its {LOCK_FILE} was, while this run wrote to it; "
                "restore it, or train anew"
            )

    def release(self) -> None:
        """Let go of the folder."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
