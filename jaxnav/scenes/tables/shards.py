"""Banks of scenes on disk, compiled once and memory-mapped."""

import dataclasses
import hashlib
import itertools
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.tables.compile import Bank, checksum, no_goal
from jaxnav.scenes.tables.shard_workers import ARRAYS, TEXTS, ShardWork, compile_missing
from jaxnav.scenes.task import Task
from jaxnav.store.signed import read_signed

if TYPE_CHECKING:
    from jaxnav.scenes.worlds import Scenes

#: The code that shards follow from, below `_SOURCE`; importers write scene files, whose checksums count instead.
_CODE = (
    *("categories.py", "exchange.py", "lattice.py", "scene.py", "task.py", "worlds.py"),
    *("generate/*.py", "generate/*.yaml", "tables/*.py"),
    *("files/record.py", "files/scene_file.py", "files/walls.py"),
)
_SOURCE = Path(__file__).parents[1]
_MEND = "delete the folder {}, then it is compiled again"


@dataclasses.dataclass(frozen=True)
class Shards:
    """Hold a sequence of banks on disk.

    The arrays of an element are memory-mapped, read-only, and read where they are used.

    Attributes:
      folder: of all shards.
      task: what they were compiled for.
      paths: folder of each shard.
      counts: number of scenes in each shard, at least 1.
      num_cells: the most cells of any shard.
      num_scenes: the most scenes of any shard.
      skipped: names of scenes without any possible goal, which are in no shard.
      checksum: CRC-32 of everything in the shards.
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
          IndexError: there is no such shard.
          InputError: a file of it is missing or damaged.
        """
        path = self.paths[index]
        texts = _read_texts(path)
        arrays = {field: _intact(path / f"{field}.npy", _map) for field in ARRAYS}
        return Bank(task=self.task, **{field: tuple(texts[field]) for field in TEXTS}, **arrays)


def compile_shards(
    scenes: "Scenes",
    task: Task,
    shard_scenes: int,
    cache: Path,
    report: Callable[[int, int], None],
    workers: int | None = None,
) -> Shards:
    """Compile scenes into shards, or open those compiled before.

    Shards hold nearly equal numbers of scenes, in order. Their folder is named after everything they follow from:
    scenes, task, `shard_scenes`, NumPy and the code that makes scenes and tables. A shard is written whole or not at
    all: after a kill the next call compiles those that are missing, and several processes may compile the same shards
    at once. With several workers the calling script needs its `if __name__ == "__main__"`.

    Args:
      scenes: sent to every worker once; each scene is made where it is compiled.
      task: what they are compiled for.
      shard_scenes: scenes of a shard at most, at least 1.
      cache: where the folder is, or will be made.
      report: called with the number of finished shards, and of all, after each.
      workers: processes that compile one shard at a time each, None for one per core; a single one is the caller's.

    Raises:
      InputError: no scene has a reachable goal, a scene cannot be made, or a shard in the cache is damaged.
    """
    if shard_scenes < 1:
        raise InputError(f"shard_scenes is {shard_scenes}; give a number of at least 1")
    folder = cache / _key(scenes, task, shard_scenes)
    folder.mkdir(parents=True, exist_ok=True)
    total = -(-len(scenes) // shard_scenes)
    work = ShardWork(scenes, task, tuple(folder / f"{number:05d}" for number in range(total)))
    missing = [number for number in range(total) if not work.paths[number].exists()]
    present = itertools.count(1)
    for _ in range(total - len(missing)):
        report(next(present), total)
    compile_missing(work, missing, workers or os.cpu_count() or 1, lambda: report(next(present), total))
    for part in folder.glob(".*.tmp"):  # left by processes that were killed
        shutil.rmtree(part, ignore_errors=True)
    return _open(folder, work)


def _open(folder: Path, work: ShardWork) -> Shards:
    """Describe compiled shards by their texts, and compare their checksums.

    Raises:
      InputError: no scene has a reachable goal, or a shard is damaged.
    """
    texts = [_read_texts(path) for path in work.paths]
    usable = [(path, text) for path, text in zip(work.paths, texts, strict=True) if text["names"]]
    if not usable:
        raise no_goal(len(work.scenes), work.task)
    counts = tuple(len(text["names"]) for _, text in usable)
    shards = Shards(
        folder=folder,
        task=work.task,
        paths=tuple(path for path, _ in usable),
        counts=counts,
        num_cells=max(text["cells"] for _, text in usable),
        num_scenes=max(counts),
        skipped=tuple(name for text in texts for name in text["skipped"]),
        checksum=zlib.crc32(repr([text["checksum"] for _, text in usable]).encode()),
    )
    for bank, (path, text) in zip(shards, usable, strict=True):
        if (len(bank.ahead), checksum(bank)) != (text["cells"], text["checksum"]):
            raise InputError(f"{path}: is damaged (its checksum is another); {_MEND.format(path)}")
    return shards


def _key(scenes: "Scenes", task: Task, shard_scenes: int) -> str:
    """Return a name that differs wherever the shards may differ."""
    key = hashlib.sha256(repr((scenes.identity, task, shard_scenes, np.__version__)).encode())
    files = {path for pattern in _CODE for path in _SOURCE.glob(pattern)}
    for path in sorted(path for path in files if path.name != "__init__.py"):
        code = path.read_bytes()
        key.update(f"{path.relative_to(_SOURCE).as_posix()} {len(code)} ".encode() + code)
    return key.hexdigest()[:20]


def _read_texts(path: Path) -> dict[str, Any]:
    return read_signed(path / "shard.json", _MEND.format(path))


def _map(path: Path) -> np.ndarray:
    return np.lib.format.open_memmap(path, mode="r")


def _intact(path: Path, read: Callable[[Path], Any]) -> Any:
    """Read a file of a shard.

    Raises:
      InputError: it is missing or damaged.
    """
    try:
        return read(path)
    except Exception as error:  # a damaged header can bring about any
        raise InputError(f"{path}: is missing or damaged ({error}); {_MEND.format(path.parent)}") from error
