"""Atomic replacement of files."""

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


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    """The error of a write names no file; that of an open does."""

    def fail(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    for write in (lambda path: write_atomic(path, b"data"), lambda path: append_log_rows(path, [])):
        with pytest.raises(OSError, match="No space left on device") as error:
            write(tmp_path / "new")
        assert error.value.filename == str(tmp_path / "new")
