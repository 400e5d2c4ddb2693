"""Checkpoints: exact round trips, refusals, and kills at any moment."""

import errno
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.refusals import assert_message_names

from jaxnav.errors import InputError
from jaxnav.store import checkpoint
from jaxnav.store.files import CHECKPOINT_FORMAT_VERSION, make_manifest

REPOSITORY = Path(__file__).parents[2]


class State(flax.struct.PyTreeNode):
    key: jax.Array
    env_keys: jax.Array
    params: dict
    moments: tuple
    step: jax.Array


def make_state(seed: int) -> State:
    root_key = jax.random.key(seed)
    dense_kernel = jax.random.normal(root_key, (3, 4))
    return State(
        key=root_key,
        env_keys=jax.random.split(root_key, 5),
        params={"dense": {"kernel": dense_kernel, "half": dense_kernel.astype(jnp.bfloat16)}},
        moments=(jnp.uint8(seed), None, dense_kernel > 0),
        step=jnp.int32(seed),
    )


ABSTRACT = jax.eval_shape(make_state, 0)
MANIFEST = make_manifest({"env": {"num_envs": 8, "view": (11, 11)}, "name": "run"})


def as_data(state: State) -> State:
    """Return a state with its keys as integers, which compare."""
    return state.replace(key=jax.random.key_data(state.key), env_keys=jax.random.key_data(state.env_keys))


def restore_latest(
    run_dir: Path, abstract_state: Any = ABSTRACT, manifest: Mapping[str, Any] = MANIFEST
) -> tuple[Any, int]:
    """Return the latest state and its step; fail without an undamaged checkpoint."""
    restore_result = checkpoint.restore_checkpoint(run_dir, abstract_state, manifest)
    assert restore_result is not None
    assert restore_result.damaged == ()
    return restore_result.state, restore_result.step


@pytest.mark.slow
def test_checkpoint_restores_state_types_keys_and_step(tmp_path):
    saved_state = make_state(7)
    assert not np.array_equal(saved_state.params["dense"]["kernel"], make_state(8).params["dense"]["kernel"])
    checkpoint.save_checkpoint(tmp_path, 3, saved_state, MANIFEST)
    loaded_state, restored_step = restore_latest(tmp_path)
    assert restored_step == 3
    assert jax.tree.structure(loaded_state) == jax.tree.structure(saved_state)
    chex.assert_trees_all_equal(as_data(loaded_state), as_data(saved_state), strict=True)
    # The restored key is a live key: it draws what the saved one draws.
    assert jax.random.uniform(loaded_state.key) == jax.random.uniform(saved_state.key)


def test_restore_returns_none_without_checkpoints(tmp_path):
    assert checkpoint.restore_checkpoint(tmp_path / "none", ABSTRACT, MANIFEST) is None
    (tmp_path / "checkpoints").mkdir()
    assert checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST) is None
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_checkpoints_keep_the_latest_two_steps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_dir = Path("run")  # Orbax itself refuses relative paths
    for saved_step in (1, 5, 10):
        checkpoint.save_checkpoint(run_dir, saved_step, make_state(saved_step), MANIFEST)
    assert sorted(path.name for path in (run_dir / "checkpoints").iterdir()) == ["10", "5"]
    loaded_state, restored_step = restore_latest(run_dir)
    assert (restored_step, loaded_state.step) == (10, 10)


@pytest.mark.slow
@pytest.mark.parametrize("saved_step", [4, 5])
def test_checkpoint_refuses_a_step_that_is_not_newer(tmp_path, saved_step):
    checkpoint.save_checkpoint(tmp_path, 5, make_state(5), MANIFEST)
    with pytest.raises(InputError, match="step 5"):
        checkpoint.save_checkpoint(tmp_path, saved_step, make_state(saved_step), MANIFEST)
    assert restore_latest(tmp_path)[1] == 5


def test_restore_refuses_another_config_naming_keys_and_values(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
    other_manifest = make_manifest({"env": {"num_envs": 16, "view": (11, 11), "limit": 5}, "name": "run"})
    with pytest.raises(InputError) as error:
        checkpoint.restore_checkpoint(tmp_path, ABSTRACT, other_manifest)
    assert "env.limit: (absent) != 5" in str(error.value)
    assert "env.num_envs: 8 != 16" in str(error.value)
    assert "env.view" not in str(error.value)


def test_restore_refuses_another_format_version(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST | {"format_version": 99})
    with pytest.raises(InputError, match=f"version 99.*version {CHECKPOINT_FORMAT_VERSION}"):
        checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST)


def test_restore_accepts_other_package_versions(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST | {"versions": {"jax": "0.0.1"}})
    assert restore_latest(tmp_path)[1] == 1


