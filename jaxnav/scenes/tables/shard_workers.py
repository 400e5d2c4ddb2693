"""Compilation of shards, in one process or in several."""

import dataclasses
import multiprocessing
import os
import shutil
import signal
import threading
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxnav.scenes.tables.compile import Bank, checksum, compile_scene, join
from jaxnav.scenes.task import Task
from jaxnav.store.signed import write_signed

if TYPE_CHECKING:
    from jaxnav.scenes.worlds import Scenes

#: Fields of a `Bank` that a shard keeps as JSON, and those that it keeps as arrays.
TEXTS = ("names", "room_types", "skipped")
ARRAYS = tuple(field for field in Bank._fields if field not in ("task", *TEXTS))


@dataclasses.dataclass(frozen=True)
class ShardWork:
    """Hold what a worker needs to compile shards.

    Attributes:
      scenes: of all shards.
      task: what they are compiled for.
      paths: the folder of each shard.
    """

    scenes: "Scenes"
    task: Task
    paths: tuple[Path, ...]

    def compile(self, number: int) -> None:
        """Compile and write one shard.

        A shard without a reachable goal has texts but no arrays.
        """
        first, end = (len(self.scenes) * bound // len(self.paths) for bound in (number, number + 1))
        tables = [compile_scene(self.scenes[index], self.task) for index in range(first, end)]
        texts = {"names": (), "room_types": (), "skipped": [table.name for table in tables], "cells": 0}
        arrays = {}
        if any(table.best_length.any() for table in tables):
            bank = join(tables, self.task)
            texts = {field: getattr(bank, field) for field in TEXTS}
            texts |= {"cells": len(bank.ahead), "checksum": checksum(bank)}
            arrays = {field: getattr(bank, field) for field in ARRAYS}
        _write(self.paths[number], texts, arrays)


def compile_missing(work: ShardWork, missing: Sequence[int], workers: int, done: Callable[[], None]) -> None:
    """Compile shards by their numbers, calling `done` after each.

    A single worker is this process. The processes of several workers end when this one ends, however it ends.
    """
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


_work: ShardWork  # of a worker process


def _start(work: ShardWork, watched: Connection) -> None:
    """Begin a worker process that ends when `watched` is closed."""
    global _work
    _work = work
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent handles it

    def watch() -> None:
        try:
            watched.recv_bytes()
        finally:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _compile_one(number: int) -> None:
    _work.compile(number)


def _write(path: Path, texts: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write a whole shard or nothing, unless it exists."""
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        part.mkdir()
        for field, array in arrays.items():
            with (part / f"{field}.npy").open("wb") as file:
                np.save(file, array)
                file.flush()
                os.fsync(file.fileno())
        write_signed(part / "shard.json", texts)
        part.rename(path)  # fails if the shard exists
    except OSError:
        # Another process that compiles the same shards may have finished first and removed this part.
        if not path.exists():
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
