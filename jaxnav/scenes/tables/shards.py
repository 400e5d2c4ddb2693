"""Banks of scenes on disk, compiled once, verified when opened, and memory-mapped.

`compile_shards` compiles scenes in one or several processes, into one folder per shard, and returns `Shards`: a
sequence of banks whose arrays are read from disk on use. Shards are cached in a folder whose name is a hash of the
scenes, the task and the code.
"""

import dataclasses
import hashlib
import itertools
import multiprocessing
import os
import shutil
import signal
import threading
import uuid
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.tables.compile import Bank, bank_checksum, compile_scene, join_scenes, no_goal_error
from jaxnav.scenes.task import Task
from jaxnav.store.files import read_json_with_digest, write_json_with_digest

if TYPE_CHECKING:
    from jaxnav.scenes.worlds import Scenes


#: Fields of a `Bank` that a shard stores as JSON.
TEXT_FIELDS = ("names", "room_types", "skipped")
#: Fields of a `Bank` that a shard stores as arrays.
ARRAY_FIELDS = tuple(field for field in Bank._fields if field not in ("task", *TEXT_FIELDS))

#: The code that determines shards, below `_SOURCE`. Importers are excluded, because scene files have checksums.
_CODE = (
    *("categories.py", "context_exchange.py", "lattice.py", "layout_shift.py", "scene.py", "task.py", "worlds.py"),
    *("generate/*.py", "generate/*.yaml", "tables/*.py"),
    "files/account.py",
    "files/scene_file.py",
)
_SOURCE = Path(__file__).parents[1]
_REPAIR_HINT = "delete the folder {}, and the next command compiles it again"


@dataclasses.dataclass(frozen=True)
class Shards:
    """Sequence of banks on disk, whose arrays are memory-mapped and read-only.

    Attributes:
      folder: folder of all shards.
      task: the task for which the scenes are compiled.
      paths: folder of each shard.
      counts: number of scenes in each shard, at least 1.
      num_cells: greatest number of cells of any shard.
      num_scenes: greatest number of scenes of any shard.
      skipped: names of the scenes without a possible goal, which are in no shard.
      checksum: CRC-32 of the checksums of all shards.
    """

    folder: Path
    task: Task
    paths: tuple[Path, ...]
    counts: tuple[int, ...]
    num_cells: int
    num_scenes: int
    skipped: tuple[str, ...]
    checksum: int

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Bank]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Bank:
        """Map one shard.

        Raises:
          IndexError: no shard has this index.
          InputError: a file of the shard is missing or damaged.
        """
        # Texts are read at once, arrays are only mapped.
        path = self.paths[index]
        metadata = _read_metadata(path)
        fields: dict[str, Any] = {}
        for field_name in TEXT_FIELDS:
            fields[field_name] = tuple(metadata[field_name])
        for field_name in ARRAY_FIELDS:
            fields[field_name] = _map_array(path / f"{field_name}.npy")
        return Bank(task=self.task, **fields)


