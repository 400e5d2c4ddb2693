"""Corridors of several lengths, compiled into shards.

The classes are not defined in a test, because the processes that compile shards import the classes of their scenes.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from jaxnav.errors import InputError
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.shards import Shards, compile_shards
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import Scenes
from support.scenes import CATEGORIES, SMALL, draw

TASK = Task(CATEGORIES)


@dataclasses.dataclass(frozen=True)
class Corridors:
    """Corridors of 4 to 8 rows with a book at their ends.

    Attributes:
      count: number of corridors.
      goalless: indices of corridors without a book.
      identity: name of the collection, part of the key of its shards.
    """

    count: int = 7
    goalless: tuple[int, ...] = ()
    identity: str = "corridors"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Scene:
        num_rows = 4 + index % 5
        objects = [] if index in self.goalless else [("Book", 0.25, 1.5, num_rows / 4, *SMALL)]
        scene = draw(["..", "#."] + [".."] * (num_rows - 2), *objects)
        return dataclasses.replace(scene, name=f"corridor-{index}")


@dataclasses.dataclass(frozen=True)
class GatedCorridors(Corridors):
    """Corridors of which some wait until a file exists.

    Attributes:
      gate_path: path of the file.
      gated: indices of the corridors that wait for the file.
    """

    gate_path: str = "/nonexistent"
    gated: tuple[int, ...] = ()

    def __getitem__(self, index: int) -> Scene:
        while index in self.gated and not Path(self.gate_path).exists():
            time.sleep(0.01)
        return super().__getitem__(index)


class FaultyCorridors(GatedCorridors):
    """Corridors with an error in the fourth one."""

    def __getitem__(self, index: int) -> Scene:
        if index == 3:
            raise InputError("corridor 3: has no end; give it one")
        return super().__getitem__(index)


def compile_corridors(
    cache_folder: Path,
    scenes: Scenes = Corridors(),
    task: Task = TASK,
    shard_scenes: int = 2,
    workers: int = 1,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Shards:
    """Compile corridors into shards of `shard_scenes` scenes below a folder."""
    return compile_shards(scenes, task, shard_scenes, cache_folder, report, workers)
