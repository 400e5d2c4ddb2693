"""Pickles of numeric arrays, and refusals of any other pickle."""

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


def write_pickle(pickle_file: Path, pickle_bytes: bytes) -> Path:
    """Compress the bytes of a pickle to a file."""
    pickle_file.write_bytes(bz2.compress(pickle_bytes))
    return pickle_file


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("dtype", ["float64", "float32", "uint8", "bool", ">i2"])
def test_read_pickle_reads_arrays_of_every_protocol(tmp_path, protocol, dtype):
    original_values = np.arange(24).reshape(2, 3, 4).astype(dtype)
    for array in (original_values, np.asfortranarray(original_values)):
        pickle_bytes = pickle.dumps([array, array, np.float32(1.5)], protocol)
        values_read = read_pickle(write_pickle(tmp_path / "a.pbz2", pickle_bytes))
        assert values_read[0].values.dtype == original_values.dtype
        np.testing.assert_array_equal(values_read[0].values, original_values)
        assert values_read[0] is values_read[1]
        assert values_read[2] == 1.5


def test_read_pickle_reads_arrays_of_numpy_1(tmp_path):
    pickle_bytes = pickle.dumps([np.arange(3.0), np.ones(2, np.int64)], 3).replace(b"numpy._core.", b"numpy.core.")
    assert b"numpy._core" not in pickle_bytes
    first_array, second_array = read_pickle(write_pickle(tmp_path / "a.pbz2", pickle_bytes))
    assert (first_array.values.tolist(), second_array.values.tolist()) == ([0, 1, 2], [1, 1])


class Touch:
    """Make a file when unpickled freely."""

    def __init__(self, pickle_file: Path):
        self.path = pickle_file

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {self.path}",)


def test_read_pickle_refuses_a_pickle_that_runs_code(tmp_path):
    pickle_bytes = pickle.dumps([np.zeros(3), Touch(tmp_path / "ran")], 4)
    with pytest.raises(InputError, match=r"a\.pbz2: .*'\w+\.system'"):
        read_pickle(write_pickle(tmp_path / "a.pbz2", pickle_bytes))
    assert not (tmp_path / "ran").exists()

    # The control: pickle itself runs the code.
    pickle.load(io.BytesIO(pickle_bytes))
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("pickle_bytes", "expected_part"),
    [
        (b"cbuiltins\neval\n(S'1'\ntR.", r"builtins\.eval"),
        (b"cnumpy\nload\n(S'x'\ntR.", r"numpy\.load"),
        (b"cnumpy.core.multiarray\n_reconstruct.__globals__\n.", "__globals__"),
        (pickle.dumps(np.array([None]), 4), "damaged"),  # an array of objects
        (pickle.dumps(np.zeros(2, "U3"), 4), "damaged"),
        (b"\x80\x04\x8e" + struct.pack("<Q", 2**40), "more than"),  # a text of a terabyte
        (b"\x80\x05\x96" + struct.pack("<Q", 2**40), "more than"),
        (b"\x80\x04Nr\xff\xff\xff\xff", "damaged"),  # a memo of 4 G entries
        (b"", "damaged"),
    ],
)
def test_read_pickle_refuses_other_content(tmp_path, pickle_bytes, expected_part):
    with pytest.raises(InputError, match=r"a\.pbz2.*" + expected_part):
        read_pickle(write_pickle(tmp_path / "a.pbz2", pickle_bytes))


@pytest.mark.parametrize("numpy_name", ["dtype", "ndarray"])
def test_read_pickle_is_unchanged_by_a_malicious_pickle(tmp_path, numpy_name):
    # Two attributes are set on what the name gives, by the two ways that a pickle has.
    pickle_bytes = b"cnumpy\n%s\n}S'__setstate__'\nI1\ns}S'__init__'\nI1\ns\x86b." % numpy_name.encode()
    with pytest.raises(InputError, match="damaged"):
        read_pickle(write_pickle(tmp_path / "a.pbz2", pickle_bytes))
    assert read_pickle(write_pickle(tmp_path / "a.pbz2", pickle.dumps(np.ones(1)))).values.tolist() == [1]


def test_read_pickle_refuses_more_bytes_than_its_limit(tmp_path, monkeypatch):
    pickle_file = write_pickle(tmp_path / "a.pbz2", pickle.dumps(np.zeros(100_000, np.uint8)))
    monkeypatch.setattr(pickled_arrays, "_MAX_BYTE_LIMIT", 50_000)
    with pytest.raises(InputError, match="50,000 bytes"):
        read_pickle(pickle_file)


@pytest.mark.parametrize("end", [-10, 50])
def test_read_pickle_refuses_a_file_cut_short(tmp_path, end):
    pickle_file = write_pickle(tmp_path / "a.pbz2", pickle.dumps(np.zeros(100_000, np.uint8)))
    pickle_file.write_bytes(pickle_file.read_bytes()[:end])
    with pytest.raises(InputError, match="cut short"):
        read_pickle(pickle_file)


def test_read_pickle_refuses_other_formats_and_missing_files(tmp_path):
    pickle_file = tmp_path / "a.pbz2"
    pickle_file.write_bytes(b"no bz2")
    with pytest.raises(InputError, match="not a bz2 pickle"):
        read_pickle(pickle_file)
    with pytest.raises(InputError, match="cannot be read"):
        read_pickle(tmp_path / "none.pbz2")
