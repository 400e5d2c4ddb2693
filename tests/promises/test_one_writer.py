"""One process at a time writes to a run directory.

Seen to fail: without `fcntl.flock` in `FolderLock.acquire` a second training is not refused; with a lock that counts as
held wherever its file exists, one that was killed blocks the next; without `FolderLock.check` a run whose directory was
removed ends as if all were well.
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
from support.processes import REPOSITORY, run
from support.tiny_run import tiny_config, write_config

from jaxnav.errors import InputError
from jaxnav.runs.run import lock_run_dir
from jaxnav.store.files import LOCK_FILE, FolderLock

HOLDING = """
import sys
from pathlib import Path
from jaxnav.runs.run import lock_run_dir
from jaxnav.store.files import FolderLock
FolderLock(Path(sys.argv[1])).acquire()
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """A process that holds the folder."""
    pipe = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", HOLDING, str(tmp_path)], cwd=REPOSITORY, **pipe) as process:
        assert process.stdout
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_folder_lock_names_the_process_that_holds_it(tmp_path, holder):
    with pytest.raises(InputError) as error:
        FolderLock(tmp_path).acquire()
    named = re.escape(f"process {holder.pid} on {socket.gethostname()}")
    assert re.fullmatch(f"{tmp_path}: {named} is writing to it; wait until it ends, .*", str(error.value))


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_folder_lock_of_a_dead_process_is_free(tmp_path, holder, end):
    holder.send_signal(end)
    holder.wait()
    assert str(holder.pid) in (tmp_path / LOCK_FILE).read_text()
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
    lock.check()  # of a process that holds nothing, such as the second of a run
    lock.acquire()
    lock.check()
    shutil.rmtree(folder)
    with pytest.raises(
        InputError, match=f"{folder}: was removed or replaced, or its .lock was, while this run wrote to it"
    ):
        lock.check()
    folder.mkdir()
    FolderLock(folder).acquire()
    with pytest.raises(InputError, match="was removed or replaced"):
        lock.check()


def test_lock_run_dir_refuses_a_second_run_until_released(tmp_path):
    config = tiny_config(tmp_path)
    with lock_run_dir(config):
        before = (config.run_dir / "config.json").read_bytes()
        with pytest.raises(InputError, match=f"process {os.getpid()} on .* is writing to it"), lock_run_dir(config):
            pass
        with pytest.raises(InputError, match="holds another run"), lock_run_dir(dataclasses.replace(config, seed=5)):
            pass
        assert (config.run_dir / "config.json").read_bytes() == before
    with pytest.raises(InputError, match="holds another run"), lock_run_dir(dataclasses.replace(config, seed=5)):
        pass
    with lock_run_dir(config):  # let go of, also after a refusal
        pass


def test_lock_run_dir_writes_no_settings_into_a_directory_that_another_run_holds(tmp_path):
    """The other run has the lock, and has not written its settings yet."""
    config = tiny_config(tmp_path)
    config.run_dir.mkdir()
    other_lock = FolderLock(config.run_dir)
    other_lock.acquire()
    with pytest.raises(InputError, match="is writing to it"), lock_run_dir(config):
        pass
    assert not (config.run_dir / "config.json").exists()

    # The lock file that a killed run left is no other content.
    other_lock.release()
    with lock_run_dir(config):
        assert (config.run_dir / "config.json").exists()


def test_lock_run_dir_reports_a_removed_directory_before_other_errors(tmp_path):
    """A save, for one, of which Orbax tells much else."""
    config = tiny_config(tmp_path)

    def failing(is_gone: bool) -> None:
        with lock_run_dir(config):
            if is_gone:
                shutil.rmtree(config.run_dir)
            raise ValueError("No ArrayMetadata found")

    with pytest.raises(InputError, match=f"{config.run_dir}: was removed or replaced"):
        failing(is_gone=True)
    with pytest.raises(ValueError, match="No ArrayMetadata found"):
        failing(is_gone=False)


@pytest.mark.slow
def test_train_refuses_a_second_process_and_ends_when_its_directory_is_removed(tmp_path, capsys):
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    long = ("--total-steps", 10**6)
    process = run(["train.py", "--config", config_file, "--run-dir", run_dir, *long, "--save-every", 1000])
    while process.poll() is None and not (run_dir / "metrics.jsonl").exists():
        time.sleep(0.05)
    assert train(config_file, run_dir, *long) == 2
    assert f"error: {run_dir}: process {process.pid} on " in capsys.readouterr().err
    assert process.poll() is None
    os.rename(run_dir, tmp_path / "elsewhere")
    _, error = process.communicate(timeout=120)
    assert process.returncode == 2, error
    assert error.splitlines()[-1].startswith(f"error: {run_dir}: was removed or replaced, or its .lock was, while ")
    assert "Traceback" not in error
    assert not run_dir.exists()
