"""Lines of sight, and what lies in the camera's view."""

import numpy as np

from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.task import Rules

SIGHT_MARGIN = 0.3  # a line of sight ends this far before the target's centre
GRAZE = 1e-6  # touching a surface by less than this does not block
TOLERANCE = 1e-9  # metres; added to limits, so that rounding errors do not decide


def cell_centres(scene: Scene, cells: np.ndarray) -> np.ndarray:
    """Return the centres of cells.

    Args:
      scene: the scene.
      cells: int [C, 2], (iz, ix).

    Returns:
      float64 [C, 2], world (x, z), metres.
    """
    return np.asarray(scene.origin) + CELL * cells[:, ::-1]


def opaque(boxes: np.ndarray) -> np.ndarray:
    """Return which boxes [N, 6] block the sight, bool [N].

    They are those of bulky furniture that stands on the floor.
    """
    _, y, _, sx, sy, sz = boxes.T
    bulky, low, high = np.minimum(sx, sz) - 0.3, 0.3 - (y - sy / 2), y + sy / 2 - 0.85
    return np.minimum(np.minimum(bulky, low), high) >= -TOLERANCE


def rectangles(mask: np.ndarray) -> np.ndarray:
    """Return disjoint rectangles that cover a mask [nz, nx].

    Returns:
      int [R, 4], z0, x0, z1, x1 of each, the latter two excluded.
    """
    open_runs: dict[tuple[int, int], int] = {}
    closed = []
    for z, row in enumerate(np.diff(np.pad(mask, ((0, 1), (1, 1))).astype(np.int8), axis=1)):
        runs = list(zip(np.flatnonzero(row == 1).tolist(), np.flatnonzero(row == -1).tolist(), strict=True))
        closed += [(z0, x0, z, x1) for (x0, x1), z0 in open_runs.items() if (x0, x1) not in runs]
        open_runs = {run: open_runs.get(run, z) for run in runs}
    return np.array(closed, int).reshape(-1, 4)


