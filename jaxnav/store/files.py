"""Files of a run that survive crashes: atomic writes, JSON with digests, the run log, the folder lock, the manifest.

`write_atomic` replaces a file in one step. `write_json_with_digest` and `read_json_with_digest` store a JSON object
together with a digest of its content, so that corruption is reported when the file is read. `append_log_rows` and
`read_log_rows` store a digest in every line of a run's `metrics.jsonl`. `FolderLock` allows only one writer per folder,
and `make_manifest` and `check_manifest` refuse a checkpoint that was saved under another configuration.

Log rows reach the disk before the checkpoint of their step is saved, so the log always has all rows up to a
checkpoint. On resume, the rows after the restored step are dropped and written again.
"""

import contextlib
import hashlib
import json
import math
import os
import socket
import uuid
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError

try:
    import fcntl
except ImportError:  # not a POSIX system: nothing is locked there
    fcntl = None


#: Refusal of a file of version 0.1, which only that version reads.
WRITTEN_BY_0_1 = "written by jaxnav 0.1; train again, or read it with jaxnav 0.1"


def expand_home(path: str | Path) -> Path:
    """Return a path in which a leading `~` or `~user` is replaced by the home folder.

    Raises:
      InputError: unknown user or home folder, or a path with a zero byte.
    """
    if "\0" in str(path):
        raise InputError(f"{path}: contains a zero byte, which no path can; remove it")
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        first_part = Path(path).parts[0]
        raise InputError(f"{path}: {first_part} has no home folder; write the whole path") from error


def write_atomic(path: Path, data: bytes) -> None:
    """Replace a file in one step.

    A reader, or a crash at any moment, sees either the old content or the new content, never a part of it. Missing
    parent folders are created.

    Raises:
      OSError: the file cannot be written; `path` is unchanged.
    """
    # The temporary file is in the same folder, because a rename is atomic only within one file system.
    path.parent.mkdir(parents=True, exist_ok=True)
    # A part of the name keeps it within the limit of the file system; other writers have other temporary files.
    temporary_path = path.with_name(f".{path.name[:40]}.{uuid.uuid4().hex}.tmp")
    try:
        with _name_file(path), temporary_path.open("wb") as temporary_file:
            temporary_file.write(data)
            temporary_file.flush()
            os.fsync(temporary_file.fileno())  # the content is on the disk before the name points to it
        os.replace(temporary_path, path)
    finally:
        temporary_path.unlink(missing_ok=True)


@contextlib.contextmanager
def _name_file(path: Path) -> Iterator[None]:
    """Name the file in errors that name none, such as those of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


# JSON records with a digest

#: Key of the digest in a record. The digest guards against damage, not against forgery.
DIGEST_KEY = "digest"


def add_digest(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record, converted to plain JSON values, with the digest of its content.

    Raises:
      ValueError: the record has a field of that name, which would be lost.
    """
    if DIGEST_KEY in record:
        raise ValueError(f"the field {DIGEST_KEY!r} is the digest of the record; give another name")
    plain_record = json.loads(json.dumps(record, allow_nan=False))
    return plain_record | {DIGEST_KEY: _record_digest(plain_record)}


def verify_digest(source: object, record: Mapping[str, Any], remedy: str) -> dict[str, Any]:
    """Check a record against its digest and return the record without it.

    Args:
      source: name of the record, for the message.
      record: content of a file.
      remedy: advice for the message, in case the record is damaged.

    Raises:
      InputError: the digest does not match the content, or is missing, as in records of jaxnav 0.1.
    """
    if DIGEST_KEY not in record:
        raise InputError(f"{source}: has no digest, so it is damaged ({remedy}) or {WRITTEN_BY_0_1}")
    plain_record = {name: value for name, value in record.items() if name != DIGEST_KEY}
    if record[DIGEST_KEY] != _record_digest(plain_record):
        raise InputError(f"{source}: is damaged or was edited (its digest does not match); {remedy}")
    return plain_record


