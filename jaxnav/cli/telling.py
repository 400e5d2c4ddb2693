import dataclasses
from typing import Annotated, Literal

import numpy as np
import tyro

from jaxnav.scenes.io import read_scenes
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, FileScenes, Scenes, from_file, generated


@dataclasses.dataclass(frozen=True)
class Source:
    """Scenes of a file, or of a generated world.

    Attributes:
      file: scene file, or the name of a generated world: `rooms`, `apartments` or `houses`.
      split: of the scenes; default: all of a file, `val` of a generated world.
      seed: of a generated world.
      shift: layout shift of a generated world, from 0 to 1.
      world: world whose categories and rules count; default: the generated one, and `rooms` for a file.
    """

    file: Annotated[str, tyro.conf.Positional]
    split: Literal["train", "val", "test"] | None = None
    seed: int = 0
    shift: float = 0.0
    world: Literal["rooms", "apartments", "houses"] | None = None

    @property
    def task(self) -> Task:
        """Categories and rules."""
        return WORLDS[self.world or (self.file if self.file in WORLDS else "rooms")].task

    def scenes(self, count: int | None = None) -> Scenes:
        """The scenes.

        Args:
          count: how many of a generated world; None for as many as usual.

        Raises:
          InputError: no readable scene file, no scene of the split, or an impossible number.
        """
        if self.file in WORLDS:
            return generated(self.file, self.split or "val", count, self.seed, self.shift)
        if self.split is None:
            return FileScenes(tuple(read_scenes(self.file)), self.file)
        return from_file(self.file, self.split)


def scene_size(scene: Scene) -> np.ndarray:
    """Width and depth in metres of the rectangle around the cells that are no wall and the objects, float64 [2]."""
    iz, ix = np.nonzero(scene.reach | ~scene.walls)
    cells = np.asarray(scene.origin) + CELL * np.stack([ix, iz], axis=-1)
    centre, half = scene.boxes[:, [0, 2]], scene.boxes[:, [3, 5]] / 2
    low = np.minimum((cells - CELL / 2).min(axis=0), (centre - half).min(axis=0, initial=np.inf))
    high = np.maximum((cells + CELL / 2).max(axis=0), (centre + half).max(axis=0, initial=-np.inf))
    return high - low

@dataclasses.dataclass(frozen=True)
class StatsConfig(Source):
    pass
def tell_statistics(config,console):pass
