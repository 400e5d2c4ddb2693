"""The play command in a pseudo terminal, and where there is none."""

import os
import re
import subprocess
import sys

import pytest

from jaxnav.__main__ import main

pty = pytest.importorskip("pty")


def until(controller, words, shown=""):
    """What is written to a terminal, until some words."""
    while words not in shown:
        shown += os.read(controller, 65536).decode(errors="replace")
    return shown


@pytest.mark.slow
def test_play_runs_an_episode_in_a_terminal():
    controller, terminal = pty.openpty()
    command = [sys.executable, "-m", "jaxnav", "play", "--policy", "rooms-org", "--goal", "Laptop", "--seed", "2"]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "90", "LINES": "40"}
    process = subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=subprocess.DEVNULL, env=environment)
    os.close(terminal)
    try:
        first = until(controller, "q quit")
        assert re.search(r"step 0 of \d00, ", first)
        assert "the policy: " in first
        os.write(controller, b"\x1b[D")
        assert re.search(r"step 1 of \d00, ", until(controller, "q quit"))
        os.write(controller, b"q")
        assert re.search(r"left after 1 actions; a shortest path takes \d+\. ", until(controller, "SPL"))
        os.close(controller)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()


def test_play_is_refused_without_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    assert main(["play"]) == 2
    assert "play: the input is not a terminal; start the command" in " ".join(capsys.readouterr().err.split())
    sys.stdin.close()
