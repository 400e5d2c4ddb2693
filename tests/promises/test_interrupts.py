"""A training that is asked to end finishes its chunk, saves, and says how to go on.

Seen to fail: with a handler that does not step back after the first signal, so that the second Ctrl-C ends nothing.
"""

import re
import signal
import threading
import time

import pytest
from rich.console import Console
from support.commands import train
from support.processes import ends, free_address, run, start
from support.tiny_run import write_config

from jaxnav.cli.console import run_command
from jaxnav.errors import Interrupted
from jaxnav.runs import train as updates
from jaxnav.runs.train import Interrupts

LIMIT_S = 30
#: 60 updates; checkpoints are rare, so that the one after the signal is for the signal.
LONG = ("--total-steps", 60 * 128, "--save-every", 7)


@pytest.fixture(autouse=True)
def heeded():
    """SIGINT as in a terminal: a shell that starts the tests in the background has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The directory of a run that is left alone."""
    folder = tmp_path_factory.mktemp("whole")
    assert train(write_config(folder), folder / "run", *LONG) == 0
    return folder / "run"


@pytest.mark.slow
def test_interrupted_run_saves_and_resumes_bit_for_bit(whole, tmp_path, capsys):
    config_file = write_config(tmp_path)
    # A name that Orbax by itself cannot read (promise 24).
    ended = tmp_path / "ended[1]"
    process = run(["train.py", "--config", config_file, "--run-dir", ended, *LONG])
    while process.poll() is None and not (ended / "metrics.jsonl").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130, error
    message = error.splitlines()[-1]
    match = re.fullmatch(
        rf"interrupted: {re.escape(str(ended))}: stopped after update (\d+) of 60 and saved; "
        "run the same command again to continue",
        message,
    )
    assert match, error
    assert "Traceback" not in error
    assert [path.name for path in (ended / "checkpoints").iterdir()] == [match[1]]
    assert train(config_file, ended, *LONG) == 0
    assert f"resumed after update {match[1]} of 60" in capsys.readouterr().err
    for name in ("metrics.jsonl", "policies/baseline-1/params.safetensors", "policies/layout-0/params.safetensors"):
        assert (ended / name).read_bytes() == (whole / name).read_bytes(), name


@pytest.mark.exhaustive
def test_signal_to_one_process_ends_both_at_the_same_chunk(tmp_path):
    """Both save the same chunk, end with the code of the signal, and go on together."""
    config_file = write_config(tmp_path)
    ended = tmp_path / "ended"
    address = free_address()
    again = free_address()
    both = [start(address, index, config_file, ended, *LONG) for index in range(2)]
    while all(process.poll() is None for process in both) and not (ended / "metrics.jsonl").exists():
        time.sleep(0.02)
    both[1].send_signal(signal.SIGTERM)
    codes, messages = ends(*both, timeout=2 * LIMIT_S)
    assert codes == [143, 143], messages
    (done,) = {
        re.findall(r"interrupted: .* stopped after update (\d+) of 60 and saved", message)[-1] for message in messages
    }
    assert [path.name for path in (ended / "checkpoints").iterdir()] == [done]
    codes, messages = ends(*(start(again, index, config_file, ended, *LONG) for index in range(2)))
    assert codes == [0, 0], messages
    assert f"resumed after update {done} of 60" in messages[0]


def test_interrupts_note_the_first_signal_and_restore_the_default_for_the_second():
    for number in (signal.SIGINT, signal.SIGTERM):
        before = signal.getsignal(number)
        with Interrupts() as interrupts:
            assert interrupts.pending_signal() == 0
            signal.raise_signal(number)
            assert interrupts.pending_signal() == number
            # What the system does by itself: it ends the process, wherever it is.
            assert {signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)} == {signal.SIG_DFL}
        assert signal.getsignal(number) == before


def test_interrupts_keep_an_ignored_signal_ignored():
    """As in a run that `nohup` or a script started in the background."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert interrupts.pending_signal() == 0
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN


@pytest.mark.exhaustive
def test_signal_during_the_last_save_is_reported(tmp_path, capsys, monkeypatch):
    """The run is saved and not exported; the same command exports it."""
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    whole_save = updates.save_checkpoint

    def interrupted(folder, step, *rest):
        if step == 4:  # the last
            signal.raise_signal(signal.SIGTERM)
        whole_save(folder, step, *rest)

    monkeypatch.setattr(updates, "save_checkpoint", interrupted)
    assert train(config_file, run_dir) == 143
    message = f"interrupted: {run_dir}: stopped after update 4 of 4 and saved; run the same command again to continue"
    assert message in capsys.readouterr().err
    assert not (run_dir / "policies").exists()
    monkeypatch.undo()
    assert train(config_file, run_dir) == 0
    assert (run_dir / "policies").exists()


def test_interrupts_work_in_threads_without_signal_handlers():
    seen = []

    def enter():
        with Interrupts() as interrupts:
            seen.append(interrupts.pending_signal())

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [0]


@pytest.mark.parametrize(
    ("end", "code", "message"),
    [
        (Interrupted(signal.SIGTERM, "runs/a: saved"), 143, "interrupted: runs/a: saved; run the same command again"),
        (Interrupted(signal.SIGINT, "runs/a: saved"), 130, "interrupted: runs/a: saved; run the same command again"),
        (KeyboardInterrupt(), 130, "interrupted: "),
    ],
)
def test_run_command_reports_an_interrupt_in_one_line(capsys, end, code, message):
    def command(_: Console) -> None:
        raise end

    assert run_command(command) == code
    error = capsys.readouterr().err
    assert error.startswith(message)
    assert error.count("\n") == 1