@pytest.mark.parametrize(
    ("change_state", "difference"),
    [
        # Orbax would cast this one.
        (lambda saved_state: saved_state.replace(step=jnp.float32(0)), ".step: 'int32[]' != 'float32[]'"),
        (
            lambda saved_state: saved_state.replace(params={"dense": jnp.ones((3, 5))}),
            ".params['dense']: (absent) != 'float32[3,5]'",
        ),
        (
            lambda saved_state: saved_state.replace(env_keys=saved_state.env_keys[:2]),
            ".env_keys: 'key<fry>[5]' != 'key<fry>[2]'",
        ),
        (
            lambda saved_state: saved_state.replace(moments=saved_state.moments[:2]),
            ".moments[2]: 'bool[3,4]' != (absent)",
        ),
    ],
)
def test_restore_refuses_another_state_structure_naming_leaves(tmp_path, change_state, difference):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
    abstract_state = jax.eval_shape(lambda: change_state(make_state(1)))
    with pytest.raises(InputError) as error:
        checkpoint.restore_checkpoint(tmp_path, abstract_state, MANIFEST)
    assert difference in str(error.value)


@pytest.mark.parametrize("invalid_leaf", [3, 0.5, np.zeros(2), jnp.zeros((0, 2))])
def test_checkpoint_refuses_leaves_it_could_not_restore(tmp_path, invalid_leaf):
    with pytest.raises(TypeError, match=r"state\.step .*non-empty jax.Array"):
        checkpoint.save_checkpoint(tmp_path, 1, make_state(1).replace(step=invalid_leaf), MANIFEST)
    assert checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST) is None


@pytest.mark.parametrize("error", [MemoryError("full"), TypeError("a bug")])
def test_restore_does_not_report_other_errors_as_damage(tmp_path, monkeypatch, error):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)

    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr("orbax.checkpoint._src.serialization.jax_array_handlers.ArrayHandler.deserialize", fail)
    with pytest.raises(BaseException) as raised:  # noqa: PT011  (Orbax chooses the type)
        checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST)
    assert not isinstance(raised.value, InputError)


