"""Corridors of several lengths, compiled into shards.

Processes that compile them import them from here.
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
    """Hold corridors with a book at the end.

    Those of `without` have none.
    """

    count: int = 7
    without: tuple[int, ...] = ()
    identity: str = "corridors"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Scene:
        length = 4 + index % 5
        objects = [] if index in self.without else [("Book", 0.25, 1.5, length / 4, *SMALL)]
        scene = draw(["..", "#."] + [".."] * (length - 2), *objects)
        return dataclasses.replace(scene, name=f"corridor-{index}")


@dataclasses.dataclass(frozen=True)
class GatedCorridors(Corridors):
    """Hold corridors that wait for a file.

    Those of `gated` wait until `gate` is there.
    """

    gate: str = "/nonexistent"
    gated: tuple[int, ...] = ()

    def __getitem__(self, index: int) -> Scene:
        while index in self.gated and not Path(self.gate).exists():
            time.sleep(0.01)
        return super().__getitem__(index)


class FaultyCorridors(GatedCorridors):
    """Hold corridors of which the fourth raises an error."""

    def __getitem__(self, index: int) -> Scene:
        if index == 3:
            raise InputError("corridor 3: has no end; give it one")
        return super().__getitem__(index)


def build(
    cache: Path,
    scenes: Scenes = Corridors(),
    task: Task = TASK,
    shard_scenes: int = 2,
    workers: int = 1,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Shards:
    """Compile corridors into shards below a folder."""
    return compile_shards(scenes, task, shard_scenes, cache, report, workers)
