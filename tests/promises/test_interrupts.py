"""A training that gets SIGINT or SIGTERM finishes its chunk, saves, and prints how to continue.

Seen to fail: with a handler that stays installed after the first signal, so that the second Ctrl-C ends nothing.
"""

import re
import signal
import threading
import time

import pytest
from rich.console import Console
from support.commands import train
from support.processes import free_address, start_python, start_training_process, wait_for_processes
from support.tiny_run import write_config

from jaxnav.cli.console import run_command
from jaxnav.errors import Interrupted
from jaxnav.runs import train as train_module
from jaxnav.runs.train import Interrupts

TIME_LIMIT_S = 30
#: Options for 60 updates. Checkpoints are rare, so the one after a signal was saved because of the signal.
LONG_RUN = ("--total-steps", 60 * 128, "--save-every", 7)


@pytest.fixture(autouse=True)
def sigint_handler():
    """Python's handler of SIGINT, as in a terminal: a shell that starts the tests in the background ignores SIGINT."""
    old_handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, old_handler)


@pytest.fixture(scope="module")
def undisturbed_dir(tmp_path_factory):
    """Directory of a run that no signal interrupts."""
    folder = tmp_path_factory.mktemp("whole")
    assert train(write_config(folder), folder / "run", *LONG_RUN) == 0
    return folder / "run"


@pytest.mark.slow
def test_interrupted_run_saves_and_resumes_bit_for_bit(undisturbed_dir, tmp_path, capsys):
    config_file = write_config(tmp_path)
    # A name that Orbax by itself cannot read (promise 24).
    run_dir = tmp_path / "ended[1]"

    # Interrupt the training after its first chunk.
    process = start_python(["train.py", "--config", config_file, "--run-dir", run_dir, *LONG_RUN])
    while process.poll() is None and not (run_dir / "metrics.jsonl").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=TIME_LIMIT_S)

    # The process ends with one line, and its only checkpoint is that of the update in this line.
    assert process.returncode == 130, error
    match = re.fullmatch(
        rf"interrupted: {re.escape(str(run_dir))}: stopped after update (\d+) of 60 and saved; "
        "run the same command again to continue",
        error.splitlines()[-1],
    )
    assert match, error
    assert "Traceback" not in error
    last_update = match[1]
    assert [path.name for path in (run_dir / "checkpoints").iterdir()] == [last_update]

    # The same command resumes, and the run ends like one without an interrupt.
    assert train(config_file, run_dir, *LONG_RUN) == 0
    assert f"resumed after update {last_update} of 60" in capsys.readouterr().err
    for name in ("metrics.jsonl", "policies/baseline-1/params.safetensors", "policies/layout-0/params.safetensors"):
        assert (run_dir / name).read_bytes() == (undisturbed_dir / name).read_bytes(), name


@pytest.mark.exhaustive
def test_signal_to_one_process_ends_both_at_the_same_chunk(tmp_path):
    """Both processes save the same chunk, end with the code of the signal, and resume together."""
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "ended"
    first_address = free_address()
    second_address = free_address()

    # Signal one of two processes after the first chunk.
    processes = [start_training_process(first_address, index, config_file, run_dir, *LONG_RUN) for index in range(2)]
    while all(process.poll() is None for process in processes) and not (run_dir / "metrics.jsonl").exists():
        time.sleep(0.02)
    processes[1].send_signal(signal.SIGTERM)
    exit_codes, messages = wait_for_processes(*processes, timeout=2 * TIME_LIMIT_S)
    assert exit_codes == [143, 143], messages

    # Both name the same update, which has the only checkpoint.
    pattern = r"interrupted: .* stopped after update (\d+) of 60 and saved"
    (last_update,) = {re.findall(pattern, message)[-1] for message in messages}
    assert [path.name for path in (run_dir / "checkpoints").iterdir()] == [last_update]

    # The same commands resume after this update.
    processes = [start_training_process(second_address, index, config_file, run_dir, *LONG_RUN) for index in range(2)]
    exit_codes, messages = wait_for_processes(*processes)
    assert exit_codes == [0, 0], messages
    assert f"resumed after update {last_update} of 60" in messages[0]


def test_interrupts_note_the_first_signal_and_restore_the_default_for_the_second():
    for number in (signal.SIGINT, signal.SIGTERM):
        old_handler = signal.getsignal(number)
        with Interrupts() as interrupts:
            assert interrupts.pending_signal() == 0
            signal.raise_signal(number)
            assert interrupts.pending_signal() == number

            # The default handlers of the system are back: they end the process at once.
            for handled_number in (signal.SIGINT, signal.SIGTERM):
                assert signal.getsignal(handled_number) == signal.SIG_DFL
        assert signal.getsignal(number) == old_handler


def test_interrupts_keep_an_ignored_signal_ignored():
    """A run that `nohup` or a script starts in the background ignores SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert interrupts.pending_signal() == 0
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN


@pytest.mark.exhaustive
def test_signal_during_the_last_save_is_reported(tmp_path, capsys, monkeypatch):
    """The interrupted run is saved but not exported; the same command exports it."""
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    original_save = train_module.save_checkpoint

    def save_with_signal(folder, step, *arguments):
        if step == 4:  # the last update
            signal.raise_signal(signal.SIGTERM)
        original_save(folder, step, *arguments)

    monkeypatch.setattr(train_module, "save_checkpoint", save_with_signal)
    assert train(config_file, run_dir) == 143
    message = f"interrupted: {run_dir}: stopped after update 4 of 4 and saved; run the same command again to continue"
    assert message in capsys.readouterr().err
    assert not (run_dir / "policies").exists()

    monkeypatch.undo()
    assert train(config_file, run_dir) == 0
    assert (run_dir / "policies").exists()


def test_interrupts_work_in_threads_without_signal_handlers():
    pending_signals = []

    def enter_interrupts():
        with Interrupts() as interrupts:
            pending_signals.append(interrupts.pending_signal())

    thread = threading.Thread(target=enter_interrupts)
    thread.start()
    thread.join()
    assert pending_signals == [0]


@pytest.mark.parametrize(
    ("interrupt", "exit_code", "message"),
    [
        (Interrupted(signal.SIGTERM, "runs/a: saved"), 143, "interrupted: runs/a: saved; run the same command again"),
        (Interrupted(signal.SIGINT, "runs/a: saved"), 130, "interrupted: runs/a: saved; run the same command again"),
        (KeyboardInterrupt(), 130, "interrupted: "),
    ],
)
def test_run_command_reports_an_interrupt_in_one_line(capsys, interrupt, exit_code, message):
    def command(_: Console) -> None:
        raise interrupt

    assert run_command(command) == exit_code
    error = capsys.readouterr().err
    assert error.startswith(message)
    assert error.count("\n") == 1