def clear_of_walls(scene: Scene, start: np.ndarray, end: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return whether segments meet no wall cell.

    Args:
      scene: whose walls count.
      start, end: float64 [M, 2], world (x, z) of the ends.
      target: float64 [M, 2]; wall cells that contain `start` or `target` do not count.

    Returns:
      bool [M].
    """
    clear = np.ones(len(start), bool)
    exempt = np.concatenate([_walls_at(scene, start), _walls_at(scene, target)], axis=1)
    special = (exempt >= 0).any(axis=1)
    groups = [(~special, [])]
    if special.any():
        sets, member = np.unique(np.sort(exempt[special], axis=1), axis=0, return_inverse=True)
        rows = np.flatnonzero(special)
        groups += [(rows[member.ravel() == i], cells[cells >= 0]) for i, cells in enumerate(sets)]
    corner = np.asarray(scene.origin) - CELL / 2
    for rows, cells in groups:
        walls = scene.walls.copy()
        walls.flat[cells] = False
        boxes = corner + CELL * rectangles(walls)[:, [[1, 0], [3, 2]]]  # [R, 2, (x, z)]
        clear[rows] = ~_blocked(start[rows], end[rows], boxes)
    return clear


def _walls_at(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Return the wall cells that contain points [M, 2].

    Returns:
      int [M, 4], flat indices, up to four for each point, -1 for none.
    """
    place = (points - scene.origin) / CELL
    reach = GRAZE / CELL
    columns, rows = np.moveaxis(np.rint([place - reach, place + reach]).astype(int), -1, 0)  # [2, M] each
    iz, ix = np.stack([rows[[0, 0, 1, 1]], columns[[0, 1, 0, 1]]]).swapaxes(1, 2)
    nz, nx = scene.walls.shape
    within = (iz >= 0) & (iz < nz) & (ix >= 0) & (ix < nx)
    flat = np.where(within, iz * nx + ix, 0)
    return np.where(within & scene.walls.flat[flat], flat, -1)


def _blocked(start: np.ndarray, end: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return whether segments [M, D] enter any box, bool [M].

    The boxes [R, 2, D] are shrunk by `GRAZE`.
    """
    line = end - start
    low, high = np.minimum(start, end), np.maximum(start, end)
    blocked = np.zeros(len(start), bool)
    for near, far in zip(boxes[:, 0] + GRAZE, boxes[:, 1] - GRAZE, strict=True):
        maybe = np.flatnonzero(~blocked & (low < far).all(axis=1) & (high > near).all(axis=1))
        blocked[maybe] = _meets(start[maybe], line[maybe], near, far)
    return blocked


def _meets(start: np.ndarray, line: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return whether segments enter an open box, bool [M].

    The segments are start + t line [M, D], 0 <= t <= 1; the box is (low, high) [D].
    """
    moving = line != 0.0
    slope = np.where(moving, line, 1.0)
    t0, t1 = (low - start) / slope, (high - start) / slope
    enter = np.where(moving, np.minimum(t0, t1), 0.0).max(axis=1, initial=0.0)
    leave = np.where(moving, np.maximum(t0, t1), 1.0).min(axis=1, initial=1.0)
    inside = (moving | ((low < start) & (start < high))).all(axis=1)
    return inside & (enter < leave)


def line_of_sight(scene: Scene, rules: Rules, cameras: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return whether cameras have a clear line to target objects.

    Args:
      scene: the scene whose walls and opaque boxes hide things.
      rules: the camera's height.
      cameras: float64 [M, 2], world (x, z).
      targets: int [M], indices of the target objects.

    Returns:
      bool [M].
    """
    camera = np.insert(cameras, 1, rules.camera, axis=1)
    points = scene.boxes[targets, :3]
    line = points - camera
    length = np.linalg.norm(line, axis=-1, keepdims=True)
    end = camera + line * np.maximum(1.0 - SIGHT_MARGIN / np.maximum(length, SIGHT_MARGIN), 0.0)
    clear = clear_of_walls(scene, cameras, end[:, [0, 2]], points[:, [0, 2]])
    for blocker in np.flatnonzero(opaque(scene.boxes)):
        centre, half = scene.boxes[blocker, :3], scene.boxes[blocker, 3:] / 2
        low, high = centre - half, centre + half
        near = np.flatnonzero(
            clear
            & (np.minimum(cameras, end[:, [0, 2]]) < high[[0, 2]]).all(axis=1)
            & (np.maximum(cameras, end[:, [0, 2]]) > low[[0, 2]]).all(axis=1)
        )
        exempt = (np.abs(points[near] - centre) <= half + GRAZE).all(axis=1) | (targets[near] == blocker)
        exempt |= (np.abs(cameras[near] - centre[[0, 2]]) <= half[[0, 2]] + GRAZE).all(axis=1)
        near = near[~exempt]
        clear[near] = ~_meets(camera[near], end[near] - camera[near], low + GRAZE, high - GRAZE)
    return clear


def offsets_in_view(rules: Rules, cameras: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets of points, and whether they are in view.

    Args:
      rules: headings, horizons and the camera.
      cameras: float64 [M, 2], world (x, z).
      points: float64 [M, 3].

    Returns:
      ahead, right: float64 [M, H], metres; in_view: bool [M, H, T], by heading and horizon.
    """
    directions = rules.directions()
    v = points[:, [0, 2]] - cameras
    ahead = v @ directions.T
    right = v @ np.stack([directions[:, 1], -directions[:, 0]])
    up = (points[:, 1] - rules.camera)[:, None, None]
    pitch = np.deg2rad(rules.horizons)
    depth = ahead[..., None] * np.cos(pitch) - up * np.sin(pitch)
    rise = ahead[..., None] * np.sin(pitch) + up * np.cos(pitch)
    across, high = rules.half_view
    in_view = (depth > 0) & (np.abs(right)[..., None] <= across * depth) & (np.abs(rise) <= high * depth)
    return ahead, right, in_view
