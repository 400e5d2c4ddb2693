"""Checkpoints: the resumable state of a run, with one atomic Orbax commit per step; the latest two steps are kept.

`save_checkpoint` commits the arrays, a digest of each array and the manifest together, so that a checkpoint always
holds all three. A process killed at any moment leaves the earlier commits intact; the next save clears an unfinished
commit. `restore_checkpoint` returns the latest undamaged state. A list of the files of a commit, with their digests, is
added after the commit, so that damage is reported before Orbax reads any of these files.
"""

import contextlib
import gc
import hashlib
import logging
import os
import re
import shutil
import sys
import tempfile
import textwrap
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from orbax.checkpoint import v1 as ocp

from jaxnav.errors import InputError
from jaxnav.store.files import (
    add_digest,
    check_manifest,
    list_differences,
    read_json_with_digest,
    verify_digest,
    write_json_with_digest,
)

#: File in a commit that lists its other files with their digests.
FILE_LIST = "files.json"

_NUM_KEPT_CHECKPOINTS = 2
#: Upper bound of the files and folders of a checkpoint, while it is written.
_NUM_INODES = 40
_REMEDY = "the one before it is used"
#: Paths without any character that Orbax or TensorStore could take for more than a part of a name.
_PLAIN_PATH = re.compile(r"[\w/. ~+,=@-]+")

State = TypeVar("State")


class RestoredState(NamedTuple, Generic[State]):
    """State from a checkpoint.

    Attributes:
      state: the saved state.
      step: step of the checkpoint.
      damaged: messages about later checkpoints that cannot be used.
    """

    state: State
    step: int
    damaged: tuple[str, ...]


class _DamageError(InputError):
    """Error about a checkpoint whose content differs from the saved content."""


def save_checkpoint(run_dir: Path, step: int, state: Any, manifest: Mapping[str, Any]) -> None:
    """Save the state of a run at a step.

    State and manifest are committed when the function returns. Only the latest two steps are kept.

    Args:
      run_dir: folder of the run; checkpoints go to `run_dir/checkpoints/<step>`.
      step: larger than every step saved so far.
      state: pytree whose leaves are all non-empty `jax.Array`, typed PRNG keys included.
      manifest: manifest of the run, see `make_manifest`.

    Raises:
      InputError: the run already has this step or a later step, the disk is full, or the first checkpoint of the run
        cannot be read again.
      TypeError: a leaf is no array, or an empty array.
    """
    # Orbax commits the metadata together with the arrays.
    _check_leaves(state)
    metadata = add_digest(
        {"manifest": dict(manifest), "leaves": describe_arrays(state), "digests": array_digests(state)}
    )

    _check_free_inodes(run_dir)

    # Steps only increase: a smaller step belongs to another run in this folder.
    folder = _checkpoints_folder(run_dir) / str(step)
    with _report_unsaved(folder):
        with _silence_libraries(), _open_checkpointer(run_dir, cleanup_tmp_directories=True) as checkpointer:
            latest_checkpoint = checkpointer.latest
            if latest_checkpoint is not None and latest_checkpoint.step >= step:
                raise InputError(
                    f"{run_dir}: holds step {latest_checkpoint.step} already, so step {step} cannot be saved; "
                    "resume that run or choose another run directory"
                )
            checkpointer.save(step, state, force=True, custom_metadata=metadata)

            # Read the first checkpoint of a run back, so that a fault of the storage ends the run before it has trained
            # for long.
            if latest_checkpoint is None:
                _load_step(checkpointer, folder, step, state, metadata["manifest"])

        # One process lists the files, after the commit.
        if jax.process_index() == 0:
            write_json_with_digest(folder / FILE_LIST, {"files": _file_digests(folder)})


