"""From scenes to flat tables over every pose, so that a step of the environment is a few gathers."""

import zlib
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import ahead_of, best_lengths, standable_cells, successors, walking_distances
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.detector import detection_range, object_size
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, VIEW_UNKNOWN, RowFormat
from jaxnav.scenes.tables.visibility import (
    TOLERANCE,
    cell_centres,
    clear_of_walls,
    line_of_sight,
    offsets_in_view,
    view_known,
)
from jaxnav.scenes.task import Rules, Task


class SceneTable(NamedTuple):
    """Everything about one scene; P = C H T poses `(cell * H + heading) * T + horizon` of H headings and T horizons.

    Attributes:
      name, room_type: of the scene.
      ahead: int32 [C, H], cell after MoveAhead.
      rows: uint8 [P, R], what is perceived (see `RowFormat`).
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
    """The tables of S scenes end to end, with global pose and cell indices.

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
        """Pose after every action, int32 [P, 6]."""
        return successors(self.ahead, self.task.rules)


def compile_scene(scene: Scene, task: Task) -> SceneTable:
    """Compile one scene (rules: docs/environment.md)."""
    rules, row_format = task.rules, RowFormat(len(task.categories))
    cells = standable_cells(scene.reach)
    centres = cell_centres(scene, cells)
    ahead = ahead_of(cells, rules)
    ids = np.asarray(category_ids(scene.types, task.categories), np.int64)
    targets = np.flatnonzero(ids >= 0)
    kinds, points, size = ids[targets], scene.boxes[targets, :3], object_size(scene.boxes[targets])
    distance = np.linalg.norm(points[None, :, [0, 2]] - centres[:, None], axis=-1)  # [C, N]

    # Pairs of a cell and a target that may be seen from there, the nearest (then the first in the scene) last.
    cell, target = np.nonzero(distance <= np.maximum(detection_range(size), rules.success_distance) + TOLERANCE)
    clear = line_of_sight(scene, rules, centres[cell], targets[target])
    cell, target = cell[clear], target[clear]
    order = np.lexsort((-target, -distance[cell, target]))
    cell, target = cell[order], target[order]
    kind, away = kinds[target], distance[cell, target]
    ahead_by, right_by, in_view = offsets_in_view(rules, centres[cell], points[target])

    def spread(pairs: np.ndarray) -> tuple[np.ndarray, ...]:
        """The pairs, and the indices (pose, category), at which these pairs are in view."""
        pair, heading, horizon = np.nonzero(in_view & pairs[:, None, None])
        pose = (cell[pair] * rules.headings + heading) * len(rules.horizons) + horizon
        return pair, heading, pose, kind[pair]

    shape = (len(cells) * rules.poses_per_cell, len(task.categories))
    pair, heading, *place = spread(away <= detection_range(size[target]) + TOLERANCE)
    seen = np.zeros(shape, bool)
    seen[*place] = True
    fields = np.zeros((4, *shape))  # of the nearest: where indices repeat, the last value stays
    fields[:, *place] = ahead_by[pair, heading], right_by[pair, heading], away[pair], size[target[pair]]
    detections = task.detector.detect(scene.name, rules.half_view[0], seen, *fields)

    if rules.success == "seen":
        found = np.zeros(shape, bool)
        found[*spread(away <= rules.success_distance + TOLERANCE)[2:]] = True
        goal_distance = np.full((len(cells), shape[1]), np.inf)
        np.minimum.at(goal_distance.T, kinds, distance.T)
    else:
        goal_distance = _walks(scene, rules, centres, ahead, targets, kinds, task.is_goal())
        found = np.repeat(goal_distance <= rules.success_distance + TOLERANCE, rules.poses_per_cell, axis=0)
    found &= task.is_goal()
    return SceneTable(
        name=scene.name,
        room_type=scene.room_type,
        ahead=ahead,
        rows=row_format.pack(detections, _ego_views(scene, rules, cells, row_format.view)),
        best_length=best_lengths(successors(ahead, rules), found),
        goal_distance=goal_distance.astype(np.float32),
    )


def compile_bank(scenes: Iterable[Scene], task: Task) -> Bank:
    """Compile scenes into one bank; those in which no goal can be reached are left out and named in `skipped`.

    Raises:
      InputError: no scene is left.
    """
    return join([compile_scene(scene, task) for scene in scenes], task)


