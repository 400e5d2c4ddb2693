"""Pickles: arrays of numbers are read, all else is refused."""

import bz2
import io
import os
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers import pickled_arrays
from jaxnav.scenes.files.importers.pickled_arrays import read_pickle


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(bz2.compress(data))
    return path


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("dtype", ["float64", "float32", "uint8", "bool", ">i2"])
def test_arrays_are_read_in_every_protocol(tmp_path, protocol, dtype):
    values = np.arange(24).reshape(2, 3, 4).astype(dtype)
    for array in (values, np.asfortranarray(values)):
        values_read = read_pickle(write(tmp_path / "a.pbz2", pickle.dumps([array, array, np.float32(1.5)], protocol)))
        assert values_read[0].values.dtype == values.dtype
        np.testing.assert_array_equal(values_read[0].values, values)
        assert values_read[0] is values_read[1]
        assert values_read[2] == 1.5


def test_pickles_of_numpy_1_are_read(tmp_path):
    data = pickle.dumps([np.arange(3.0), np.ones(2, np.int64)], 3).replace(b"numpy._core.", b"numpy.core.")
    assert b"numpy._core" not in data
    first, second = read_pickle(write(tmp_path / "a.pbz2", data))
    assert (first.values.tolist(), second.values.tolist()) == ([0, 1, 2], [1, 1])


class Touch:
    """Make a file when unpickled freely."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {self.path}",)


def test_a_pickle_that_would_run_code_is_refused(tmp_path):
    data = pickle.dumps([np.zeros(3), Touch(tmp_path / "ran")], 4)
    with pytest.raises(InputError, match=r"a\.pbz2: asks for '\w+\.system', which could run code"):
        read_pickle(write(tmp_path / "a.pbz2", data))
    assert not (tmp_path / "ran").exists()
    pickle.load(io.BytesIO(data))  # the negative control
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"cbuiltins\neval\n(S'1'\ntR.", "asks for 'builtins.eval'"),
        (b"cnumpy\nload\n(S'x'\ntR.", "asks for 'numpy.load'"),
        (b"cnumpy.core.multiarray\n_reconstruct.__globals__\n.", "asks for"),
        (pickle.dumps(np.array([None]), 4), "is cut short, damaged"),  # an array of objects
        (pickle.dumps(np.zeros(2, "U3"), 4), "is cut short, damaged"),
        (b"\x80\x04\x8e" + struct.pack("<Q", 2**40), "holds more than"),  # a text of a terabyte
        (b"\x80\x05\x96" + struct.pack("<Q", 2**40), "holds more than"),
        (b"\x80\x04Nr\xff\xff\xff\xff", "is cut short, damaged"),  # a memo of 4 G entries
        (b"", "is cut short, damaged"),
    ],
)
def test_other_pickles_are_refused(tmp_path, data, problem):
    with pytest.raises(InputError, match=r"a\.pbz2.*" + problem):
        read_pickle(write(tmp_path / "a.pbz2", data))


@pytest.mark.parametrize("name", ["dtype", "ndarray"])
def test_a_pickle_cannot_change_how_later_ones_are_read(tmp_path, name):
    # Two attributes are set on what the name gives, by the two ways that a pickle has.
    data = b"cnumpy\n%s\n}S'__setstate__'\nI1\ns}S'__init__'\nI1\ns\x86b." % name.encode()
    with pytest.raises(InputError, match="is cut short, damaged"):
        read_pickle(write(tmp_path / "a.pbz2", data))
    assert read_pickle(write(tmp_path / "a.pbz2", pickle.dumps(np.ones(1)))).values.tolist() == [1]


def test_damaged_missing_and_exploding_files_are_refused(tmp_path, monkeypatch):
    path = write(tmp_path / "a.pbz2", pickle.dumps(np.zeros(100_000, np.uint8)))
    whole = path.read_bytes()
    monkeypatch.setattr(pickled_arrays, "_MAX_BYTE_LIMIT", 50_000)
    with pytest.raises(InputError, match="holds more than 50,000 bytes"):
        read_pickle(path)
    monkeypatch.undo()
    for data in (whole[:-10], whole[:50], b"no bz2"):
        path.write_bytes(data)
        with pytest.raises(InputError, match="is cut short, damaged or no bz2 pickle"):
            read_pickle(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_pickle(tmp_path / "none.pbz2")