def restore_checkpoint(
    run_dir: Path, abstract_state: State, expected_manifest: Mapping[str, Any]
) -> RestoredState[State] | None:
    """Restore the latest undamaged state, or return None if the run has no checkpoint yet.

    Args:
      run_dir: folder of the run.
      abstract_state: `jax.eval_shape` of the state's initialisation (or a state): structure, shapes, dtypes and, where
        given, shardings; leaves without a sharding are placed on the default device.
      expected_manifest: manifest of the run that resumes, see `make_manifest`.

    Raises:
      InputError: the checkpoint has another format version, config or state structure, or all are damaged.
    """
    # A run without the folder has not saved yet.
    folder = _checkpoints_folder(run_dir)
    if not folder.is_dir():
        return None

    # Try the checkpoints from the latest to the earliest, until one is undamaged.
    damage_messages: list[str] = []
    with _silence_libraries(), _open_checkpointer(run_dir) as checkpointer:
        for step in sorted((saved.step for saved in checkpointer.checkpoints), reverse=True):
            try:
                with _silence_libraries():
                    state = _load_step(checkpointer, folder / str(step), step, abstract_state, expected_manifest)
            except _DamageError as error:
                damage_messages.append(str(error))
            else:
                return RestoredState(state, step, tuple(damage_messages))
            gc.collect()  # asyncio logs the error of a task when it is collected

    # A run without any checkpoint starts from the beginning; a run with only damaged checkpoints must not.
    if damage_messages:
        raise InputError(
            f"{'; '.join(damage_messages)}: no checkpoint is left; restore one or choose another run directory"
        )
    return None


def has_checkpoints(run_dir: Path) -> bool:
    """True where checkpoints were stored, intact or damaged."""
    return _checkpoints_folder(run_dir).is_dir()


def set_aside_checkpoints_after(run_dir: Path, step: int) -> None:
    """Move the checkpoints later than a step to `run_dir/damaged`."""
    for folder in list(_checkpoints_folder(run_dir).glob("*")):
        # Other entries are unfinished commits of Orbax.
        if folder.name.isdecimal() and int(folder.name) > step:
            target_folder = run_dir / "damaged" / folder.name
            shutil.rmtree(target_folder, ignore_errors=True)
            target_folder.parent.mkdir(exist_ok=True)
            folder.rename(target_folder)


def _load_step(
    checkpointer: ocp.training.Checkpointer,
    folder: Path,
    step: int,
    abstract_state: State,
    expected_manifest: Mapping[str, Any],
) -> State:
    """Load and verify the state of one step.

    Raises:
      _DamageError: a file is broken, or its content differs from the saved content.
      InputError: another format version, config or state structure.
    """
    # Verify the files and the metadata before Orbax reads the arrays.
    with _report_damage(folder):
        _check_files(folder)
        metadata = checkpointer.metadata(step).custom_metadata
        if not isinstance(metadata, dict):
            raise ValueError("it holds no manifest")
        saved = verify_digest(folder, metadata, _REMEDY)

    # Compare shapes and dtypes here: Orbax would cast another dtype silently, and its errors name no leaf.
    check_manifest(folder, saved["manifest"], expected_manifest)
    mismatches = list_differences(saved["leaves"], describe_arrays(abstract_state))
    if mismatches:
        raise InputError(
            f"{folder}: its arrays differ from those of this code (saved != expected): {'; '.join(mismatches)}; "
            f"use the versions that wrote it ({saved['manifest']['versions']}) or choose another run directory"
        )

    # Compare the loaded arrays, too, in case Orbax reads intact files wrongly.
    with _report_damage(folder):
        state = checkpointer.load(step, abstract_state=_add_shardings(abstract_state))
        mismatches = list_differences(saved["digests"], array_digests(state))
        if mismatches:
            leaf_paths = [mismatch.split(":")[0] for mismatch in mismatches]
            raise ValueError(f"wrong digests of {', '.join(leaf_paths)}")
    return state


def _check_files(folder: Path) -> None:
    """Compare the files of a commit with its file list.

    Raises:
      InputError: the file list is damaged.
      ValueError: a file is missing or has another digest.
    """
    # The process may have ended before the list was written.
    if not (folder / FILE_LIST).exists():
        return

    # Files that the list does not name are harmless.
    saved_digests = read_json_with_digest(folder / FILE_LIST, _REMEDY)["files"]
    file_digests = _file_digests(folder)
    damaged_files = [file_name for file_name, digest in saved_digests.items() if file_digests.get(file_name) != digest]
    if damaged_files:
        raise ValueError(f"missing or changed since saving: {', '.join(damaged_files)}")


