"""Keys of a terminal, one by one."""

import contextlib
import os
import re
from collections.abc import Iterator
from typing import TextIO

from jaxnav.errors import InputError

_NAMES: dict[bytes, str] = {b"\x1b[A": "up", b"\x1b[C": "right", b"\x1b[D": "left", b"\r": "enter", b"\n": "enter"}
_KEY = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-D]|.", re.DOTALL)


@contextlib.contextmanager
def pressed(stream: TextIO) -> Iterator[Iterator[str]]:
    """Yield the keys as they are pressed, not echoed.

    Keys are their characters, or `up`, `left`, `right` and `enter`. The terminal is as it was afterwards.

    Raises:
      InputError: the stream is no terminal, or the system has none of this kind.
    """
    try:
        import termios
        import tty
    except ImportError as error:
        raise InputError("play: needs a terminal of a Unix system; there is none here") from error
    if not stream.isatty():
        raise InputError("play: the input is no terminal; start it in one, without a pipe or a file as input")
    descriptor = stream.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield _keys(descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _keys(descriptor: int) -> Iterator[str]:
    while data := os.read(descriptor, 64):
        for key in _KEY.findall(data):
            name = _NAMES.get(key.replace(b"\x1bO", b"\x1b["))
            yield name or key.decode(errors="replace")
