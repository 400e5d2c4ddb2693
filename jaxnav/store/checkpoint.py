"""Resumable state: one atomic Orbax commit per step, the latest two kept.

A commit holds the arrays, a digest of each and the manifest together, so that none exists without the others. A process
killed at any moment leaves the earlier commits whole; what it was writing is ignored and cleared by the next save. A
list of its files with their digests is added to a commit: damage is found before Orbax reads any of them.
"""

import contextlib
import gc
import hashlib
import logging
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
from orbax.checkpoint import v1 as ocp

from jaxnav.errors import InputError
from jaxnav.store.leaves import describe, digests
from jaxnav.store.manifest import check_manifest, differences
from jaxnav.store.signed import read_signed, sign, verified, write_signed

_KEPT = 2
#: File in a commit that lists the others.
FILES_FILE = "files.json"

State = TypeVar("State")


class Restored(NamedTuple, Generic[State]):
    """Hold a restored state.

    Attributes:
      state: as it was saved.
      step: of the checkpoint.
      damaged: what is wrong with the later checkpoints, which cannot be used.
    """

    state: State
    step: int
    damaged: tuple[str, ...]


class _DamageError(InputError):
    """Refuse a checkpoint that is not what was saved."""


def save(run_dir: Path, step: int, state: Any, manifest: Mapping[str, Any]) -> None:
    """Save the state of a run at a step.

    State and manifest are committed when it returns; all but the latest two steps are dropped.

    Args:
      run_dir: folder of the run; checkpoints go to `run_dir/checkpoints/<step>`.
      step: larger than every step saved so far.
      state: pytree whose leaves are all non-empty `jax.Array`, typed PRNG keys included.
      manifest: from `make_manifest`.

    Raises:
      InputError: the run has this step or a later one already.
      TypeError: a leaf is no array, or an empty one.
    """
    _check_leaves(state)
    metadata = sign({"manifest": dict(manifest), "leaves": describe(state), "digests": digests(state)})
    with _quiet_libraries(), _open(run_dir, cleanup_tmp_directories=True) as checkpointer:
        latest = checkpointer.latest
        if latest is not None and latest.step >= step:
            raise InputError(
                f"{run_dir}: holds step {latest.step} already, so step {step} cannot be saved; "
                "resume that run or choose another run directory"
            )
        checkpointer.save(step, state, force=True, custom_metadata=metadata)
    if jax.process_index() == 0:
        where = _folder(run_dir) / str(step)
        write_signed(where / FILES_FILE, {"files": _file_digests(where)})


def restore(run_dir: Path, abstract_state: State, expected_manifest: Mapping[str, Any]) -> Restored[State] | None:
    """Restore the latest undamaged state.

    Returns None if the run has none yet.

    Args:
      run_dir: folder of the run.
      abstract_state: `jax.eval_shape` of the state's initialisation (or a state): structure, shapes, dtypes and, where
        given, shardings; other leaves come to the default device.
      expected_manifest: from `make_manifest`, with the config that the run is to go on with.

    Raises:
      InputError: the checkpoint has another format version, config or state structure, or all are damaged.
    """
    if not _folder(run_dir).is_dir():
        return None
    damaged: list[str] = []
    with _quiet_libraries(), _open(run_dir) as checkpointer:
        for step in sorted((saved.step for saved in checkpointer.checkpoints), reverse=True):
            try:
                state = _load(checkpointer, _folder(run_dir) / str(step), step, abstract_state, expected_manifest)
            except _DamageError as error:
                damaged.append(str(error))
            else:
                return Restored(state, step, tuple(damaged))
            gc.collect()  # asyncio logs the error of a task when it is collected
    if damaged:
        raise InputError(f"{'; '.join(damaged)}: no checkpoint is left; restore one or choose another run directory")
    return None


