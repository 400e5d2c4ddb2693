"""One process at a time writes to a run directory.

Seen to fail: without `fcntl.flock` in `FolderLock.acquire` a second training is not refused; with a lock that counts as
held wherever its file exists, a killed training blocks the next one; without `FolderLock.check` a run whose directory
was removed ends as if all were well.
"""

import dataclasses
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from support.commands import train
from support.processes import REPOSITORY, start_python
from support.tiny_run import tiny_config, write_config

from jaxnav.errors import InputError
from jaxnav.runs.run import lock_run_dir
from jaxnav.store.files import LOCK_FILE, FolderLock

#: A program that locks the folder in its first argument, and keeps the lock until its input is closed.
LOCK_SCRIPT = """
import sys
from pathlib import Path
from jaxnav.runs.run import lock_run_dir
from jaxnav.store.files import FolderLock
FolderLock(Path(sys.argv[1])).acquire()
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def lock_process(tmp_path):
    """A process that holds the lock of the folder."""
    command = [sys.executable, "-c", LOCK_SCRIPT, str(tmp_path)]
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=REPOSITORY, **streams) as process:
        assert process.stdout
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_folder_lock_names_the_process_that_holds_it(tmp_path, lock_process):
    with pytest.raises(InputError) as error:
        FolderLock(tmp_path).acquire()
    process_name = re.escape(f"process {lock_process.pid} on {socket.gethostname()}")
    assert re.fullmatch(f"{tmp_path}: {process_name} is writing to it; wait until it ends, .*", str(error.value))


@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGTERM])
def test_folder_lock_of_a_dead_process_is_free(tmp_path, lock_process, signal_number):
    lock_process.send_signal(signal_number)
    lock_process.wait()
    assert str(lock_process.pid) in (tmp_path / LOCK_FILE).read_text()

    # The lock file of the dead process does not block this process, whose lock holds until its release.
    lock = FolderLock(tmp_path)
    lock.acquire()
    with pytest.raises(InputError, match=f"process {os.getpid()} on "):
        FolderLock(tmp_path).acquire()
    lock.release()
    FolderLock(tmp_path).acquire()


def test_folder_lock_check_refuses_a_removed_or_replaced_folder(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    lock = FolderLock(folder)
    lock.check()  # without a lock, as in the second process of a run
    lock.acquire()
    lock.check()

    # A removed folder.
    message = f"{folder}: was removed or replaced, or its .lock was, while this run wrote to it"
    shutil.rmtree(folder)
    with pytest.raises(InputError, match=message):
        lock.check()

    # A new folder of this name, which another process has locked.
    folder.mkdir()
    FolderLock(folder).acquire()
    with pytest.raises(InputError, match="was removed or replaced"):
        lock.check()


def test_lock_run_dir_refuses_a_second_run_until_released(tmp_path):
    config = tiny_config(tmp_path)
    other_config = dataclasses.replace(config, seed=5)

    # While a run holds the lock, it is refused a second time, and so is a run with other settings.
    with lock_run_dir(config):
        settings = (config.run_dir / "config.json").read_bytes()
        with pytest.raises(InputError, match=f"process {os.getpid()} on .* is writing to it"), lock_run_dir(config):
            pass
        with pytest.raises(InputError, match="holds another run"), lock_run_dir(other_config):
            pass
        assert (config.run_dir / "config.json").read_bytes() == settings

    # The lock is released at the end, also after a refusal.
    with pytest.raises(InputError, match="holds another run"), lock_run_dir(other_config):
        pass
    with lock_run_dir(config):
        pass


def test_lock_run_dir_writes_no_settings_into_a_directory_that_another_run_holds(tmp_path):
    """The other run has the lock, but has not written its settings yet."""
    config = tiny_config(tmp_path)
    config.run_dir.mkdir()
    other_lock = FolderLock(config.run_dir)
    other_lock.acquire()
    with pytest.raises(InputError, match="is writing to it"), lock_run_dir(config):
        pass
    assert not (config.run_dir / "config.json").exists()

    # A free lock file, such as a killed run leaves, does not make the directory another run's.
    other_lock.release()
    with lock_run_dir(config):
        assert (config.run_dir / "config.json").exists()


def test_lock_run_dir_reports_a_removed_directory_before_other_errors(tmp_path):
    """For example, a save to a removed directory raises an error of Orbax that does not name the cause."""
    config = tiny_config(tmp_path)

    def fail_with_lock(is_removed: bool) -> None:
        with lock_run_dir(config):
            if is_removed:
                shutil.rmtree(config.run_dir)
            raise ValueError("No ArrayMetadata found")

    with pytest.raises(InputError, match=f"{config.run_dir}: was removed or replaced"):
        fail_with_lock(is_removed=True)
    with pytest.raises(ValueError, match="No ArrayMetadata found"):
        fail_with_lock(is_removed=False)


@pytest.mark.slow
def test_train_refuses_a_second_process_and_ends_when_its_directory_is_removed(tmp_path, capsys):
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    long_run = ("--total-steps", 10**6)

    # A long training in a process of its own, until its first chunk has ended.
    process = start_python(["train.py", "--config", config_file, "--run-dir", run_dir, *long_run, "--save-every", 1000])
    while process.poll() is None and not (run_dir / "metrics.jsonl").exists():
        time.sleep(0.05)

    # A second training is refused, and the first one goes on.
    assert train(config_file, run_dir, *long_run) == 2
    assert f"error: {run_dir}: process {process.pid} on " in capsys.readouterr().err
    assert process.poll() is None

    # The first training ends when its directory moves, and does not create it again.
    os.rename(run_dir, tmp_path / "elsewhere")
    _, error = process.communicate(timeout=120)
    assert process.returncode == 2, error
    assert error.splitlines()[-1].startswith(f"error: {run_dir}: was removed or replaced, or its .lock was, while ")
    assert "Traceback" not in error
    assert not run_dir.exists()
