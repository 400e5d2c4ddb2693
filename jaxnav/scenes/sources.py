"""Scenes of a file or of a generated world."""

import dataclasses
import difflib
import functools
from pathlib import Path
from typing import Literal

from jaxnav.errors import InputError
from jaxnav.scenes.files.scene_file import iterate_scenes
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, Scenes, from_file, generated, shifted, world_named


@dataclasses.dataclass(frozen=True)
class SceneSource:
    """Describe scenes of a file or of a generated world.

    Attributes:
      file: scene file, or the name of a generated world: `rooms`, `apartments` or `houses`.
      split: of the scenes; default: all of a file, `val` of a generated world.
      seed: of a generated world, and of the shift.
      shift: layout shift, from 0 to 1: the share of the categories that exchange their places.
      world: world whose categories and rules count; default: the generated one, or what the scenes of a file stand for.
    """

    file: str
    split: Literal["train", "val", "test"] | None = None
    seed: int = 0
    shift: float = 0.0
    world: Literal["rooms", "apartments", "houses"] | None = None

    @functools.cached_property
    def world_name(self) -> str:
        """Return the name of the world whose rules count.

        In a file without `--world` its first scene decides.

        Raises:
          InputError: no readable scene file.
        """
        if self.world or self.file in WORLDS:
            return self.world or self.file
        scenes = (scene for scene in iterate_scenes(Path(self.file)) if isinstance(scene, Scene))
        return world_named(next((scene.world for scene in scenes), ""))

    @property
    def task(self) -> Task:
        """Return the categories and rules of the world."""
        return WORLDS[self.world_name].task

    def open(self, task: Task | None = None, count: int | None = None) -> Scenes:
        """Open the scenes.

        Args:
          task: whose categories a shift exchanges; None for that of the world.
          count: number of scenes of a generated world; None for its usual number.

        Raises:
          InputError: no readable scene file, no scene of the split, or an impossible number.
        """
        if self.file in WORLDS:
            scenes: Scenes = generated(self.file, self.split or "val", count, self.seed)
        else:
            scenes = from_file(self.file, self.split)
        return shifted(scenes, task or self.task, self.shift, self.seed)

    def select(self, name: str | None = None, index: int | None = None) -> Scene:
        """Return the scene of a name or an index.

        Without either it is the first.

        Raises:
          InputError: there is no such scene, or both are given.
        """
        if name is not None and index is not None:
            raise InputError("--scene, --index: both are given; give the scene's name or its number")
        return self._at(index or 0) if name is None else self._named(name)

    def _at(self, index: int) -> Scene:
        if index < 0:
            raise InputError(f"--index {index}: give 0 or more")
        scenes = self.open(count=index + 1)
        if index >= len(scenes):
            raise InputError(f"--index {index}: {self.file} holds {len(scenes)} scenes; give 0 to {len(scenes) - 1}")
        return scenes[index]

    def _named(self, name: str) -> Scene:
        scenes = self.open()
        named = {scene.name: scene for scene in (scenes[i] for i in range(len(scenes)))}
        if name not in named:
            near = difflib.get_close_matches(name, named, n=3)
            mend = f"did you mean {' or '.join(near)}?" if near else f"it holds {', '.join(list(named)[:3])}, ..."
            raise InputError(f"--scene {name!r}: is none of the {len(named)} scenes of {self.file}; {mend}")
        return named[name]
