"""From scenes to flat tables over every pose, so that a step of the environment is a few gathers."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.detector import Detector, detection_range, object_size
from jaxnav.scenes.lattice import (
    HEADING_STEPS,
    HORIZONS,
    NUM_HEADINGS,
    POSES_PER_CELL,
    best_lengths,
    standable_cells,
    successors,
)
from jaxnav.scenes.rows import VIEW_BLOCKED, VIEW_FREE, VIEW_UNKNOWN, RowLayout
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.sight import (
    TAN_HALF_FIELD_OF_VIEW,
    TOLERANCE,
    cell_centres,
    line_of_sight,
    offsets_in_view,
    view_known,
)

SUCCESS_DISTANCE = 1.5


class SceneTable(NamedTuple):
    """Everything about one scene; P = 16 C poses, `(cell * 8 + heading) * 2 + horizon`.

    Attributes:
      cells: int [C, 2], standable cells (iz, ix).
      successor: int32 [P, 6], pose after each action.
      rows: uint8 [P, R], what is perceived (see `RowLayout`).
      best_length: uint16 [P, K], L*, 0 where a goal cannot be reached.
      goal_distance: float32 [C, K], horizontal metres to the nearest object of a category, inf without one.
    """

    cells: np.ndarray
    successor: np.ndarray
    rows: np.ndarray
    best_length: np.ndarray
    goal_distance: np.ndarray


class Bank(NamedTuple):
    """The tables of S scenes end to end, with global pose and cell indices.

    Attributes:
      names: [S] scene names.
      categories: [K] category names.
      room_types: [S] room type names.
      successor: int32 [P, 6].
      rows: uint8 [P, R].
      best_length: uint16 [P, K].
      goal_distance: float32 [C, K].
      first_cell: int32 [S], the first cell of each scene.
      num_cells: int32 [S].
      goals: int32 [S, K], the possible goals of each scene, first `num_goals` entries valid.
      num_goals: int32 [S].
      skipped: names of scenes without any possible goal, which are not in the bank.
    """

    names: tuple[str, ...]
    categories: tuple[str, ...]
    room_types: tuple[str, ...]
    successor: np.ndarray
    rows: np.ndarray
    best_length: np.ndarray
    goal_distance: np.ndarray
    first_cell: np.ndarray
    num_cells: np.ndarray
    goals: np.ndarray
    num_goals: np.ndarray
    skipped: tuple[str, ...]


def compile_scene(scene: Scene, categories: tuple[str, ...], detector: Detector, layout: RowLayout) -> SceneTable:
    """Compile one scene (rules: docs/environment.md)."""
    cells = standable_cells(scene.reach)
    centres = cell_centres(scene, cells)
    ids = np.asarray(category_ids(scene.types, categories), np.int64)
    targets = np.flatnonzero(ids >= 0)
    points = scene.boxes[targets, :3]
    num_poses, num_categories = len(cells) * POSES_PER_CELL, len(categories)

    clear = line_of_sight(scene, centres, targets)
    ahead, right, in_view = offsets_in_view(centres, points)
    visible = (in_view & clear[:, None, None]).reshape(num_poses, len(targets))
    distance = np.linalg.norm(points[None, :, [0, 2]] - centres[:, None], axis=-1)  # [C, N]
    size = object_size(scene.boxes[targets])

    by_category = (ids[targets][:, None] == np.arange(num_categories)).astype(bool)  # [N, K]
    near = visible & _per_pose(distance <= SUCCESS_DISTANCE + TOLERANCE)
    found = near @ by_category
    detected = visible & _per_pose(distance <= detection_range(size) + TOLERANCE)

    seen = detected @ by_category
    nearest = np.zeros((num_poses, num_categories), np.int64)  # index of the object that fills the row
    for category in np.flatnonzero(seen.any(axis=0)):
        members = np.flatnonzero(by_category[:, category])
        ranked = np.where(detected[:, members], _per_pose(distance[:, members]), np.inf)
        nearest[:, category] = members[np.argmin(ranked, axis=1)]

    def of_nearest(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, nearest, axis=1) if len(targets) else np.zeros(nearest.shape)

    detections = detector.detect(
        scene.name,
        seen,
        of_nearest(_per_heading(ahead)),
        of_nearest(_per_heading(right)),
        of_nearest(_per_pose(distance)),
        size[nearest] if len(targets) else np.ones(nearest.shape),
    )
    successor = successors(cells)
    goal_distance = np.where(by_category[None], distance[..., None], np.inf).min(axis=1, initial=np.inf)
    return SceneTable(
        cells=cells,
        successor=successor,
        rows=layout.pack(detections, found, _ego_views(scene, cells, layout.view)),
        best_length=best_lengths(successor, found),
        goal_distance=goal_distance.astype(np.float32),
    )


def compile_bank(
    scenes: Sequence[Scene],
    categories: tuple[str, ...] = ITHOR_CATEGORIES,
    detector: Detector | None = None,
) -> Bank:
    """Compile scenes into one bank; scenes in which no goal can be reached are left out and named in `skipped`.

    Args:
      scenes: at least one scene.
      categories: [K] what can be looked for.
      detector: error rates; None for the defaults.

    Raises:
      InputError: no scene is left.
    """
    layout = RowLayout(len(categories))
    kept, skipped = [], []
    for scene in scenes:
        table = compile_scene(scene, categories, detector or Detector(), layout)
        possible = np.flatnonzero((table.best_length > 0).any(axis=0))
        kept.append((scene, table, possible)) if len(possible) else skipped.append(scene.name)
    if not kept:
        raise InputError(
            f"none of the {len(skipped)} scenes has a reachable goal: give scenes with objects of the categories "
            f"{', '.join(categories)} near standable cells"
        )
    tables = [table for _, table, _ in kept]
    num_cells = np.array([len(table.cells) for table in tables], np.int32)
    first_cell = np.cumsum(num_cells, dtype=np.int32) - num_cells
    goals = np.zeros((len(kept), len(categories)), np.int32)
    for row, (_, _, possible) in zip(goals, kept, strict=True):
        row[: len(possible)] = possible
    first_pose = first_cell * POSES_PER_CELL
    return Bank(
        names=tuple(scene.name for scene, _, _ in kept),
        categories=categories,
        room_types=tuple(scene.room_type for scene, _, _ in kept),
        successor=np.concatenate([t.successor + first for t, first in zip(tables, first_pose, strict=True)]),
        rows=np.concatenate([t.rows for t in tables]),
        best_length=np.concatenate([t.best_length for t in tables]),
        goal_distance=np.concatenate([t.goal_distance for t in tables]),
        first_cell=first_cell,
        num_cells=num_cells,
        goals=goals,
        num_goals=np.array([len(possible) for _, _, possible in kept], np.int32),
        skipped=tuple(skipped),
    )


def _per_pose(values: np.ndarray) -> np.ndarray:
    """Repeat values [C, N] over headings and horizons: [P, N]."""
    return np.repeat(values, POSES_PER_CELL, axis=0)


def _per_heading(values: np.ndarray) -> np.ndarray:
    """Repeat values [C, 8, N] over horizons: [P, N]."""
    return np.repeat(values.reshape(len(values) * NUM_HEADINGS, values.shape[-1]), len(HORIZONS), axis=0)


def _ego_views(scene: Scene, cells: np.ndarray, view: int) -> np.ndarray:
    """Ego-centric views uint8 [P, V, V]: unknown, standable or not."""
    steps, side = np.arange(view), np.arange(view) - view // 2
    forward = np.array([(dz, dx) / np.hypot(dz, dx) for dz, dx in HEADING_STEPS])  # [8, (z, x)]
    rightward = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
    offsets = np.rint(
        forward[:, None, None] * steps[:, None, None] + rightward[:, None, None] * side[:, None] + 0.0
    ).astype(int)  # [8, V, V, 2]
    radius = int(np.abs(offsets).max())
    in_cone = np.abs(side) <= TAN_HALF_FIELD_OF_VIEW * steps[:, None]  # [V, V]; the own cell is in it

    mask = np.zeros_like(scene.reach)
    mask[tuple(cells.T)] = True
    around = cells[:, None, None, None] + radius + offsets  # [C, 8, V, V, 2]
    standable = np.pad(mask, radius)[around[..., 0], around[..., 1]]
    known = view_known(scene, cells, radius)[:, radius + offsets[..., 0], radius + offsets[..., 1]] & in_cone
    views = np.where(known, np.where(standable, VIEW_FREE, VIEW_BLOCKED), VIEW_UNKNOWN).astype(np.uint8)
    return np.repeat(views.reshape(len(cells) * NUM_HEADINGS, view, view), len(HORIZONS), axis=0)
