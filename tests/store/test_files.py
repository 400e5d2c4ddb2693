"""Atomic replacement of files."""

import concurrent.futures
import errno
import os

import pytest

from jaxnav.store.files import append_log_rows, write_atomic


def test_write_atomic_keeps_the_old_file_when_it_fails(tmp_path, monkeypatch):
    target_path = tmp_path / "file"
    write_atomic(target_path, b"old")

    def fail_to_sync(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail_to_sync)
    with pytest.raises(OSError, match="disk full"):
        write_atomic(target_path, b"new")
    assert target_path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target_path]


def test_files_with_long_equal_beginnings_are_written_side_by_side(tmp_path):
    # Temporary files have a part of the name, which must not be all that tells them apart.
    names = [f"{'a' * 60}-{index}" for index in range(4)]

    def write_and_read(name: str) -> bool:
        for _ in range(20):
            write_atomic(tmp_path / name, name.encode())
        return (tmp_path / name).read_text() == name

    with concurrent.futures.ThreadPoolExecutor() as threads:
        assert all(threads.map(write_and_read, names))
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    """The error of a write names no file; that of an open does."""

    def fail(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    for write in (lambda path: write_atomic(path, b"data"), lambda path: append_log_rows(path, [])):
        with pytest.raises(OSError, match="No space left on device") as error:
            write(tmp_path / "new")
        assert error.value.filename == str(tmp_path / "new")
