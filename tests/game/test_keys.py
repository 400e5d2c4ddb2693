"""Keys come one by one from a terminal, which is left as it was."""

import io
import os

import pytest

from jaxnav.errors import InputError
from jaxnav.game.keys import read_keys

pty = pytest.importorskip("pty")
termios = pytest.importorskip("termios")


def test_keys_have_names_and_the_terminal_is_restored():
    controller, terminal = pty.openpty()
    with os.fdopen(terminal, "r+b", buffering=0) as raw, io.TextIOWrapper(raw) as stream:
        before = termios.tcgetattr(terminal)
        with read_keys(stream) as keys:
            during = termios.tcgetattr(terminal)[3]
            assert not during & (termios.ECHO | termios.ICANON)
            os.write(controller, b"w\x1b[A\x1b[D\x1bOC\r\x1b[5~q")
            assert [next(keys) for _ in range(7)] == ["w", "up", "left", "right", "enter", "\x1b[5~", "q"]
        assert termios.tcgetattr(terminal) == before
        with pytest.raises(KeyboardInterrupt), read_keys(stream):
            raise KeyboardInterrupt
        assert termios.tcgetattr(terminal) == before
    os.close(controller)


def test_what_is_no_terminal_is_refused(tmp_path):
    with (
        (tmp_path / "file").open("w+") as file,
        pytest.raises(InputError, match="play: the input is no terminal"),
        read_keys(file),
    ):
        pass
