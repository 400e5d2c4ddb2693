"""Reading of pickles without running their code.

`read_pickle` accepts dicts, lists, texts, numbers and NumPy arrays of numbers, and refuses everything else. Sizes and
numbers of parts are capped, because a small damaged or hostile file could otherwise fill the memory.
"""

import bz2
import pickle
import re
import reprlib
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from jaxnav.errors import InputError

# A file may hold `_MAX_RATIO` times its size when decompressed, within these bounds: maps are nearly empty, so they
# compress well.
_MIN_BYTE_LIMIT = 2**26
_MAX_BYTE_LIMIT = 2**32
_MAX_RATIO = 2000
_MAX_READS = 2**20  # of parts; a file of maps has some hundreds for each scene

# NumPy 2 has renamed the module `numpy.core` to `numpy._core`.
_NUMPY_CORE = re.compile(r"^numpy\._?core\.")


class PickledArray:
    """Stand-in for a NumPy array, whose own unpickling trusts its input.

    Attributes:
      values: the array, of booleans, integers or floats.
    """

    values = np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, is_fortran, data = state
        self.values = _decode_array(data, dtype, shape, "F" if is_fortran else "C")


def read_pickle(path: Path) -> Any:
    """Read a pickle compressed by bz2.

    Arrays are `PickledArray`s. The caller must check the content: any part may be of any of the types or missing.

    Raises:
      InputError: the file is missing, damaged or too large, or asks for anything but arrays of numbers.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error

    # Own errors pass through; all others come from damaged bytes.
    with file, bz2.open(file) as stream:
        try:
            return _NumberUnpickler(path, stream).load()
        except InputError:
            raise
        except Exception as error:  # on damaged bytes, bz2 and the unpickler raise errors of almost any type
            problem = f"is cut short, damaged or not a bz2 pickle ({type(error).__name__})"
            raise InputError(f"{path}: {problem}; download or write it again") from error


class _NumberUnpickler(pickle._Unpickler):
    """Unpickler of arrays of numbers, and of no other classes.

    The base class is the one in Python, because ten bytes can make the one in C allocate 64 GiB.
    """

    # The original handler of BYTEARRAY8 allocates before it reads.
    dispatch = pickle._Unpickler.dispatch.copy()
    dispatch[pickle.BYTEARRAY8[0]] = dispatch[pickle.BINBYTES8[0]]

    def __init__(self, path: Path, stream: IO[bytes]):
        super().__init__(_LimitedStream(path, stream))
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        """Return a stand-in for a class or function of NumPy.

        Stand-ins are bound methods or texts, since a pickle could change the attributes of a class or a function.
        """
        stand_ins = {
            "numpy.ndarray": "ndarray",
            "numpy.dtype": self._dtype,
            "numpy.multiarray._reconstruct": self._reconstruct,
            "numpy.multiarray.scalar": self._scalar,
            "numpy.numeric._frombuffer": self._from_buffer,
        }
        stand_in = stand_ins.get(f"{_NUMPY_CORE.sub('numpy.', module)}.{name}")
        if stand_in is None:
            problem = f"refers to {reprlib.repr(f'{module}.{name}')}, which could run code"
            raise InputError(f"{self._path}: {problem}; give only NumPy arrays of numbers")
        return stand_in

    def _dtype(self, code: str, *_: object) -> "_NumberDtype":
        return _NumberDtype(code)

    def _reconstruct(self, *_: object) -> PickledArray:
        return PickledArray()

    def _scalar(self, dtype: "_NumberDtype", scalar_bytes: bytes) -> float | int | bool:
        return _decode_array(scalar_bytes, dtype, (), "C").item()

    def _from_buffer(
        self,
        array_bytes: bytes,
        dtype: "_NumberDtype",
        array_shape: tuple[int, ...],
        memory_order: Literal["C", "F"],
        *_: object,
    ) -> PickledArray:
        pickled_array = PickledArray()
        pickled_array.values = _decode_array(array_bytes, dtype, array_shape, memory_order)
        return pickled_array


class _NumberDtype:
    """Stand-in for `numpy.dtype`, for numbers only."""

    def __init__(self, code: str):
        # Booleans, integers and floats of 1 to 8 bytes; no objects and no texts.
        if not re.fullmatch("[biuf][1248]", code):
            raise ValueError(code)
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


def _decode_array(
    array_bytes: bytes, dtype: _NumberDtype, array_shape: tuple[int, ...], memory_order: Literal["C", "F"]
) -> np.ndarray:
    return np.frombuffer(array_bytes, dtype.dtype).reshape(array_shape, order=memory_order)


class _LimitedStream:
    """Stream that refuses to give more bytes or parts than a file may hold."""

    def __init__(self, path: Path, stream: IO[bytes]):
        self._path = path
        self._stream = stream
        self._byte_limit = min(max(_MIN_BYTE_LIMIT, _MAX_RATIO * path.stat().st_size), _MAX_BYTE_LIMIT)
        self._remaining_bytes = self._byte_limit
        self._remaining_reads = _MAX_READS

    def read(self, size: int) -> bytes:
        self._count(size)
        return self._stream.read(size)

    def readline(self) -> bytes:
        line_bytes = self._stream.readline(self._remaining_bytes + 1)
        self._count(len(line_bytes))
        return line_bytes

    def _count(self, num_bytes: int) -> None:
        """Count a read of some bytes, and refuse it beyond the limits."""
        self._remaining_bytes -= num_bytes
        self._remaining_reads -= 1
        if self._remaining_bytes < 0:
            raise InputError(f"{self._path}: holds more than {self._byte_limit:,} bytes; split it")
        if self._remaining_reads < 0:
            raise InputError(f"{self._path}: holds more than {_MAX_READS:,} parts; split it, or give arrays")
