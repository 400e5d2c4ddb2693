"""Resumable state: one atomic Orbax commit per step, the latest two kept.

A commit holds the arrays and the manifest together, so that neither exists without the other. A process killed at any
moment leaves the earlier commits whole; what it was writing is ignored and cleared by the next save.
"""

import contextlib
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
from orbax.checkpoint import v1 as ocp

from jaxnav.errors import InputError
from jaxnav.store.manifest import check_manifest, differences

_KEPT = 2

State = TypeVar("State")


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
    metadata = {"manifest": dict(manifest), "leaves": _describe(state)}
    with _open(run_dir, cleanup_tmp_directories=True) as checkpointer:
        latest = checkpointer.latest
        if latest is not None and latest.step >= step:
            raise InputError(
                f"{run_dir}: holds step {latest.step} already, so step {step} cannot be saved; "
                "resume that run or choose another run directory"
            )
        checkpointer.save(step, state, force=True, custom_metadata=metadata)


def restore(run_dir: Path, abstract_state: State, expected_manifest: Mapping[str, Any]) -> tuple[State, int] | None:
    """Restore the latest committed state and its step.

    Returns None if the run has none yet.

    Args:
      run_dir: folder of the run.
      abstract_state: `jax.eval_shape` of the state's initialisation (or a state): structure, shapes, dtypes and, where
        given, shardings; other leaves come to the default device.
      expected_manifest: from `make_manifest`, with the config that the run is to go on with.

    Raises:
      InputError: the checkpoint has another format version, config or state structure, or is damaged.
    """
    if not _folder(run_dir).is_dir():
        return None
    with _open(run_dir) as checkpointer:
        latest = checkpointer.latest
        if latest is None:
            return None
        where = _folder(run_dir) / str(latest.step)
        with _damage_named(where):
            saved = checkpointer.metadata(latest).custom_metadata
        saved = saved if isinstance(saved, dict) else {}
        check_manifest(where, saved.get("manifest"), expected_manifest)
        # Orbax would cast another dtype silently, and names no leaf when a shape or the structure differs.
        if different := differences(saved["leaves"], _describe(abstract_state)):
            raise InputError(
                f"{where}: its state has other arrays than this code's (saved != asked for): {'; '.join(different)}; "
                f"use the versions that wrote it ({saved['manifest']['versions']}) or choose another run directory"
            )
        with _damage_named(where):
            return checkpointer.load(latest, abstract_state=_placed(abstract_state)), latest.step


@contextlib.contextmanager
def _damage_named(where: Path) -> Iterator[None]:
    """Turn what reading broken files raises into one message.

    Orbax and TensorStore raise much over missing or broken files; the message names the mend.
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
        raise InputError(f"{where}: is damaged ({cause}); remove it to go on from the step before") from error


def _folder(run_dir: Path) -> Path:
    return (run_dir / "checkpoints").absolute()  # Orbax refuses relative paths


def _open(run_dir: Path, cleanup_tmp_directories: bool = False) -> ocp.training.Checkpointer:
    latest_only = ocp.training.preservation_policies.LatestN(_KEPT)
    return ocp.training.Checkpointer(
        str(_folder(run_dir)),
        preservation_policy=latest_only,  # pyright: ignore[reportArgumentType]  (Orbax's own policy, typed too narrowly)
        cleanup_tmp_directories=cleanup_tmp_directories,
    )


def _describe(state: Any) -> dict[str, str]:
    """Describe every leaf: `.params['kernel']: float32[3,4]`."""
    leaves = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        name = jax.tree_util.keystr(path)
        # A Python number would be saved, but could not be restored from an abstract state.
        if not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct) or leaf.size == 0:
            raise TypeError(f"state{name} is {leaf!r}; every leaf must be a non-empty jax.Array")
        leaves[name] = f"{leaf.dtype}[{','.join(map(str, leaf.shape))}]"
    return leaves


def _placed(abstract_state: State) -> State:
    """Place every leaf of an abstract state.

    With a sharding on every leaf the one on disk is not used.
    """
    default = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding or default), abstract_state
    )