def compile_shards(
    scenes: "Scenes",
    task: Task,
    shard_scenes: int,
    cache: Path,
    report_progress: Callable[[int, int], None],
    num_workers: int | None = None,
) -> Shards:
    """Compile scenes into shards, or open the shards of an earlier call.

    Shards hold nearly equal numbers of scenes, in order. Their folder is named by a hash of the scenes, the task,
    `shard_scenes`, the NumPy version and the code that makes scenes and tables. A shard is written completely or not at
    all, so that an interrupted call can be repeated, and several processes may compile the same shards at once. With
    several workers the calling script needs its `if __name__ == "__main__"`.

    Args:
      scenes: scenes to compile; every worker receives a copy and makes the scenes that it compiles.
      task: the task for which the scenes are compiled.
      shard_scenes: greatest number of scenes per shard, at least 1.
      cache: parent of the folder, created if necessary.
      report_progress: called after each shard with the number of finished shards and the number of all shards.
      num_workers: number of processes, each of which compiles one shard at a time; None for one per core. A single
        worker runs in the calling process.

    Raises:
      InputError: no scene has a reachable goal, a scene cannot be made, or a cached shard is damaged.
    """
    # Folder of these scenes, and a subfolder for each shard.
    folder = cache / _cache_key(scenes, task, shard_scenes)
    folder.mkdir(parents=True, exist_ok=True)
    num_shards = -(-len(scenes) // shard_scenes)
    job = ShardJob(scenes, task, tuple(folder / f"{index:05d}" for index in range(num_shards)))

    # Count the finished shards for the reports.
    finished_count = itertools.count(1)

    def report_finished_shard() -> None:
        report_progress(next(finished_count), num_shards)

    # Report the cached shards, then compile the missing ones.
    missing_shards = []
    for index, path in enumerate(job.paths):
        if path.exists():
            report_finished_shard()
        else:
            missing_shards.append(index)
    compile_missing(job, missing_shards, num_workers or os.cpu_count() or 1, report_finished_shard)

    # Remove the unfinished shards of processes that were killed.
    for unfinished_folder in folder.glob(".*.tmp"):
        shutil.rmtree(unfinished_folder, ignore_errors=True)
    return _open_shards(folder, job)


@dataclasses.dataclass(frozen=True)
class ShardJob:
    """Everything that a worker needs to compile shards.

    Attributes:
      scenes: scenes of all shards.
      task: the task for which they are compiled.
      paths: folder of each shard.
    """

    scenes: "Scenes"
    task: Task
    paths: tuple[Path, ...]

    def compile(self, index: int) -> None:
        """Compile and write one shard; a shard without a reachable goal has metadata but no arrays."""
        # Scenes of this shard; shards differ by at most one scene.
        first_scene = len(self.scenes) * index // len(self.paths)
        end_scene = len(self.scenes) * (index + 1) // len(self.paths)
        scene_banks = [compile_scene(self.scenes[scene], self.task) for scene in range(first_scene, end_scene)]

        # Join the scenes with a reachable goal, if there are any.
        metadata: dict[str, Any]
        if any(bank.num_goals[0] > 0 for bank in scene_banks):
            bank = join_scenes(scene_banks, self.task)
            metadata = {field_name: getattr(bank, field_name) for field_name in TEXT_FIELDS}
            metadata |= {"cells": len(bank.ahead), "checksum": bank_checksum(bank)}
            arrays = {field_name: getattr(bank, field_name) for field_name in ARRAY_FIELDS}
        else:
            skipped = [bank.names[0] for bank in scene_banks]
            metadata = {"names": (), "room_types": (), "skipped": skipped, "cells": 0}
            arrays = {}
        _write_shard(self.paths[index], metadata, arrays)


def compile_missing(
    job: ShardJob, missing_shards: Sequence[int], num_workers: int, on_finished: Callable[[], None]
) -> None:
    """Compile shards by index, and call `on_finished` after each shard.

    Several workers are separate processes, which end with the calling process even if it is killed.
    """
    # A single worker runs in this process.
    num_workers = min(num_workers, len(missing_shards))
    if num_workers <= 1:
        for index in missing_shards:
            job.compile(index)
            on_finished()
        return

    # Workers watch one end of a pipe. The other end closes when this process leaves the block or dies.
    spawn_context = multiprocessing.get_context("spawn")  # JAX has threads, which do not survive a fork
    parent_alive, parent_end = spawn_context.Pipe(duplex=False)
    with ProcessPoolExecutor(num_workers, spawn_context, _start_worker, (job, parent_alive)) as pool, parent_end:
        shard_futures = [pool.submit(_compile_in_worker, index) for index in missing_shards]
        for shard_future in as_completed(shard_futures):
            shard_future.result()
            on_finished()


_worker_job: ShardJob  # set in worker processes


def _start_worker(job: ShardJob, parent_alive: Connection) -> None:
    """Initialise a worker process, which exits when `parent_alive` is closed."""
    global _worker_job
    _worker_job = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent handles it

    def exit_with_parent() -> None:
        try:
            parent_alive.recv_bytes()
        finally:
            os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()


def _compile_in_worker(index: int) -> None:
    _worker_job.compile(index)


def _write_shard(path: Path, metadata: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write a shard atomically; an existing shard stays."""
    # Write to a temporary folder, and rename it when all files are complete.
    unfinished_folder = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        unfinished_folder.mkdir()
        for field_name, array in arrays.items():
            # Arrays must be on the disk before the folder gets its final name.
            with (unfinished_folder / f"{field_name}.npy").open("wb") as array_file:
                np.save(array_file, array)
                array_file.flush()
                os.fsync(array_file.fileno())
        write_json_with_digest(unfinished_folder / "shard.json", metadata)
        unfinished_folder.rename(path)  # fails if the shard exists
    except OSError:
        # Another process may have finished the same shard first, and removed the unfinished folder.
        if not path.exists():
            raise
    finally:
        shutil.rmtree(unfinished_folder, ignore_errors=True)


def _open_shards(folder: Path, job: ShardJob) -> Shards:
    """Open compiled shards and verify their checksums.

    Raises:
      InputError: no scene has a reachable goal, or a shard is damaged.
    """
    # Shards without a reachable goal only contribute the names of their scenes.
    usable_metadata = {}
    skipped = []
    for path in job.paths:
        metadata = _read_metadata(path)
        skipped += metadata["skipped"]
        if metadata["names"]:
            usable_metadata[path] = metadata
    if not usable_metadata:
        raise no_goal_error(len(job.scenes), job.task)

    # The checksum of all shards covers the checksum of each.
    scene_counts = [len(metadata["names"]) for metadata in usable_metadata.values()]
    checksums = [metadata["checksum"] for metadata in usable_metadata.values()]
    shards = Shards(
        folder=folder,
        task=job.task,
        paths=tuple(usable_metadata),
        counts=tuple(scene_counts),
        num_cells=max(metadata["cells"] for metadata in usable_metadata.values()),
        num_scenes=max(scene_counts),
        skipped=tuple(skipped),
        checksum=zlib.crc32(repr(checksums).encode()),
    )

    # Compare the arrays on disk with the checksums of the written arrays.
    for bank, (path, metadata) in zip(shards, usable_metadata.items(), strict=True):
        if (len(bank.ahead), bank_checksum(bank)) != (metadata["cells"], metadata["checksum"]):
            raise InputError(f"{path}: is damaged (its checksum does not match); {_REPAIR_HINT.format(path)}")
    return shards


def _cache_key(scenes: "Scenes", task: Task, shard_scenes: int) -> str:
    """Return a hash of the scenes, the task and the code that determine the shards."""
    # Scenes and settings first, then the path and content of each file of the code.
    identity = scenes.identity, dataclasses.asdict(task), shard_scenes, np.__version__
    code_digest = hashlib.sha256(repr(identity).encode())
    code_files = set()
    for code_pattern in _CODE:
        code_files.update(_SOURCE.glob(code_pattern))
    for path in sorted(code_files):
        if path.name == "__init__.py":
            continue
        code_bytes = path.read_bytes()
        code_digest.update(f"{path.relative_to(_SOURCE).as_posix()} {len(code_bytes)} ".encode() + code_bytes)
    return code_digest.hexdigest()[:20]


def _read_metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a shard."""
    return read_json_with_digest(path / "shard.json", _REPAIR_HINT.format(path))


def _map_array(path: Path) -> np.ndarray:
    """Map an array of a shard.

    Raises:
      InputError: the file is missing or damaged.
    """
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # a damaged header can raise anything
        raise InputError(f"{path}: is missing or damaged ({error}); {_REPAIR_HINT.format(path.parent)}") from error