def _file_digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a commit, by its relative path."""
    # The list cannot hold its own digest.
    file_digests = {}
    for path in folder.rglob("*"):
        if path.is_file() and path.name != FILE_LIST:
            with path.open("rb") as file:
                file_digests[path.relative_to(folder).as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return file_digests


# The arrays of a state


def describe_arrays(tree: Any) -> dict[str, str]:
    """Return dtype and shape of every leaf of a tree by its path, `['kernel']: float32[3,4]`."""
    descriptions = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        shape_text = ",".join(map(str, leaf.shape))
        descriptions[jax.tree_util.keystr(path)] = f"{leaf.dtype}[{shape_text}]"
    return descriptions


def array_digests(state: Any) -> dict[str, str]:
    """Return the first 16 hexadecimal digits of the SHA-256 of every leaf, by its path.

    The digests do not depend on the number of devices. All processes that hold parts of a leaf have to call.
    """
    digests = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        digests[jax.tree_util.keystr(path)] = hashlib.sha256(_array_bytes(leaf)).hexdigest()[:16]
    return digests


def _array_bytes(leaf: jax.Array) -> bytes:
    """Return the bytes of a leaf, gathered from all processes where they hold different parts."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    array_data = jax.random.key_data(leaf) if is_key else leaf
    if not array_data.is_fully_replicated and not array_data.is_fully_addressable:
        array_data = multihost_utils.process_allgather(array_data, tiled=True)
    return np.asarray(array_data).tobytes()


