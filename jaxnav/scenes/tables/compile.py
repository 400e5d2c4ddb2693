"""Compilation of scenes to flat tables over every pose."""

import itertools
import zlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import (
    ahead_of,
    best_actions,
    best_lengths,
    standable_cells,
    successors,
    walking_distances,
)
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.detector import MAX_RANGE, detection_range, object_size
from jaxnav.scenes.tables.ego_view import ego_views
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.tables.sightings import Targets, detect, find_sightings
from jaxnav.scenes.tables.visibility import TOLERANCE, cell_centres, clear_of_walls
from jaxnav.scenes.task import Task


class SceneTable(NamedTuple):
    """Hold the tables of one scene.

    P = C H T poses of C cells, H headings and T horizons; pose = (cell * H + heading) * T + horizon.

    Attributes:
      name, room_type: of the scene.
      ahead: int32 [C, H], cell after MoveAhead.
      rows: uint8 [P, R], what is perceived, see `RowFormat`.
      best_length: uint16 [P, K], L*, 0 where a goal cannot be reached or is none.
      goal_distance: float32 [C, K], metres to the nearest object of a category, inf without one: horizontally to its
        centre where success is to see it, else the walk to its footprint.
    """

    name: str
    room_type: str
    ahead: np.ndarray
    rows: np.ndarray
    best_length: np.ndarray
    goal_distance: np.ndarray


class Bank(NamedTuple):
    """Hold the tables of S scenes end to end.

    Indices of poses and cells are global.

    Attributes:
      task: what they were compiled for.
      names: [S] scene names.
      room_types: [S] room type names.
      ahead: int32 [C, H].
      rows: uint8 [P, R].
      best_length: uint16 [P, K].
      goal_distance: float32 [C, K].
      first_cell: int32 [S], the first cell of each scene.
      num_cells: int32 [S].
      goals: int32 [S, K], the possible goals of each scene, first `num_goals` entries valid.
      num_goals: int32 [S].
      skipped: names of scenes without any possible goal, which are not in the bank.
    """

    task: Task
    names: tuple[str, ...]
    room_types: tuple[str, ...]
    ahead: np.ndarray
    rows: np.ndarray
    best_length: np.ndarray
    goal_distance: np.ndarray
    first_cell: np.ndarray
    num_cells: np.ndarray
    goals: np.ndarray
    num_goals: np.ndarray
    skipped: tuple[str, ...]

    @property
    def successor(self) -> np.ndarray:
        """Return the pose after every action, int32 [P, 6]."""
        return successors(self.ahead, self.task.rules)

    @property
    def expert(self) -> np.ndarray:
        """Return the first action of a shortest path to every goal.

        Returns:
          uint8 [P, K], see `best_actions`.
        """
        successor, poses = self.successor, np.arange(len(self.rows))
        goals = [np.full_like(poses, goal) for goal in range(self.best_length.shape[1])]
        actions = [best_actions(successor, self.best_length, poses, goal).astype(np.uint8) for goal in goals]
        return np.stack(actions, axis=-1)


def compile_scene(scene: Scene, task: Task) -> SceneTable:
    """Compile one scene by the rules of docs/environment.md."""
    rules, row_format = task.rules, RowFormat(len(task.categories))
    cells = standable_cells(scene.reach)
    centres, ahead = cell_centres(scene, cells), ahead_of(cells, rules)
    targets = _targets(scene, task, centres)
    limit = np.maximum(detection_range(object_size(scene.boxes[targets.objects])), rules.success_distance)
    sightings = find_sightings(scene, rules, centres, targets, limit)
    shape = (len(cells) * rules.poses_per_cell, len(task.categories))
    if rules.success == "seen":
        success = sightings.within(rules.success_distance, shape)
        goal_distance = np.full((len(cells), shape[1]), np.inf)
        np.minimum.at(goal_distance.T, targets.category, targets.distance.T)
    else:
        goal_distance = _walks(scene, task, centres, ahead, targets)
        success = np.repeat(goal_distance <= rules.success_distance + TOLERANCE, rules.poses_per_cell, axis=0)
    success &= task.is_goal()
    return SceneTable(
        name=scene.name,
        room_type=scene.room_type,
        ahead=ahead,
        rows=row_format.pack(detect(scene, task, sightings, shape[0]), ego_views(scene, rules, cells, row_format.view)),
        best_length=best_lengths(successors(ahead, rules), success),
        goal_distance=goal_distance.astype(np.float32),
    )


