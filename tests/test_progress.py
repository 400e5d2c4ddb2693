"""Progress of long activities, on a terminal and in a pipe."""

import io

import pytest
from rich.console import Console

from jaxnav import progress
from jaxnav.progress import show_activity


class ManualTimer:
    """A timer that runs out when the test says so."""

    def __init__(self, seconds, function, args):
        self.seconds, self.function, self.args = seconds, function, args
        self.is_running = False
        ManualTimer.last = self

    def start(self):
        self.is_running = True

    def cancel(self):
        self.is_running = False

    def run_out(self):
        if self.is_running:
            self.function(*self.args)


@pytest.fixture
def pipe(monkeypatch):
    """A console that writes into a pipe, with a manual timer."""
    monkeypatch.setattr(progress.threading, "Timer", ManualTimer)
    return Console(file=io.StringIO(), width=80)


def test_a_long_activity_gets_a_line_in_a_pipe(pipe):
    with show_activity(pipe, "compiling 20 scenes"):
        assert pipe.file.getvalue() == ""
        assert ManualTimer.last.seconds == 3.0
        ManualTimer.last.run_out()
        assert pipe.file.getvalue() == "compiling 20 scenes ...\n"


def test_a_short_or_failed_activity_gets_no_line(pipe):
    with show_activity(pipe, "drawing"):
        pass
    ManualTimer.last.run_out()
    with pytest.raises(ValueError, match="no scenes"), show_activity(pipe, "drawing"):
        raise ValueError("no scenes")
    ManualTimer.last.run_out()
    assert pipe.file.getvalue() == ""


def test_a_terminal_shows_a_spinner_at_once(monkeypatch):
    monkeypatch.setattr(progress.threading, "Timer", None)  # no timer is made
    output = io.StringIO()
    terminal = Console(file=output, width=80, force_terminal=True, color_system=None)
    with show_activity(terminal, "compiling 20 scenes"):
        pass
    assert "compiling 20 scenes" in output.getvalue()
