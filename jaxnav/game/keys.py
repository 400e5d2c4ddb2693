"""Reading single key presses from a terminal."""

import contextlib
import os
import re
from collections.abc import Iterator
from typing import TextIO

from jaxnav.errors import InputError

_KEY_NAMES: dict[bytes, str] = {b"\x1b[A": "up", b"\x1b[C": "right", b"\x1b[D": "left", b"\r": "enter", b"\n": "enter"}
_KEY_PATTERN = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-D]|.", re.DOTALL)


@contextlib.contextmanager
def read_keys(stream: TextIO) -> Iterator[Iterator[str]]:
    """Yield an iterator over the keys as they are pressed, without echo.

    A key is its character, or `up`, `left`, `right` or `enter`. The terminal's settings are restored afterwards.

    Raises:
      InputError: the stream is no terminal, or the system has no Unix terminals.
    """
    # These modules are missing on other systems, where the package can be imported all the same.
    try:
        import termios
        import tty
    except ImportError as error:
        raise InputError("play: needs a terminal of a Unix system; there is none here") from error
    if not stream.isatty():
        raise InputError("play: the input is no terminal; start it in one, without a pipe or a file as input")

    # Without line buffering and echo, each key arrives as it is pressed.
    descriptor = stream.fileno()
    saved_settings = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield _key_names(descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, saved_settings)


def _key_names(descriptor: int) -> Iterator[str]:
    """Yield the names of keys until the end of the input."""
    while True:
        input_bytes = os.read(descriptor, 64)
        if not input_bytes:
            return
        for key_bytes in _KEY_PATTERN.findall(input_bytes):
            # Terminals send arrows as ESC [ A or, in application mode, as ESC O A.
            key_name = _KEY_NAMES.get(key_bytes.replace(b"\x1bO", b"\x1b["))
            yield key_name or key_bytes.decode(errors="replace")