def in_view(scene: Scene, task: Task) -> np.ndarray:
    """Return which categories are in view from every pose.

    They are those of which a detector without misses, and of the same range (`MAX_RANGE`) for objects of all sizes,
    would see an object.

    Returns:
      bool [P, K], poses in the order of `SceneTable.rows`.
    """
    cells = standable_cells(scene.reach)
    centres = cell_centres(scene, cells)
    targets = _targets(scene, task, centres)
    sightings = find_sightings(scene, task.rules, centres, targets, np.full(len(targets.objects), MAX_RANGE))
    return sightings.within(MAX_RANGE, (len(cells) * task.rules.poses_per_cell, len(task.categories)))


def compile_bank(scenes: Iterable[Scene], task: Task) -> Bank:
    """Compile scenes into one bank.

    Scenes in which no goal can be reached are left out and named in `skipped`.

    Raises:
      InputError: no scene is left.
    """
    return join([compile_scene(scene, task) for scene in scenes], task)


def join(tables: Sequence[SceneTable], task: Task) -> Bank:
    """Join the tables of scenes end to end; see `compile_bank`."""
    possible = [np.flatnonzero((table.best_length > 0).any(axis=0)) for table in tables]
    kept = [_bank(table, goals, task) for table, goals in zip(tables, possible, strict=True) if len(goals)]
    if not kept:
        raise no_goal(len(tables), task)
    skipped = tuple(table.name for table, goals in zip(tables, possible, strict=True) if not len(goals))
    return concatenate(kept)._replace(skipped=skipped)


def concatenate(banks: Sequence[Bank]) -> Bank:
    """Put the scenes of banks of one task end to end."""
    first = np.cumsum([0] + [len(bank.ahead) for bank in banks[:-1]], dtype=np.int32)
    moved = [
        bank._replace(ahead=bank.ahead + start, first_cell=bank.first_cell + start)
        for bank, start in zip(banks, first, strict=True)
    ]

    def together(name: str) -> Any:
        parts = [getattr(bank, name) for bank in moved]
        return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else tuple(itertools.chain(*parts))

    return Bank(banks[0].task, *(together(name) for name in Bank._fields[1:]))


def no_goal(num_scenes: int, task: Task) -> InputError:
    """Return the error of scenes without a reachable goal."""
    return InputError(
        f"none of the {num_scenes} scenes has a reachable goal: give scenes with objects of the categories "
        f"{', '.join(task.goals or task.categories)} near standable cells"
    )


def checksum(bank: Bank) -> int:
    """Return the CRC-32 of everything in a bank."""
    crc = 0
    for part in bank:
        crc = zlib.crc32(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode(), crc)
    return crc


def _bank(table: SceneTable, goals: np.ndarray, task: Task) -> Bank:
    """Return the bank of one scene with its possible goals."""
    filled = np.zeros((1, len(task.categories)), np.int32)
    filled[0, : len(goals)] = goals
    return Bank(
        task=task,
        names=(table.name,),
        room_types=(table.room_type,),
        ahead=table.ahead,
        rows=table.rows,
        best_length=table.best_length,
        goal_distance=table.goal_distance,
        first_cell=np.zeros(1, np.int32),
        num_cells=np.array([len(table.ahead)], np.int32),
        goals=filled,
        num_goals=np.array([len(goals)], np.int32),
        skipped=(),
    )


def _targets(scene: Scene, task: Task, centres: np.ndarray) -> Targets:
    """Return the objects of categories."""
    categories = np.asarray(category_ids(scene.types, task.categories), np.int64)
    index = np.flatnonzero(categories >= 0)
    distance = np.linalg.norm(scene.boxes[index][:, [0, 2]] - centres[:, None], axis=-1)
    return Targets(index, categories[index], distance)


def _walks(scene: Scene, task: Task, centres: np.ndarray, ahead: np.ndarray, targets: Targets) -> np.ndarray:
    """Return the walk from each cell to each goal category.

    It ends at the footprint of the nearest object. The last part, at most the success distance, is straight and past no
    wall.

    Returns:
      float64 [C, K], metres.
    """
    rules, is_goal = task.rules, task.is_goal()
    boxes = scene.boxes[targets.objects]
    half = boxes[:, [3, 5]] / 2
    nearest = np.clip(centres[:, None], boxes[:, [0, 2]] - half, boxes[:, [0, 2]] + half)  # [C, N, 2]
    straight = np.linalg.norm(nearest - centres[:, None], axis=-1)
    cell, target = np.nonzero((straight <= rules.success_distance + TOLERANCE) & is_goal[targets.category])
    clear = clear_of_walls(scene, centres[cell], nearest[cell, target], boxes[target][:, [0, 2]])
    cell, target = cell[clear], target[clear]
    direct = np.full((len(centres), len(is_goal)), np.inf)
    np.minimum.at(direct, (cell, targets.category[target]), straight[cell, target])
    direct[:, is_goal] = walking_distances(ahead, rules, direct[:, is_goal])
    return direct
