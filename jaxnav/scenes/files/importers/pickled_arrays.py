"""Pickles read without running code.

They may hold dicts, lists, texts, numbers and arrays of numbers.
"""

import bz2
import pickle
import re
import reprlib
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from jaxnav.errors import InputError

#: Bytes of a file at most when decompressed: maps are nearly empty, so they compress well.
_LEAST, _MOST, _RATIO = 2**26, 2**32, 2000
_READS = 2**20  # of parts; a file of maps has some hundreds for each scene


class PickledArray:
    """Replace a NumPy array, whose unpickling trusts its input.

    Attributes:
      values: the array, of booleans, integers or floats.
    """

    values = np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        self.values = _array(data, dtype, shape, "F" if fortran else "C")


def read_pickle(path: Path) -> Any:
    """Read a pickle compressed by bz2.

    Arrays are `PickledArray`. Nothing else is known of the content: any part may be of any of these types or missing.

    Raises:
      InputError: the file is missing, damaged or too large, or asks for anything but arrays of numbers.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    with file, bz2.open(file) as stream:
        try:
            return _Reader(path, stream).load()
        except InputError:
            raise
        except Exception as error:  # on damaged bytes, bz2 and the unpickler raise errors of almost any type
            problem = f"is cut short, damaged or no bz2 pickle ({type(error).__name__})"
            raise InputError(f"{path}: {problem}; fetch or write it again") from error


class _Reader(pickle._Unpickler):  # in Python: ten bytes can make the one in C allocate 64 GiB
    """Read pickled arrays of numbers, and no other classes."""

    dispatch = pickle._Unpickler.dispatch.copy()
    dispatch[pickle.BYTEARRAY8[0]] = dispatch[pickle.BINBYTES8[0]]  # the former allocates before it reads

    def __init__(self, path: Path, stream: IO[bytes]):
        super().__init__(_Limited(path, stream))
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        """Return a bound method or a text.

        A pickle could change the attributes of a class or a function.
        """
        known = {
            "numpy.ndarray": "ndarray",
            "numpy.dtype": self._dtype,
            "numpy.multiarray._reconstruct": self._reconstruct,
            "numpy.multiarray.scalar": self._scalar,
            "numpy.numeric._frombuffer": self._from_buffer,
        }
        replacement = known.get(re.sub(r"^numpy\._?core\.", "numpy.", module) + "." + name)
        if replacement is None:
            asked = reprlib.repr(f"{module}.{name}")
            raise InputError(
                f"{self._path}: asks for {asked}, which could run code; give NumPy arrays of numbers alone"
            )
        return replacement

    def _dtype(self, code: str, *_: object) -> "_Dtype":
        return _Dtype(code)

    def _reconstruct(self, *_: object) -> PickledArray:
        return PickledArray()

    def _scalar(self, dtype: "_Dtype", data: bytes) -> float | int | bool:
        return _array(data, dtype, (), "C").item()

    def _from_buffer(
        self, data: bytes, dtype: "_Dtype", shape: tuple[int, ...], order: Literal["C", "F"], *_: object
    ) -> PickledArray:
        array = PickledArray()
        array.values = _array(data, dtype, shape, order)
        return array


class _Dtype:
    """Replace `numpy.dtype`, for numbers only."""

    def __init__(self, code: str):
        if not re.fullmatch("[biuf][1248]", code):
            raise ValueError(code)
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


def _array(data: bytes, dtype: _Dtype, shape: tuple[int, ...], order: Literal["C", "F"]) -> np.ndarray:
    return np.frombuffer(data, dtype.dtype).reshape(shape, order=order)


class _Limited:
    """Read so many bytes and parts of a stream at most."""

    def __init__(self, path: Path, stream: IO[bytes]):
        self._path, self._stream, self._reads = path, stream, _READS
        self._most = self._left = min(max(_LEAST, _RATIO * path.stat().st_size), _MOST)

    def read(self, size: int) -> bytes:
        self._take(size)
        return self._stream.read(size)

    def readline(self) -> bytes:
        line = self._stream.readline(self._left + 1)
        self._take(len(line))
        return line

    def _take(self, size: int) -> None:
        self._left, self._reads = self._left - size, self._reads - 1
        if self._left < 0:
            raise InputError(f"{self._path}: holds more than {self._most:,} bytes; split it")
        if self._reads < 0:
            raise InputError(f"{self._path}: holds more than {_READS:,} parts; split it, or give arrays")