def test_unfinished_commits_are_ignored_and_removed_by_the_next_save(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
    unfinished_dir = tmp_path / "checkpoints" / "2.orbax-checkpoint-tmp"
    (unfinished_dir / "state").mkdir(parents=True)
    assert restore_latest(tmp_path)[1] == 1
    checkpoint.save_checkpoint(tmp_path, 2, make_state(2), MANIFEST)
    assert not unfinished_dir.exists()
    assert restore_latest(tmp_path)[1] == 2


# Program that saves step after step, each with arrays of its own, and prints a step as soon as it is safe.
ENDLESS_SAVES = """
import sys
from pathlib import Path
import jax
from jaxnav.store import checkpoint
from jaxnav.store.files import make_manifest
for step in range(1, 10**6):
    state = {"bits": jax.random.bits(jax.random.key(step), (1024, 1024))}
    checkpoint.save_checkpoint(Path(sys.argv[1]), step, state, make_manifest({}))
    print(step, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kill_delay", [0.0, 0.01, 0.03, 0.1])
def test_kill_during_save_leaves_a_whole_checkpoint(tmp_path, kill_delay):
    command = [sys.executable, "-c", ENDLESS_SAVES, str(tmp_path)]

    # Kill the process at a chosen moment of a save.
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as process:
        # From step 3 on a save also removes an older step. Wait until its commit is being written, then a little more.
        while not list(tmp_path.glob("checkpoints/[3-9].orbax-checkpoint-tmp")):
            assert process.poll() is None
            time.sleep(0.001)
        time.sleep(kill_delay)
        process.send_signal(signal.SIGKILL)
        reported_steps = [int(line) for line in process.stdout or []]
    assert process.returncode == -signal.SIGKILL

    # The latest checkpoint is whole, and no older than the last one that was reported.
    abstract_state = {"bits": jax.ShapeDtypeStruct((1024, 1024), jnp.uint32)}
    restored_state, restored_step = restore_latest(tmp_path, abstract_state, make_manifest({}))
    assert restored_step >= reported_steps[-1] >= 2  # a commit just before the kill may be missing from the report
    chex.assert_trees_all_equal(restored_state, {"bits": jax.random.bits(jax.random.key(restored_step), (1024, 1024))})

    # The run continues with the next step.
    checkpoint.save_checkpoint(tmp_path, restored_step + 1, restored_state, make_manifest({}))
    assert restore_latest(tmp_path, abstract_state, make_manifest({}))[1] == restored_step + 1


# A full disk


@pytest.mark.slow
@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), ValueError("RESOURCE_EXHAUSTED: Failed writing")]
)
def test_full_disk_is_one_line_and_loses_nothing(tmp_path, monkeypatch, error):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)

    def fail(*_, **__):
        raise error

    with monkeypatch.context() as patches:
        patches.setattr(checkpoint.ocp.training.Checkpointer, "save", fail)
        with pytest.raises(InputError, match=r"checkpoints/2: cannot be saved \(.*; if the disk is full") as refusal:
            checkpoint.save_checkpoint(tmp_path, 2, make_state(2), MANIFEST)
    assert "\n" not in str(refusal.value)

    # The run goes on where there is room again.
    assert restore_latest(tmp_path)[1] == 1
    checkpoint.save_checkpoint(tmp_path, 2, make_state(2), MANIFEST)
    assert restore_latest(tmp_path)[1] == 2


class LateThread(threading.Thread):
    """Thread as those of Orbax, which logs an error after the save to which it belongs has failed."""

    __module__ = "orbax.checkpoint"

    def __init__(self, event: threading.Event) -> None:
        super().__init__()
        self.event = event

    def run(self) -> None:
        self.event.wait()
        logging.getLogger("absl").error("late")


def test_late_errors_of_a_failed_save_are_dropped_and_no_other_error(tmp_path, monkeypatch, caplog):
    printed_errors = []
    monkeypatch.setattr(sys, "unraisablehook", printed_errors.append)
    save_has_failed = threading.Event()
    late_thread = LateThread(save_has_failed)

    def fail(*_: Any, **__: Any) -> None:
        late_thread.start()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint.ocp.training.Checkpointer, "save", fail)
    with pytest.raises(InputError, match="No space left on device"):
        checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)

    # A thread of Orbax fails, asyncio destroys one of its tasks, and TensorStore calls the event loop of the save.
    save_has_failed.set()
    late_thread.join()
    logging.getLogger("asyncio").error("Task was destroyed but it is pending!\ntask: .../orbax/checkpoint/futures.py:1")
    closed_loop = types.SimpleNamespace(exc_value=RuntimeError("Event loop is closed"), object=None)
    sys.unraisablehook(closed_loop)  # pyright: ignore[reportArgumentType]
    assert caplog.messages == []
    assert printed_errors == []

    # Errors elsewhere in the program are printed.
    for logger_name in ("absl", "asyncio"):
        logging.getLogger(logger_name).error(f"own {logger_name}")
    own_error = types.SimpleNamespace(exc_value=RuntimeError("Event loop is closed"), object=print)
    sys.unraisablehook(own_error)  # pyright: ignore[reportArgumentType]
    assert caplog.messages == ["own absl", "own asyncio"]
    assert printed_errors == [own_error]


@pytest.mark.parametrize(("num_inodes", "num_free", "is_refused"), [(50, 39, True), (50, 40, False), (0, 0, False)])
def test_save_needs_inodes(tmp_path, monkeypatch, num_inodes, num_free, is_refused):
    disk = types.SimpleNamespace(f_files=num_inodes, f_favail=num_free)
    monkeypatch.setattr(os, "statvfs", lambda _: disk)
    if is_refused:
        with pytest.raises(InputError, match=r"cannot be saved \(the disk has 39 free inodes.*; remove files"):
            checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
        assert list(tmp_path.iterdir()) == []
    else:
        checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)


def fill_disk(folder: Path) -> list[Path]:
    """Save a run after another until the disk is full, and return the directories of those that were saved."""
    saved_runs = []
    for index in range(20):
        try:
            checkpoint.save_checkpoint(folder / f"run{index}", 1, make_state(1), MANIFEST)
        except InputError as error:
            assert_message_names(error, "cannot be saved", "run the same command again")
            break
        saved_runs.append(folder / f"run{index}")
    return saved_runs


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="only root mounts a file system")
@pytest.mark.parametrize("limit", ["size=40k", "size=80k", "size=160k", "nr_inodes=5", "nr_inodes=12", "nr_inodes=60"])
def test_small_file_system_is_one_line_and_loses_nothing(tmp_path, limit):
    if subprocess.run(["mount", "-t", "tmpfs", "-o", limit, "tmpfs", tmp_path], check=False).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        saved_runs = fill_disk(tmp_path)
        assert len(saved_runs) < 20

        # Every run that was saved is restored, and the next one is saved where there is room again.
        subprocess.run(["mount", "-o", "remount,size=90m,nr_inodes=9000", tmp_path], check=True)
        for run_dir in saved_runs:
            assert restore_latest(run_dir)[1] == 1
        checkpoint.save_checkpoint(tmp_path / "next", 1, make_state(1), MANIFEST)
        assert restore_latest(tmp_path / "next")[1] == 1
    finally:
        subprocess.run(["umount", tmp_path], check=True)
