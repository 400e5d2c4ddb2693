"""The worlds of the paper, and their scenes as sequences.

`WORLDS` defines scenes, task and usual limits of the three worlds. `make_generated_scenes` and `load_scenes` return the
scenes of one split, generated or from a file, and `shift_scenes` shifts their layout. `SceneSource` combines the three
for commands.
"""

import dataclasses
import difflib
import functools
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, get_args

import numpy as np

from jaxnav.choices import ShiftKind, Split, WorldName
from jaxnav.errors import InputError, MissingSplitError, check_choice
from jaxnav.scenes.context_exchange import ContextExchange, fit_context_exchange
from jaxnav.scenes.files.scene_file import iterate_scenes, parse_scenes, read_bytes, remove_headers
from jaxnav.scenes.generate.homes import generate_apartment, generate_house
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.layout_shift import exchange_places
from jaxnav.scenes.scene import SPLITS, Scene
from jaxnav.scenes.task import APARTMENTS, HOUSES, ROOMS, Task
from jaxnav.store.files import expand_home


@dataclasses.dataclass(frozen=True)
class World:
    """Scenes, task and usual limits of a world.

    Attributes:
      summary: description of the scenes in one line.
      generate: function from (split, index, seed) to a scene.
      counts: usual number of scenes of each split.
      task: categories, goals and rules.
      total_steps: environment steps that a policy is usually trained for.
      train_step_limit: actions of a training episode.
      step_limit: actions of an evaluation episode.
      large_step_limit: actions of an evaluation episode in living rooms.
      shaping: reward in training for every metre nearer to the goal than before in the episode, for worlds whose goals
        are rarely reached by chance.
      near_starts: probability that a training episode starts near its goal, for the same reason.
      guidance: weight of the guidance by shortest paths in training, see `PPOConfig.guidance`.
      budgets: numbers of actions within which success is counted in addition: where experience is most valuable, and
        later.
    """

    summary: str
    generate: Callable[[str, int, int], Scene]
    counts: dict[str, int]
    task: Task
    total_steps: int
    train_step_limit: int
    step_limit: int
    large_step_limit: int
    shaping: float
    near_starts: float
    guidance: float
    budgets: tuple[int, int]


#: AI2-THOR, RoboTHOR and Gibson in the paper.
WORLDS = {
    "rooms": World(
        summary="Single rooms, after AI2-THOR.",
        generate=generate_room,
        counts={"train": 80, "val": 20, "test": 20},
        task=ROOMS,
        total_steps=1_200_000,
        train_step_limit=100,
        step_limit=100,
        large_step_limit=200,
        shaping=0.0,
        near_starts=0.0,
        guidance=0.0,
        budgets=(20, 50),
    ),
    "apartments": World(
        summary="Apartments with partitions, after RoboTHOR.",
        generate=generate_apartment,
        counts={"train": 120, "val": 15, "test": 15},
        task=APARTMENTS,
        total_steps=6_000_000,
        train_step_limit=100,
        step_limit=500,
        large_step_limit=500,
        shaping=1.0,
        near_starts=0.5,
        guidance=0.03,
        budgets=(50, 150),
    ),
    "houses": World(
        summary="Houses of four to ten rooms, after ProcTHOR and Gibson.",
        generate=generate_house,
        counts={"train": 100, "val": 10, "test": 10},
        task=HOUSES,
        total_steps=6_000_000,
        train_step_limit=100,
        step_limit=500,
        large_step_limit=500,
        shaping=1.0,
        near_starts=0.5,
        guidance=0.1,
        budgets=(50, 150),
    ),
}

# Apartments of RoboTHOR, and multi-room homes of any dataset; all other origins are single rooms.
_WORLD_BY_ORIGIN = {
    "robothor": "apartments",
    "apartments": "apartments",
    "procthor": "houses",
    "habitat": "houses",
    "gibson": "houses",
    "houses": "houses",
}


def world_name_of_origin(origin: str) -> str:
    """Return the name of the world whose task and rules apply to scenes of an origin.

    Args:
      origin: the `world` of a scene, such as `robothor`; an unknown one corresponds to `rooms`.
    """
    return _WORLD_BY_ORIGIN.get(origin, "rooms")


