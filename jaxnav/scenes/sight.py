"""Lines of sight: which boxes and walls hide what, and what lies in the camera's view."""

import numpy as np

from jaxnav.scenes.lattice import HORIZONS, heading_vectors
from jaxnav.scenes.scene import CELL, Scene

CAMERA_HEIGHT = 1.5
TAN_HALF_FIELD_OF_VIEW = float(np.tan(np.deg2rad(50.0)))
SIGHT_MARGIN = 0.3  # a line of sight ends this far before the target's centre
GRAZE = 1e-6  # touching a surface by less than this does not block
TOLERANCE = 1e-9  # on lengths that decide something, so that rounding errors do not; always on the side of yes


def cell_centres(scene: Scene, cells: np.ndarray) -> np.ndarray:
    """World (x, z) of cells (iz, ix), float64 [C, 2]."""
    return np.asarray(scene.origin) + CELL * cells[:, ::-1]


def opaque(boxes: np.ndarray) -> np.ndarray:
    """Which boxes [N, 6] block the sight: bulky furniture that stands on the floor, bool [N]."""
    _, y, _, sx, sy, sz = boxes.T
    bulky, low, high = np.minimum(sx, sz) - 0.3, 0.3 - (y - sy / 2), y + sy / 2 - 0.85
    return np.minimum(np.minimum(bulky, low), high) >= -TOLERANCE


def wall_boxes(scene: Scene) -> np.ndarray:
    """Wall cells as boxes without floor or ceiling, float64 [W, 6]."""
    centres = cell_centres(scene, np.argwhere(scene.walls))
    boxes = np.full((len(centres), 6), CELL)
    boxes[:, [0, 2]] = centres
    boxes[:, [1, 4]] = 0.0, np.inf
    return boxes


def line_of_sight(scene: Scene, centres: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Whether the camera above each cell has a clear line to each target object.

    Args:
      scene: the scene whose walls and opaque boxes hide things.
      centres: float64 [C, 2], world (x, z) of the cells.
      targets: int [N], indices of the target objects.

    Returns:
      bool [C, N].
    """
    camera = np.insert(centres, 1, CAMERA_HEIGHT, axis=1)
    points = scene.boxes[targets, :3]
    line = points - camera[:, None]
    length = np.linalg.norm(line, axis=-1, keepdims=True)
    line = line * np.maximum(1.0 - SIGHT_MARGIN / np.maximum(length, SIGHT_MARGIN), 0.0)

    furniture = np.flatnonzero(opaque(scene.boxes))
    blockers = np.concatenate([scene.boxes[furniture], wall_boxes(scene)])
    owners = np.concatenate([furniture, np.full(len(blockers) - len(furniture), -1)])
    clear = np.ones(line.shape[:2], bool)
    for box, owner in zip(blockers, owners, strict=True):
        half = box[3:] / 2
        exempt_target = (np.abs(points - box[:3]) <= half + GRAZE).all(axis=-1) | (targets == owner)
        exempt_camera = (np.abs(centres - box[[0, 2]]) <= half[[0, 2]] + GRAZE).all(axis=-1)
        hit = _meets(camera, line, box[:3] - half + GRAZE, box[:3] + half - GRAZE)
        clear &= ~hit | exempt_target[None, :] | exempt_camera[:, None]
    return clear


def _meets(start: np.ndarray, line: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Whether segments start [C, 3] + t line [C, N, 3], 0 <= t <= 1, enter the open box (low, high): bool [C, N]."""
    enter, leave = np.zeros(line.shape[:2]), np.ones(line.shape[:2])
    inside = np.ones(line.shape[:2], bool)
    for axis in range(3):
        a, d = start[:, None, axis], line[..., axis]
        moving = d != 0.0
        slope = np.where(moving, d, 1.0)
        t0, t1 = (low[axis] - a) / slope, (high[axis] - a) / slope
        enter = np.where(moving, np.maximum(enter, np.minimum(t0, t1)), enter)
        leave = np.where(moving, np.minimum(leave, np.maximum(t0, t1)), leave)
        inside &= moving | ((low[axis] < a) & (a < high[axis]))
    return inside & (enter < leave)


def offsets_in_view(centres: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points lie relative to the headings, and whether they are in the camera's view.

    Args:
      centres: float64 [C, 2], world (x, z) of the cells.
      points: float64 [N, 3].

    Returns:
      ahead, right: float64 [C, 8, N] metres; in_view: bool [C, 8, 2, N] over cells, headings and horizons.
    """
    vectors = heading_vectors()
    v = points[None, :, [0, 2]] - centres[:, None]  # [C, N, 2]
    ahead = np.einsum("cnd,hd->chn", v, vectors)
    right = np.einsum("cnd,hd->chn", v, np.stack([vectors[:, 1], -vectors[:, 0]], axis=-1))
    up = points[:, 1] - CAMERA_HEIGHT
    pitch = np.deg2rad(HORIZONS)[:, None]
    depth = ahead[:, :, None] * np.cos(pitch) - up * np.sin(pitch)
    rise = ahead[:, :, None] * np.sin(pitch) + up * np.cos(pitch)
    limit = TAN_HALF_FIELD_OF_VIEW * depth
    in_view = (depth > 0) & (np.abs(right)[:, :, None] <= limit) & (np.abs(rise) <= limit)
    return ahead, right, in_view


def view_known(scene: Scene, cells: np.ndarray, radius: int) -> np.ndarray:
    """Which floor cells around each cell can be seen past walls and opaque boxes that reach 1.5 m or more.

    Args:
      scene: the scene.
      cells: int [C, 2], the cells (iz, ix) to look from.
      radius: how many cells to look to every side.

    Returns:
      bool [C, 2 radius + 1, 2 radius + 1] over the offsets (dz, dx).
    """
    x, y, z, sx, sy, sz = scene.boxes[opaque(scene.boxes)].T
    tall = y + sy / 2 >= CAMERA_HEIGHT - TOLERANCE
    grid = np.argwhere(np.ones_like(scene.walls))
    distance = np.abs(cell_centres(scene, grid)[:, None] - np.stack([x, z], axis=-1)[tall])
    covered = (distance <= np.stack([sx, sz], axis=-1)[tall] / 2 + TOLERANCE).all(axis=-1).any(axis=-1)
    blocked = np.pad(scene.walls | covered.reshape(scene.walls.shape), radius)
    span = np.arange(-radius, radius + 1)
    known = np.ones((len(cells), len(span), len(span)), bool)
    for step in range(1, 2 * radius):  # half-cell steps along the longest line
        share = step / (2 * radius)
        dz = np.rint(span * share).astype(int)  # symmetric about 0, so that a mirrored room has a mirrored view
        seen = ~blocked[cells[:, 0, None, None] + radius + dz[:, None], cells[:, 1, None, None] + radius + dz[None, :]]
        # A sample that falls into the looked-at cell itself, or into the own one, hides nothing.
        last = (dz == span)[:, None] & (dz == span)[None, :]
        first = (dz == 0)[:, None] & (dz == 0)[None, :]
        known &= seen | last | first
    return known