def _check_leaves(state: Any) -> None:
    """Refuse a state that could be saved, but not restored from an abstract state."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct) or leaf.size == 0:
            leaf_path = jax.tree_util.keystr(path)
            raise TypeError(f"state{leaf_path} is {leaf!r}; every leaf must be a non-empty jax.Array")


def _add_shardings(abstract_state: State) -> State:
    """Add a sharding to every leaf of an abstract state, so that Orbax ignores the shardings on disk."""
    default_sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])

    def add_sharding(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding or default_sharding)

    return jax.tree.map(add_sharding, abstract_state)


# Orbax


def _checkpoints_folder(run_dir: Path) -> Path:
    return (run_dir / "checkpoints").absolute()  # Orbax refuses relative paths


@contextlib.contextmanager
def _open_checkpointer(run_dir: Path, cleanup_tmp_directories: bool = False) -> Iterator[ocp.training.Checkpointer]:
    keep_latest = ocp.training.preservation_policies.LatestN(_NUM_KEPT_CHECKPOINTS)
    with (
        _plain_path(_checkpoints_folder(run_dir)) as folder,
        ocp.training.Checkpointer(
            str(folder),
            preservation_policy=keep_latest,  # pyright: ignore[reportArgumentType]  (Orbax's own policy, typed too narrowly)
            cleanup_tmp_directories=cleanup_tmp_directories,
        ) as checkpointer,
    ):
        yield checkpointer


@contextlib.contextmanager
def _plain_path(folder: Path) -> Iterator[Path]:
    """Yield a path to a folder that Orbax and TensorStore read literally.

    They read brackets and stars as patterns, backslashes as separators, `gs:` as a bucket, and text as UTF-8, in any
    part of a path. Such a folder is reached through a symbolic link with a plain name.
    """
    if _PLAIN_PATH.fullmatch(str(folder)):
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="jaxnav-") as link_folder:
        if not _PLAIN_PATH.fullmatch(link_folder):
            raise InputError(f"TMPDIR: is {link_folder}; give a folder whose path has only letters, digits and / . _ -")
        folder.parent.mkdir(parents=True, exist_ok=True)
        link = Path(link_folder) / "run"
        link.symlink_to(folder.parent, target_is_directory=True)
        yield link / folder.name


def _check_free_inodes(run_dir: Path) -> None:
    """Refuse a disk with too few inodes, on which threads of Orbax wait for minutes for folders that do not exist."""
    if not hasattr(os, "statvfs"):  # not a POSIX system
        return
    existing_folder = next(folder for folder in (run_dir, *run_dir.absolute().parents) if folder.exists())
    disk = os.statvfs(existing_folder)
    # Some file systems have no limit, and count no inodes.
    if disk.f_files and disk.f_favail < _NUM_INODES:
        raise InputError(
            f"{run_dir}: cannot be saved (the disk has {disk.f_favail} free inodes, a checkpoint needs {_NUM_INODES}); "
            "remove files, then run the same command again"
        )


# Errors of Orbax and TensorStore

#: Threads of Orbax that were running when a save or load failed.
_failed_threads: weakref.WeakSet[threading.Thread] = weakref.WeakSet()


@contextlib.contextmanager
def _silence_libraries() -> Iterator[None]:
    """Keep Orbax and TensorStore from printing pages about errors that are reported in one line.

    Orbax stops at the first error, while its threads and those of TensorStore go on with other arrays. These threads
    may fail later, even while the process ends. Such late errors are dropped, too; the errors of other threads are not.
    """
    loggers = [logging.getLogger(logger_name) for logger_name in ("absl", "asyncio")]
    saved_levels = [logger.level for logger in loggers]
    saved_hook = sys.unraisablehook
    earlier_threads = set(threading.enumerate())

    # A level above the highest silences a logger.
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    if not isinstance(saved_hook, _TensorStoreHook):
        sys.unraisablehook = _TensorStoreHook(saved_hook)

    # Where nothing fails, nothing is left behind.
    try:
        yield
        sys.unraisablehook = saved_hook
    except BaseException:
        for thread in set(threading.enumerate()) - earlier_threads:
            if type(thread).__module__.startswith("orbax."):
                _failed_threads.add(thread)
        for logger in loggers:
            logger.addFilter(_is_no_late_error)  # adds it once
        # Orbax drops the coroutines of arrays that it did not reach. Python's warning does not say whose they are, so
        # the warnings about coroutines of others are silenced, too.
        warnings.filterwarnings("ignore", r"coroutine .* was never awaited", RuntimeWarning)
        raise
    finally:
        for logger, saved_level in zip(loggers, saved_levels, strict=True):
            logger.setLevel(saved_level)


def _is_no_late_error(record: logging.LogRecord) -> bool:
    """False for what threads of Orbax log after a failure, and for what asyncio logs about their tasks."""
    is_task_of_orbax = record.name == "asyncio" and "/orbax/" in record.getMessage()
    return threading.current_thread() not in _failed_threads and not is_task_of_orbax


class _TensorStoreHook:
    """Replacement of `sys.unraisablehook`, which drops errors of TensorStore at event loops that Orbax has closed."""

    def __init__(self, earlier_hook: Callable[[Any], object]) -> None:
        """Keep the hook that prints all other errors."""
        self._earlier_hook = earlier_hook

    def __call__(self, unraisable: Any) -> None:
        """Print an error that nobody can catch, unless TensorStore has called a closed event loop."""
        # TensorStore names no object, as Python does.
        is_closed_loop = isinstance(unraisable.exc_value, RuntimeError) and "Event loop" in str(unraisable.exc_value)
        if not (is_closed_loop and unraisable.object is None):
            self._earlier_hook(unraisable)


@contextlib.contextmanager
def _report_unsaved(folder: Path) -> Iterator[None]:
    """Turn the errors of Orbax and TensorStore while they save, which are of many kinds, into an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        advice = "if the disk is full, free space and inodes; then run the same command again"
        raise InputError(f"{folder}: cannot be saved ({_summarize_root(error)}); {advice}") from error
    finally:
        gc.collect()  # asyncio logs the error of a task when it is collected


@contextlib.contextmanager
def _report_damage(folder: Path) -> Iterator[None]:
    """Turn the errors of Orbax and TensorStore about missing or broken files into a `_DamageError`."""
    try:
        yield
    except (ValueError, KeyError, OSError) as error:
        # Orbax wraps every error of loading in a KeyError, so the root error decides if a file is damaged.
        if not isinstance(_root_error(error), ValueError | KeyError | OSError):
            raise
        raise _DamageError(f"{folder}: is damaged ({_summarize_root(error)})") from error


def _root_error(error: BaseException) -> BaseException:
    """Return the first error of a chain of causes."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _summarize_root(error: BaseException) -> str:
    """Describe the first error of a chain of causes in one line."""
    root_error = _root_error(error)
    return textwrap.shorten(f"{type(root_error).__name__}: {root_error}", 300)
