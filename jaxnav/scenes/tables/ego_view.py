"""The ego-centric view: floor cells seen around the agent."""

import functools

import numpy as np

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, VIEW_UNKNOWN
from jaxnav.scenes.tables.visibility import TOLERANCE, cell_centres, opaque
from jaxnav.scenes.task import Rules


def ego_views(scene: Scene, rules: Rules, cells: np.ndarray, view: int) -> np.ndarray:
    """Return the ego-centric views of every pose.

    Args:
      scene: whose walls and tall opaque boxes hide cells.
      rules: headings, horizons and camera.
      cells: int [C, 2], the standable cells (iz, ix).
      view: V, cells along each side of a view.

    Returns:
      uint8 [P, V, V]: `VIEW_UNKNOWN`, `VIEW_FREE` where one can stand, or `VIEW_BLOCKED`.
    """
    steps, side = np.arange(view), np.arange(view) - view // 2
    offsets = rules.view_offsets(view)
    in_cone = np.abs(side) <= rules.half_view[0] * steps[:, None]  # [V, V], with the cell of the agent
    seen, which = np.unique(offsets[:, in_cone].reshape(-1, 2), axis=0, return_inverse=True)

    radius = int(np.abs(seen).max())
    mask = np.zeros(np.add(scene.reach.shape, 2 * radius), bool)
    mask[tuple((cells + radius).T)] = True
    around = cells[:, None] + radius + seen  # [C, O, 2]
    standable = np.where(mask[around[..., 0], around[..., 1]], VIEW_FREE, VIEW_BLOCKED)
    known = np.where(_view_known(scene, rules, cells, seen), standable, VIEW_UNKNOWN).astype(np.uint8)
    views = np.full((len(cells), rules.headings, view, view), VIEW_UNKNOWN, np.uint8)
    views[:, :, in_cone] = known[:, which.reshape(rules.headings, -1)]
    return np.repeat(views.reshape(-1, view, view), len(rules.horizons), axis=0)


def _view_known(scene: Scene, rules: Rules, cells: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return which floor cells around each cell can be seen.

    Walls and opaque boxes as high as the camera hide what is behind them.

    Args:
      scene: the scene.
      rules: the camera's height.
      cells: int [C, 2], the cells (iz, ix) to look from.
      offsets: int [O, 2], the cells (dz, dx) to look at.

    Returns:
      bool [C, O].
    """
    radius = int(np.abs(offsets).max())
    clear = ~np.pad(scene.walls | _covered(scene, rules), radius)
    # On the flattened lattice a displacement is one shift, whatever the cell.
    stride, flat = clear.shape[1], clear.ravel()
    margin = radius * (stride + 1)
    length = flat.size - 2 * margin
    at = (cells + radius) @ (stride, 1) - margin
    known = np.ones((len(offsets), len(cells)), bool)
    seen = np.empty(length, bool)
    for row, offset in zip(known, offsets.tolist(), strict=True):
        seen[:] = True
        for dz, dx in _between(*offset, radius):
            shift = margin + dz * stride + dx
            seen &= flat[shift : shift + length]
        row[:] = seen[at]
    return known.T


def _covered(scene: Scene, rules: Rules) -> np.ndarray:
    """Return the cells under tall opaque boxes, bool [nz, nx]."""
    x, y, z, sx, sy, sz = scene.boxes[opaque(scene.boxes)].T
    tall = y + sy / 2 >= rules.camera - TOLERANCE
    centres = cell_centres(scene, np.argwhere(np.ones_like(scene.walls)))
    distance = np.abs(centres[:, None] - np.stack([x, z], axis=-1)[tall])  # [cells, N, 2]
    within = distance <= np.stack([sx, sz], axis=-1)[tall] / 2 + TOLERANCE
    return np.any(within.all(axis=-1), axis=-1).reshape(scene.walls.shape)


@functools.lru_cache(maxsize=4096)
def _between(dz: int, dx: int, radius: int) -> list[tuple[int, int]]:
    """Return the cells strictly between (0, 0) and (dz, dx)."""
    steps = np.arange(1, 2 * radius)  # half-cell steps along the longest line
    # Rounding is symmetric about 0, so that a mirrored room has a mirrored view.
    z, x = (np.rint(d * steps / (2 * radius)).astype(int).tolist() for d in (dz, dx))
    passed = set(zip(z, x, strict=True))
    return sorted(passed - {(0, 0), (dz, dx)})