def set_aside_after(run_dir: Path, step: int) -> None:
    """Move the checkpoints later than a step to `run_dir/damaged`."""
    for folder in list(_folder(run_dir).glob("*")):
        if folder.name.isdecimal() and int(folder.name) > step:
            target = run_dir / "damaged" / folder.name
            shutil.rmtree(target, ignore_errors=True)
            target.parent.mkdir(exist_ok=True)
            folder.rename(target)


def _load(
    checkpointer: ocp.training.Checkpointer, where: Path, step: int, abstract_state: State, expected: Mapping[str, Any]
) -> State:
    """Load the state of one step.

    Raises:
      _DamageError: a file is broken, or anything in it is not what was saved.
      InputError: another format version, config or state structure.
    """
    with _damage_named(where):
        if (where / FILES_FILE).exists():  # a process may end before it is added
            listed, found = read_signed(where / FILES_FILE, "the one before it is used")["files"], _file_digests(where)
            if different := [name for name, digest in listed.items() if found.get(name) != digest]:
                raise ValueError(f"missing or other than saved: {', '.join(different)}")
        metadata = checkpointer.metadata(step).custom_metadata
        saved = verified(where, metadata if isinstance(metadata, dict) else {}, "the one before it is used")
        if not {"manifest", "leaves"} <= saved.keys():
            raise ValueError("it holds no manifest")
    check_manifest(where, saved["manifest"], expected)
    # Orbax would cast another dtype silently, and names no leaf when a shape or the structure differs.
    if different := differences(saved["leaves"], describe(abstract_state)):
        raise InputError(
            f"{where}: its state has other arrays than this code's (saved != asked for): {'; '.join(different)}; "
            f"use the versions that wrote it ({saved['manifest']['versions']}) or choose another run directory"
        )
    with _damage_named(where):
        state = checkpointer.load(step, abstract_state=_placed(abstract_state))
        # Checkpoints of jaxnav 0.2.0 have no digests.
        if different := "digests" in saved and differences(saved["digests"], digests(state)):
            raise ValueError(f"digests differ of {', '.join(line.split(':')[0] for line in different)}")
    return state


def _file_digests(where: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a commit, by its path in it."""
    found = {}
    for path in where.rglob("*"):
        if path.is_file() and path.name != FILES_FILE:
            with path.open("rb") as file:
                found[path.relative_to(where).as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


@contextlib.contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Keep Orbax from logging pages about what is told in one line."""
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextlib.contextmanager
def _damage_named(where: Path) -> Iterator[None]:
    """Turn what reading broken files raises into one message.

    Orbax and TensorStore raise much over missing or broken files.
    """
    try:
        yield
    except (ValueError, KeyError, OSError) as error:
        reason: BaseException = error
        while reason.__cause__ is not None:  # Orbax wraps whatever goes wrong while it loads in a KeyError
            reason = reason.__cause__
        if not isinstance(reason, ValueError | KeyError | OSError):
            raise
        cause = textwrap.shorten(f"{type(reason).__name__}: {reason}", 300)
        raise _DamageError(f"{where}: is damaged ({cause})") from error


def _folder(run_dir: Path) -> Path:
    return (run_dir / "checkpoints").absolute()  # Orbax refuses relative paths


def _open(run_dir: Path, cleanup_tmp_directories: bool = False) -> ocp.training.Checkpointer:
    latest_only = ocp.training.preservation_policies.LatestN(_KEPT)
    return ocp.training.Checkpointer(
        str(_folder(run_dir)),
        preservation_policy=latest_only,  # pyright: ignore[reportArgumentType]  (Orbax's own policy, typed too narrowly)
        cleanup_tmp_directories=cleanup_tmp_directories,
    )


def _check_leaves(state: Any) -> None:
    """Refuse a state that could be saved, but not restored from an abstract one."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct) or leaf.size == 0:
            name = jax.tree_util.keystr(path)
            raise TypeError(f"state{name} is {leaf!r}; every leaf must be a non-empty jax.Array")


def _placed(abstract_state: State) -> State:
    """Place every leaf of an abstract state.

    With a sharding on every leaf the one on disk is not used.
    """
    default = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding or default), abstract_state
    )
