"""Banks of scenes on disk: shards that are compiled in parallel, kept, and memory-mapped."""

import dataclasses
import hashlib
import itertools
import json
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
from jaxnav.scenes.tables.compile import Bank, checksum, compile_scene, join
from jaxnav.scenes.task import Task

if TYPE_CHECKING:
    from jaxnav.scenes.worlds import Scenes

_TEXTS = ("names", "room_types", "skipped")
_ARRAYS = tuple(field for field in Bank._fields if field not in ("task", *_TEXTS))
_SOURCE = Path(__file__).parent


@dataclasses.dataclass(frozen=True)
class Shards:
    """A sequence of banks on disk; an element's arrays are memory-mapped, read-only, and read where they are used.

    Attributes:
      folder: where they are.
      task: what they were compiled for.
      paths: folder of each shard.
      counts: number of scenes in each shard, at least 1.
      num_cells: the most cells of any shard.
      num_scenes: the most scenes of any shard.
      skipped: names of scenes without any possible goal, which are in no shard.
      checksum: CRC-32 of all that the shards hold.
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
        """One shard.

        Raises:
          IndexError: there is no such shard.
          InputError: a file of it is missing or damaged.
        """
        path = self.paths[index]
        texts = _read_texts(path)
        arrays = {field: _intact(path / f"{field}.npy", _map) for field in _ARRAYS}
        return Bank(task=self.task, **{field: tuple(texts[field]) for field in _TEXTS}, **arrays)


def compile_shards(
    scenes: "Scenes",
    task: Task,
    shard_scenes: int,
    cache: Path,
    report: Callable[[int, int], None],
    workers: int | None = None,
) -> Shards:
    """Compile scenes into shards of nearly equal numbers of scenes, in order, or find them compiled.

    The folder of the shards is named after all that they follow from: scenes, task, `shard_scenes`, NumPy and this
    package's code. A shard is there whole or not at all: after a kill the next call compiles those that are missing,
    and several processes may compile the same shards at once. With several workers the calling script needs its
    `if __name__ == "__main__"`.

    Args:
      scenes: sent to every worker once; each scene is made where it is compiled.
      task: what they are compiled for.
      shard_scenes: scenes of a shard at most, at least 1.
      cache: where the folder is, or will be made.
      report: called with the number of shards that are there, and of all, after each.
      workers: processes that compile one shard at a time each, None for one per core; a single one is the caller's own.

    Raises:
      InputError: no scene has a reachable goal, a scene cannot be made, or a shard in the cache is damaged.
    """
    if shard_scenes < 1:
        raise InputError(f"shard_scenes is {shard_scenes}; give a number of at least 1")
    folder = cache / _key(scenes, task, shard_scenes)
    folder.mkdir(parents=True, exist_ok=True)
    total = -(-len(scenes) // shard_scenes)
    work = _Work(scenes, task, tuple(folder / f"{number:05d}" for number in range(total)))
    missing = [number for number in range(total) if not work.paths[number].exists()]
    present = itertools.count(1)
    for _ in range(total - len(missing)):
        report(next(present), total)
    _compile(work, missing, workers or os.cpu_count() or 1, lambda: report(next(present), total))
    for part in folder.glob(".*.tmp"):  # what kills left
        shutil.rmtree(part, ignore_errors=True)

    texts = [_read_texts(path) for path in work.paths]
    usable = [(path, text) for path, text in zip(work.paths, texts, strict=True) if text["names"]]
    if not usable:
        raise InputError(
            f"none of the {len(scenes)} scenes has a reachable goal: give scenes with objects of the categories "
            f"{', '.join(task.goals or task.categories)} near standable cells"
        )
    counts = tuple(len(text["names"]) for _, text in usable)
    return Shards(
        folder=folder,
        task=task,
        paths=tuple(path for path, _ in usable),
        counts=counts,
        num_cells=max(text["cells"] for _, text in usable),
        num_scenes=max(counts),
        skipped=tuple(name for text in texts for name in text["skipped"]),
        checksum=zlib.crc32(repr([text["checksum"] for _, text in usable]).encode()),
    )


@dataclasses.dataclass(frozen=True)
class _Work:
    """What a worker needs to know.

    Attributes:
      scenes: of all shards.
      task: what they are compiled for.
      paths: the folder that each shard will be.
    """

    scenes: "Scenes"
    task: Task
    paths: tuple[Path, ...]

    def compile(self, number: int) -> None:
        """Compile and write one shard; of one without a reachable goal only the texts."""
        first, end = (len(self.scenes) * bound // len(self.paths) for bound in (number, number + 1))
        tables = [compile_scene(self.scenes[index], self.task) for index in range(first, end)]
        texts = {"names": (), "room_types": (), "skipped": [table.name for table in tables], "cells": 0}
        arrays = {}
        if any(table.best_length.any() for table in tables):
            bank = join(tables, self.task)
            texts = {field: getattr(bank, field) for field in _TEXTS}
            texts |= {"cells": len(bank.ahead), "checksum": checksum(bank)}
            arrays = {field: getattr(bank, field) for field in _ARRAYS}
        _write(self.paths[number], texts, arrays)


def _write(path: Path, texts: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write a shard, whole or not at all, unless it is there."""
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        part.mkdir()
        for field, array in arrays.items():
            np.save(part / f"{field}.npy", array)
        (part / "shard.json").write_text(json.dumps(texts, indent=1))
        part.rename(path)  # fails if it is there
    except OSError:
        # Another process that compiles the same shards may have finished first, and swept up.
        if not path.exists():
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _compile(work: _Work, missing: Sequence[int], workers: int, done: Callable[[], None]) -> None:
    """Compile the missing shards, calling `done` after each."""
    workers = min(workers, len(missing))
    if workers <= 1:
        for number in missing:
            work.compile(number)
            done()
        return
    context = multiprocessing.get_context("spawn")  # JAX has threads, which do not survive a fork
    watched, held = context.Pipe(duplex=False)
    # However this process leaves the block or dies, `held` is closed, which ends the workers.
    with ProcessPoolExecutor(workers, context, _start, (work, watched)) as pool, held:
        for future in as_completed([pool.submit(_compile_one, number) for number in missing]):
            future.result()
            done()


_work: _Work  # of a worker process


def _start(work: _Work, watched: Connection) -> None:
    """Begin a worker process, which ends when the other end of `watched` is closed."""
    global _work
    _work = work
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent sees to it

    def watch() -> None:
        try:
            watched.recv_bytes()
        finally:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _compile_one(number: int) -> None:
    _work.compile(number)


def _key(scenes: "Scenes", task: Task, shard_scenes: int) -> str:
    """A name that differs wherever the shards may differ."""
    key = hashlib.sha256(repr((scenes.identity, task, shard_scenes, np.__version__)).encode())
    for path in sorted(path for path in _SOURCE.rglob("*") if path.suffix in (".py", ".yaml")):
        code = path.read_bytes()
        key.update(f"{path.relative_to(_SOURCE).as_posix()} {len(code)} ".encode() + code)
    return key.hexdigest()[:20]


def _read_texts(path: Path) -> dict[str, Any]:
    return _intact(path / "shard.json", lambda file: json.loads(file.read_bytes()))


def _map(path: Path) -> np.ndarray:
    return np.lib.format.open_memmap(path, mode="r")


def _intact(path: Path, read: Callable[[Path], Any]) -> Any:
    """What `read` reads from a file of a shard."""
    try:
        return read(path)
    except Exception as error:  # a damaged header can bring about any
        raise InputError(
            f"{path}: is missing or damaged ({error}); delete the folder {path.parent}, then it is compiled again"
        ) from error
