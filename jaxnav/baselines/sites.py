"""Sites: squares of the floor plan where objects may stand."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene, extent
from jaxnav.scenes.tables.detector import MAX_RANGE
from jaxnav.scenes.tables.observation_row import RowFormat, relative_position
from jaxnav.scenes.tables.visibility import SIGHT_MARGIN, cell_centres, clear_of_walls
from jaxnav.scenes.task import Rules, Task

SPACING = 0.5  # metres between sites, and the width of a distance bin
BINS = int(MAX_RANGE / SPACING) + 1
NEAR, AROUND = 1.0, 2.0  # metres between related sites
SHARED = 0.25  # share of the cells that see either of two sites and see both, where they are in one place
NUM_RELATIONS, NUM_SURROUNDINGS = 3, 3


class Views(NamedTuple):
    """Hold what is in the horizontal field of view, past no wall and in range.

    Looks are numbered by horizon and distance bin, horizon * `BINS` + bin; there are L.

    Attributes:
      pose: int32 [M], in order.
      site: int32 [M].
      look: int16 [M], at the site from the pose.
      begin: int32 [P + 1], the first entry of each pose.
    """

    pose: np.ndarray
    site: np.ndarray
    look: np.ndarray
    begin: np.ndarray

    def at(self, pose: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the sites in view from a pose, and how."""
        entries = slice(self.begin[pose], self.begin[pose + 1])
        return self.site[entries], self.look[entries]


class Sites(NamedTuple):
    """Hold the N sites of a scene of P poses.

    Attributes:
      views: the sites in view from each pose.
      seen: int16 [P, K], the site at which a category is detected; -1 without a detection.
      objects: bool [K, N], where the objects of a category stand. Nothing but the fit reads it.
      relations: bool [3, N, N], whether two sites are within `NEAR`, within `AROUND`, and in one place.
      surroundings: float32 [3, N], in [0, 1]: the share that is standable, the share that is wall, how openly it lies.
    """

    views: Views
    seen: np.ndarray
    objects: np.ndarray
    relations: np.ndarray
    surroundings: np.ndarray


def find_sites(scene: Scene, task: Task, rows: np.ndarray) -> Sites:
    """Find the sites of a scene.

    A site is a square of `SPACING` that can be seen from a standable cell.

    Args:
      scene: whose walls hide sites.
      task: the categories and rules.
      rows: uint8 [P, R], what is perceived at each pose.
    """
    rules, cells = task.rules, standable_cells(scene.reach)
    centres, places = cell_centres(scene, cells), _squares(scene)
    apart = np.linalg.norm(places - centres[:, None], axis=-1)
    cell, place = np.nonzero(apart <= MAX_RANGE)
    line = places[place] - centres[cell]
    seen = np.maximum(1.0 - SIGHT_MARGIN / np.maximum(apart[cell, place], SIGHT_MARGIN), 0.0)
    clear = clear_of_walls(scene, centres[cell], centres[cell] + seen[:, None] * line, centres[cell])
    visible = np.zeros(apart.shape, np.float32)
    visible[cell[clear], place[clear]] = 1.0
    kept = visible.any(axis=0)
    visible, places, apart = visible[:, kept], places[kept], apart[:, kept]
    nearest = KDTree(places)
    objects = np.zeros((len(task.categories), len(places)), bool)
    category = np.array(category_ids(scene.types, task.categories), int)
    objects[category[category >= 0], nearest.query(scene.boxes[category >= 0][:, [0, 2]])[1]] = True
    return Sites(
        views=_views(rules, centres, places, visible > 0, apart),
        seen=_seen(rules, centres, rows, len(task.categories), nearest),
        objects=objects,
        relations=_relations(places, visible),
        surroundings=_surroundings(scene, places, visible),
    )


def _squares(scene: Scene) -> np.ndarray:
    """Return the centres of the squares over a scene, [N, 2]."""
    low, high = extent(scene)
    x, z = (np.arange(a + SPACING / 2, b + SPACING / 2, SPACING) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, z), axis=-1).reshape(-1, 2)


def _views(rules: Rules, centres: np.ndarray, places: np.ndarray, visible: np.ndarray, apart: np.ndarray) -> Views:
    cell, place = np.nonzero(visible)
    v, directions = places[place] - centres[cell], rules.directions()
    ahead, right = v @ directions.T, v @ np.stack([directions[:, 1], -directions[:, 0]])
    pair, heading = np.nonzero(np.abs(right) <= rules.half_view[0] * ahead)
    horizon = np.arange(len(rules.horizons))[:, None]
    pose = (cell[pair] * rules.headings + heading) * len(horizon) + horizon  # [T, M]
    look = (apart[cell, place][pair] / SPACING).astype(np.int16) + (horizon * BINS).astype(np.int16)
    order, site = np.argsort(pose, axis=None, kind="stable"), np.broadcast_to(place[pair], pose.shape)
    counts = np.bincount(pose.ravel(), minlength=len(centres) * rules.poses_per_cell)
    return Views(
        pose=pose.ravel()[order].astype(np.int32),
        site=site.ravel()[order].astype(np.int32),
        look=look.ravel()[order],
        begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
    )


def _seen(rules: Rules, centres: np.ndarray, rows: np.ndarray, categories: int, nearest: KDTree) -> np.ndarray:
    detections = RowFormat(categories).detections(rows)
    pose, category = np.nonzero(detections[..., 0])
    ahead, right = relative_position(detections[pose, category])
    cell, heading, _ = rules.split(pose)
    forward = rules.directions()[heading]
    rightward = np.stack([forward[:, 1], -forward[:, 0]], axis=-1)
    at = centres[cell] + ahead[:, None] * forward + right[:, None] * rightward
    seen = np.full(detections.shape[:2], -1, np.int16)
    seen[pose, category] = nearest.query(at)[1]
    return seen


def _relations(places: np.ndarray, visible: np.ndarray) -> np.ndarray:
    both, each = visible.T @ visible, visible.sum(axis=0)
    apart = np.linalg.norm(places - places[:, None], axis=-1)
    shared = both / (each + each[:, None] - both)
    return np.stack([(apart <= NEAR) & (both > 0), (apart <= AROUND) & (both > 0), shared >= SHARED])


def _surroundings(scene: Scene, places: np.ndarray, visible: np.ndarray) -> np.ndarray:
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * CELL / 2
    column, row = np.moveaxis(np.rint((places[:, None] + corners - scene.origin) / CELL).astype(int), -1, 0)
    nz, nx = scene.reach.shape
    inside = (row >= 0) & (row < nz) & (column >= 0) & (column < nx)
    row, column = row.clip(0, nz - 1), column.clip(0, nx - 1)
    standable, wall = (np.mean(inside & mask[row, column], axis=1) for mask in (scene.reach, scene.walls))
    seen_from = visible.sum(axis=0)
    return np.stack([standable, wall, seen_from / seen_from.max()]).astype(np.float32)
