"""Atomic replacement of files."""

import os

import pytest

from jaxnav.store.files import write_atomic


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