def join(tables: Sequence[SceneTable], task: Task) -> Bank:
    """The tables of scenes end to end; see `compile_bank`."""
    possible = [np.flatnonzero((table.best_length > 0).any(axis=0)) for table in tables]
    kept = [(table, goals) for table, goals in zip(tables, possible, strict=True) if len(goals)]
    if not kept:
        raise InputError(
            f"none of the {len(tables)} scenes has a reachable goal: give scenes with objects of the categories "
            f"{', '.join(task.goals or task.categories)} near standable cells"
        )
    num_cells = np.array([len(table.ahead) for table, _ in kept], np.int32)
    first_cell = np.cumsum(num_cells, dtype=np.int32) - num_cells
    goals = np.zeros((len(kept), len(task.categories)), np.int32)
    for row, (_, own) in zip(goals, kept, strict=True):
        row[: len(own)] = own
    return Bank(
        task=task,
        names=tuple(table.name for table, _ in kept),
        room_types=tuple(table.room_type for table, _ in kept),
        ahead=np.concatenate([table.ahead + first for (table, _), first in zip(kept, first_cell, strict=True)]),
        rows=np.concatenate([table.rows for table, _ in kept]),
        best_length=np.concatenate([table.best_length for table, _ in kept]),
        goal_distance=np.concatenate([table.goal_distance for table, _ in kept]),
        first_cell=first_cell,
        num_cells=num_cells,
        goals=goals,
        num_goals=np.array([len(own) for _, own in kept], np.int32),
        skipped=tuple(table.name for table, own in zip(tables, possible, strict=True) if not len(own)),
    )


def checksum(bank: Bank) -> int:
    """CRC-32 of everything in a bank."""
    crc = 0
    for part in bank:
        crc = zlib.crc32(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode(), crc)
    return crc


def _walks(
    scene: Scene,
    rules: Rules,
    centres: np.ndarray,
    ahead: np.ndarray,
    targets: np.ndarray,
    kinds: np.ndarray,
    is_goal: np.ndarray,
) -> np.ndarray:
    """Metres to walk from each cell to the footprint of the nearest object of each goal category: float64 [C, K].

    The last part, at most the success distance, is straight and past no wall.
    """
    boxes = scene.boxes[targets]
    half = boxes[:, [3, 5]] / 2
    nearest = np.clip(centres[:, None], boxes[:, [0, 2]] - half, boxes[:, [0, 2]] + half)  # [C, N, 2]
    straight = np.linalg.norm(nearest - centres[:, None], axis=-1)
    cell, target = np.nonzero((straight <= rules.success_distance + TOLERANCE) & is_goal[kinds])
    end = nearest[cell, target]
    clear = clear_of_walls(scene, centres[cell], end, boxes[target][:, [0, 2]])
    cell, target = cell[clear], target[clear]
    direct = np.full((len(centres), len(is_goal)), np.inf)
    np.minimum.at(direct, (cell, kinds[target]), straight[cell, target])
    direct[:, is_goal] = walking_distances(ahead, rules, direct[:, is_goal])
    return direct


def _ego_views(scene: Scene, rules: Rules, cells: np.ndarray, view: int) -> np.ndarray:
    """Ego-centric views uint8 [P, V, V]: unknown, standable or not."""
    steps, side = np.arange(view), np.arange(view) - view // 2
    offsets = rules.view_offsets(view)
    in_cone = np.abs(side) <= rules.half_view[0] * steps[:, None]  # [V, V]; the own cell is in it
    looked_at, which = np.unique(offsets[:, in_cone].reshape(-1, 2), axis=0, return_inverse=True)

    radius = int(np.abs(looked_at).max())
    mask = np.zeros(np.add(scene.reach.shape, 2 * radius), bool)
    mask[tuple((cells + radius).T)] = True
    around = cells[:, None] + radius + looked_at  # [C, O, 2]
    standable = np.where(mask[around[..., 0], around[..., 1]], VIEW_FREE, VIEW_BLOCKED)
    known = np.where(view_known(scene, rules, cells, looked_at), standable, VIEW_UNKNOWN).astype(np.uint8)
    views = np.full((len(cells), rules.headings, view, view), VIEW_UNKNOWN, np.uint8)
    views[:, :, in_cone] = known[:, which.reshape(rules.headings, -1)]
    return np.repeat(views.reshape(-1, view, view), len(rules.horizons), axis=0)