class Scenes(Protocol):
    """Sequence of the scenes of one split; a scene can be made on access."""

    @property
    def identity(self) -> str:
        """Text that is different for different scenes."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Scene: ...


@dataclasses.dataclass(frozen=True)
class GeneratedScenes:
    """Scenes of a world that are generated on access.

    Attributes:
      world: name of the world, a key of `WORLDS`.
      split: `train`, `val` or `test`.
      count: number of scenes.
      seed: seed of the generator, at least 0.
    """

    world: str
    split: str
    count: int
    seed: int = 0

    @property
    def identity(self) -> str:
        """Arguments of the generator."""
        return repr(self)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Scene:
        if not 0 <= index < self.count:
            raise IndexError(index)
        return WORLDS[self.world].generate(self.split, index, self.seed)


@dataclasses.dataclass(frozen=True)
class FileScenes:
    """Scenes of a file.

    Attributes:
      scenes: the scenes in the order of the file.
      identity: split and checksum of the file.
    """

    scenes: tuple[Scene, ...]
    identity: str

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Scene:
        return self.scenes[index]


@dataclasses.dataclass(frozen=True)
class ShiftedScenes:
    """Scenes whose layout is shifted on access.

    Attributes:
      scenes: the scenes without a shift.
      task: task whose categories exchange their places.
      shift: share of the categories, from 0 to 1; see `exchange_places`.
      seed: seed of the exchange.
      context_exchange: the exchange that misleads most, or None for one by size.
    """

    scenes: Scenes
    task: Task
    shift: float
    seed: int
    context_exchange: ContextExchange | None = None

    @property
    def identity(self) -> str:
        """Identity of the unshifted scenes, with the shift."""
        exchange_options = f"{self.shift}, {self.seed}, {self.task.categories}, {self.task.goals}"
        if self.context_exchange is not None:
            exchange_options += f", by context: {self.context_exchange}"
        return f"{self.scenes.identity}, places exchanged: {exchange_options}"

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Scene:
        return exchange_places(self.scenes[index], self.task, self.shift, self.seed, self.context_exchange)


def shift_scenes(
    scenes: Scenes, task: Task, shift: float, seed: int = 0, context_exchange: ContextExchange | None = None
) -> Scenes:
    """Return scenes with a shifted layout.

    Args:
      scenes: scenes of a file or of a generated world.
      task: task whose categories exchange their places; see `exchange_places`.
      shift: layout shift, from 0 (the scenes themselves) to 1.
      seed: seed of the exchange, at least 0.
      context_exchange: the exchange that misleads most (`fit_context_exchange`); by default, categories of neighbouring
        sizes exchange.

    Raises:
      InputError: an impossible number.
    """
    if seed < 0 or not 0.0 <= shift <= 1.0:  # also rejects NaN
        raise InputError(f"layout shift: seed {seed}, shift {shift}; give a seed of at least 0 and a shift from 0 to 1")
    return ShiftedScenes(scenes, task, shift, seed, context_exchange) if shift else scenes


#: Exchanges by context are fitted to at most this number of scenes, evenly spread.
_MAX_FITTED_SCENES = 100


def fit_scene_exchange(scenes: Scenes | Sequence[Scene], task: Task) -> ContextExchange:
    """Fit the exchange of categories that misleads most to training scenes; see `fit_context_exchange`.

    Args:
      scenes: training scenes without a shift, of which 100 are read, and all of a room type that these lack.
      task: task whose categories exchange their places.

    Raises:
      InputError: no exchange misleads in any room type.
    """
    indices = np.unique(np.linspace(0, len(scenes) - 1, min(_MAX_FITTED_SCENES, len(scenes))).astype(int)).tolist()
    # Rare room types of a file, which an even spread may miss.
    if isinstance(scenes, FileScenes):
        read_types = {scenes[index].room_type for index in indices}
        indices += [index for index, scene in enumerate(scenes.scenes) if scene.room_type not in read_types]
    context_exchange = fit_context_exchange((scenes[int(index)] for index in indices), task)
    if not any(context_exchange.values()):
        raise InputError("--shift-by context: no exchange of categories misleads in the training scenes; use size")
    return context_exchange


#: Largest number of scenes of a split; their numbers fit into 32 bits.
_MAX_GENERATED_SCENES = 2**32


def make_generated_scenes(world: str, split: str, count: int | None = None, seed: int = 0) -> GeneratedScenes:
    """Return the scenes of one split of a generated world, which are generated on access.

    Args:
      world: a key of `WORLDS`.
      split: `train`, `val` or `test`.
      count: number of scenes; None for the world's usual number.
      seed: seed of the generator, at least 0.

    Raises:
      InputError: an unknown name, or an impossible number.
    """
    # Check the names before the numbers, whose default depends on them.
    check_choice("--world", world, WORLDS)
    check_choice("--split", split, SPLITS)
    count = WORLDS[world].counts[split] if count is None else count
    if not 1 <= count <= _MAX_GENERATED_SCENES:
        expected = f"request 1 to {_MAX_GENERATED_SCENES:,}"
        raise InputError(f"world {world!r}: {count} scenes of split {split!r}; {expected}")
    if seed < 0:
        raise InputError(f"world {world!r}: seed {seed}; give a number of at least 0")
    return GeneratedScenes(world, split, count, seed)


def load_scenes(path: str | Path, split: str | None) -> FileScenes:
    """Read the scenes of one split of a scene file.

    Args:
      path: the scene file.
      split: `train`, `val` or `test`; None for all scenes.

    Raises:
      MissingSplitError: the file has no scene of the split.
      InputError: unknown split, or no readable scene file.
    """
    # An unknown name of a split is reported before the file is read.
    if split is not None:
        check_choice("--split", split, SPLITS)
    whole_path = expand_home(path)
    content = read_bytes(whole_path)
    scenes = parse_scenes(whole_path, content)
    scenes_of_split = tuple(scene for scene in scenes if split in (None, scene.split))
    if not scenes_of_split:
        splits_in_file = sorted({scene.split for scene in scenes})
        raise MissingSplitError(f"{path}: holds no scene of split {split!r}; it holds {', '.join(splits_in_file)}")

    # The identity follows the scenes of the file, not its name or the account of its import.
    file_checksum = hashlib.sha256(remove_headers(content)).hexdigest()
    return FileScenes(scenes_of_split, f"{split or 'all'} of {file_checksum}")


@dataclasses.dataclass(frozen=True)
class SceneSource:
    """Options of a command that select scenes of a file or of a generated world.

    Attributes:
      file: scene file, or the name of a generated world: `rooms`, `apartments` or `houses`.
      split: split of the scenes. The default is all scenes of a file, or `val` of a generated world.
      seed: random seed of a generated world and of the layout shift, at least 0.
      shift: layout shift of the scenes, from 0 to 1: the share of the categories that exchange their places.
      shift_by: categories that exchange their places. `size`: neighbours in size, drawn for each scene. `context`: the
        ones whose exchange misleads most, fitted to the training scenes of the file or world and equal in all scenes.
      world: world whose categories and rules are used. By default, the scenes decide.
    """

    file: str
    split: Split | None = None
    seed: int = 0
    shift: float = 0.0
    shift_by: ShiftKind = "size"
    world: WorldName | None = None

    @functools.cached_property
    def world_name(self) -> str:
        """Name of the world whose rules apply; without `--world` the first scene of a file decides.

        Raises:
          InputError: no readable scene file.
        """
        if self.world:
            return self.world
        if self.file in WORLDS:
            return self.file

        # The first scene that can be used decides; later lines are not parsed.
        for scene in iterate_scenes(expand_home(self.file)):
            if isinstance(scene, Scene):
                return world_name_of_origin(scene.world)
        return world_name_of_origin("")

    @property
    def task(self) -> Task:
        """Categories and rules of the world."""
        return WORLDS[self.world_name].task

    def open(self, task: Task | None = None, count: int | None = None) -> Scenes:
        """Open the scenes.

        Args:
          task: task whose categories a shift exchanges; None for the task of the world.
          count: number of scenes of a generated world; None for its usual number.

        Raises:
          InputError: no readable scene file, no scene of the split, an impossible number, or an unknown kind of shift.
        """
        # Names of worlds come before files of the same name.
        check_choice("--shift-by", self.shift_by, get_args(ShiftKind))
        task = task or self.task
        scenes = self._open_split(self.split, count)
        if not (self.shift and self.shift_by == "context"):
            return shift_scenes(scenes, task, self.shift, self.seed)

        # The exchange that misleads most is that of the training scenes.
        context_exchange = fit_scene_exchange(self._open_split("train"), task)
        return shift_scenes(scenes, task, self.shift, self.seed, context_exchange)

    def _open_split(self, split: str | None, count: int | None = None) -> Scenes:
        """Open the unshifted scenes of a split; None for all scenes of a file, or `val` of a generated world."""
        if self.file in WORLDS:
            return make_generated_scenes(self.file, split or "val", count, self.seed)
        return load_scenes(self.file, split)

    def select_scene(self, name: str | None = None, index: int | None = None) -> Scene:
        """Return the scene of a name or an index, or else the first scene.

        Raises:
          InputError: there is no such scene, or both are given.
        """
        if name is not None and index is not None:
            raise InputError("--scene, --index: both are given; give the scene's name or its number")
        return self._scene_at(index or 0) if name is None else self._scene_named(name)

    def _scene_at(self, index: int) -> Scene:
        if index < 0:
            raise InputError(f"--index {index}: give 0 or more")
        # A generated world has any number of scenes, so it is opened as far as the index.
        scenes = self.open(count=index + 1)
        if index >= len(scenes):
            raise InputError(f"--index {index}: {self.file} holds {len(scenes)} scenes; give 0 to {len(scenes) - 1}")
        return scenes[index]

    def _scene_named(self, name: str) -> Scene:
        # Index all scenes by name; of equal names the last counts.
        scenes = self.open()
        scene_by_name = {}
        for index in range(len(scenes)):
            scene = scenes[index]
            scene_by_name[scene.name] = scene
        if name in scene_by_name:
            return scene_by_name[name]

        # Suggest similar names, or else the first ones.
        similar_names = difflib.get_close_matches(name, scene_by_name, n=3)
        if similar_names:
            name_hint = f"did you mean {' or '.join(similar_names)}?"
        else:
            name_hint = f"it holds {', '.join(list(scene_by_name)[:3])}, ..."
        raise InputError(f"--scene {name!r}: is not one of the {len(scene_by_name)} scenes of {self.file}; {name_hint}")