def write_json_with_digest(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record and its digest atomically.

    Raises:
      OSError: the file cannot be written; `path` is unchanged.
    """
    write_atomic(path, (json.dumps(add_digest(record), indent=2) + "\n").encode())


def read_json_with_digest(path: Path, remedy: str) -> dict[str, Any]:
    """Read a record and verify its digest.

    Args:
      path: file to read.
      remedy: advice for the message, in case the file cannot be used.

    Returns:
      The record without its digest.

    Raises:
      InputError: the file is missing, not a JSON object, or damaged.
    """
    try:
        record = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error}); {remedy}") from error
    if not isinstance(record, dict):
        raise InputError(f"{path}: does not contain a JSON object; {remedy}")
    return verify_digest(path, record, remedy)


def _record_digest(plain_record: Mapping[str, Any]) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a record."""
    canonical_text = json.dumps(plain_record, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical_text.encode()).hexdigest()[:16]


# The folder lock

#: File that the writer of a folder holds locked.
LOCK_FILE = ".lock"


class FolderLock:
    """Exclusive lock on a folder, so that no other process writes to it.

    The operating system releases the lock when the process ends, even if it is killed, so a leftover lock file locks
    nothing. On file systems without locks, nothing is locked.
    """

    def __init__(self, folder: Path) -> None:
        """Prepare the lock of a folder without acquiring it."""
        self._path = folder / LOCK_FILE
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Lock the folder, which must exist.

        Raises:
          InputError: another process, or another lock of this process, holds the folder.
          OSError: the folder is missing or cannot be written.
        """
        # Lock the file without waiting.
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder_name = os.read(descriptor, 200).decode(errors="replace") or "another process"
            os.close(descriptor)
            raise InputError(
                f"{self._path.parent}: {holder_name} is writing to it; wait until it ends, stop it, or choose another "
                "run directory"
            ) from error
        except OSError:  # a file system without locks
            pass

        # The holder writes its name to the file, for the error message of later processes.
        self._descriptor = descriptor
        os.truncate(descriptor, 0)
        with _name_file(self._path):
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())

    def check(self) -> None:
        """Check that the locked folder has not been removed or replaced on disk.

        Raises:
          InputError: the folder or its lock file was removed or replaced.
        """
        if self._descriptor is None:
            return
        try:
            is_same_file = os.path.samestat(os.fstat(self._descriptor), os.stat(self._path))
        except FileNotFoundError:
            is_same_file = False
        if not is_same_file:
            raise InputError(
                f"{self._path.parent}: was removed or replaced, or its {LOCK_FILE} was, while this run wrote to it; "
                "restore it, or train again"
            )

    def release(self) -> None:
        """Unlock the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


# The run log: one JSON object with its digest per line

LogRow = Mapping[str, int | float | str | None]


def append_log_rows(path: Path, rows: Sequence[LogRow]) -> None:
    """Append rows to a log and wait until they are on the disk.

    A row has an int `step`. NaN and infinities are written as null, since JSON cannot express them.
    """
    with _name_file(path), path.open("ab") as log_file:
        log_file.write(_encode_rows(rows))
        log_file.flush()
        os.fsync(log_file.fileno())


def write_log_rows(path: Path, rows: Sequence[LogRow]) -> None:
    """Write a log, which replaces the file atomically."""
    write_atomic(path, _encode_rows(rows))


def read_log_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a log in order.

    A last line that a crash cut short is skipped; a missing file has no rows.

    Raises:
      InputError: a line other than the last is no JSON object with an int `step`, or a row is damaged.
    """
    try:
        log_lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); move it away, or restore the file") from error

    # A crash can cut short only the last line, so only the last line may be broken.
    rows: list[dict[str, Any]] = []
    for line_number, line in enumerate(log_lines, start=1):
        source = f"{path}, line {line_number}"
        row = _parse_row(line)
        if row is not None:
            rows.append(verify_digest(source, row, "restore the file, or remove the line"))
        elif line_number < len(log_lines):
            raise InputError(f"{source}: not a JSON object with a whole number `step`; remove the line")
    return rows


def truncate_log_after(path: Path, step: int) -> None:
    """Drop the rows later than a step.

    An incomplete last line is dropped too; a missing log stays missing.

    Raises:
      InputError: see `read_log_rows`; the log is then unchanged.
    """
    if path.exists():
        remaining_rows = [row for row in read_log_rows(path) if row["step"] <= step]
        write_log_rows(path, remaining_rows)


def _encode_rows(rows: Sequence[LogRow]) -> bytes:
    """Return rows as JSON lines, each with its digest."""
    encoded_lines = []
    for row in rows:
        # The digest covers the row as it is written, with null for NaN and infinities.
        finite_row = {name: _finite_or_none(value) for name, value in row.items()}
        encoded_lines.append(json.dumps(add_digest(finite_row)).encode() + b"\n")
    return b"".join(encoded_lines)


def _finite_or_none(value: float | str | None) -> float | str | None:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _parse_row(line: bytes) -> dict[str, Any] | None:
    """Return the row of a line, or None if the line is no row."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and type(row.get("step")) is int else None


# The manifest of a checkpoint

#: Increased whenever the stored state changes in a way that older code cannot read.
CHECKPOINT_FORMAT_VERSION = 3

#: Packages that shape the stored state.
_PACKAGES = ("jaxnav", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


def make_manifest(config: Mapping[str, Any]) -> dict[str, Any]:
    """Make the manifest of a run: `format_version`, `config` and package `versions`, as plain JSON values.

    Args:
      config: nested mapping of JSON values; tuples become lists.
    """
    manifest = {
        "format_version": CHECKPOINT_FORMAT_VERSION,
        "config": config,
        "versions": installed_versions(_PACKAGES),
    }
    return json.loads(json.dumps(manifest))


def check_manifest(source: object, saved: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of another format version or another config.

    Package versions may differ.

    Args:
      source: name of the checkpoint, for the message.
      saved: manifest in the checkpoint.
      expected: manifest of the run that resumes from the checkpoint.

    Raises:
      InputError: another format version, or another config; names the keys and both values.
    """
    # Another format may store the config in another way: check the version first.
    if saved["format_version"] != expected["format_version"]:
        raise InputError(
            f"{source}: has format version {saved['format_version']!r}, this code reads version "
            f"{expected['format_version']!r}; use the jaxnav that wrote it ({saved['versions'].get('jaxnav')})"
        )

    # The message names every value that differs, with the saved one first.
    mismatches = list_differences(saved["config"], expected["config"])
    if mismatches:
        raise InputError(
            f"{source}: was saved with another configuration (saved != requested): {'; '.join(mismatches)}; "
            "restore these values or choose another run directory"
        )


def list_differences(first: Mapping[str, Any], second: Mapping[str, Any], prefix: str = "") -> list[str]:
    """List the differences between two nested mappings.

    Returns:
      A line `"train.lr: 0.1 != 0.2"` for each dotted key, with `(absent)` for a missing value.
    """
    # Keys of either mapping; a missing value differs from every value.
    difference_lines = []
    for key in sorted(first.keys() | second.keys()):
        first_value = first.get(key, _ABSENT)
        second_value = second.get(key, _ABSENT)
        if isinstance(first_value, Mapping) and isinstance(second_value, Mapping):
            difference_lines += list_differences(first_value, second_value, f"{prefix}{key}.")
        elif first_value != second_value:
            difference_lines.append(f"{prefix}{key}: {first_value!r} != {second_value!r}")
    return difference_lines


class _Absent:
    """Value of a key that a mapping does not have."""

    def __repr__(self) -> str:
        return "(absent)"


_ABSENT = _Absent()


def installed_versions(package_names: Sequence[str]) -> dict[str, str]:
    """Look up the versions of packages; jaxnav is `source` when it runs uninstalled."""
    # A source tree has no metadata of its own, while its dependencies are always installed.
    versions = {}
    for package_name in package_names:
        try:
            versions[package_name] = metadata.version(package_name)
        except metadata.PackageNotFoundError:
            versions[package_name] = "source"
    return versions
