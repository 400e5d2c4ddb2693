"""Sites: squares of the floor plan where objects may stand, as the planner sees them.

`find_sites` divides the floor plan of a scene into squares and records from which poses each can be seen, where the
detector reports categories, and how sites are related.

Symbols in shapes: N sites, P poses, K categories, C cells, M pairs of a pose and a site in view, L kinds of looks.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene, scene_extent
from jaxnav.scenes.tables.observation_row import MAX_RANGE, RowFormat, relative_position, turn_offsets
from jaxnav.scenes.tables.visibility import SIGHT_MARGIN, cell_centres, clear_of_walls
from jaxnav.scenes.task import Rules, Task

SITE_SPACING = 0.5  # metres between sites, and the width of a distance bin
NUM_DISTANCE_BINS = int(MAX_RANGE / SITE_SPACING) + 1
NEAR_DISTANCE, AROUND_DISTANCE = 1.0, 2.0  # greatest distances of related sites, metres
SAME_PLACE_OVERLAP = 0.25  # sites are in one place if at least this share of the cells that see either sees both
NUM_RELATIONS, NUM_SURROUNDINGS = 3, 3


class SiteViews(NamedTuple):
    """Pairs of a pose and a site in its horizontal field of view, in range and not hidden by walls.

    The kind of a look is horizon * `NUM_DISTANCE_BINS` + distance bin.

    Attributes:
      pose: int32 [M], ascending.
      site: int32 [M].
      look: int16 [M], kind of the look at the site from the pose.
      first_entry: int32 [P + 1], index of the first pair of each pose.
    """

    pose: np.ndarray
    site: np.ndarray
    look: np.ndarray
    first_entry: np.ndarray

    def from_pose(self, pose: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the sites in view from a pose, and the kinds of the looks at them."""
        entries = slice(self.first_entry[pose], self.first_entry[pose + 1])
        return self.site[entries], self.look[entries]


class Sites(NamedTuple):
    """The N sites of a scene.

    Attributes:
      views: the sites in view from each pose.
      detected_site: int16 [P, K], site at which a category is detected; -1 without a detection.
      object_sites: bool [K, N], True for the sites with an object of a category. Only the fit of the prior reads them.
      relations: bool [3, N, N], True for pairs within `NEAR_DISTANCE`, within `AROUND_DISTANCE`, and in one place.
      surroundings: float32 [3, N], in [0, 1]: standable share, wall share, and openness of each site.
    """

    views: SiteViews
    detected_site: np.ndarray
    object_sites: np.ndarray
    relations: np.ndarray
    surroundings: np.ndarray


def find_sites(scene: Scene, task: Task, rows: np.ndarray) -> Sites:
    """Find the sites of a scene, the squares that can be seen from a standable cell.

    Args:
      scene: the scene, whose walls hide sites.
      task: categories and rules.
      rows: uint8 [P, R], observation row of each pose.
    """
    rules = task.rules
    num_categories = len(task.categories)
    centres = cell_centres(scene, standable_cells(scene.reach))  # [C, 2]
    squares = _square_centres(scene)
    distance = np.linalg.norm(squares - centres[:, None], axis=-1)  # [C, N]

    # Lines of sight from cells to squares end before the centre of the square.
    cell, square = np.nonzero(distance <= MAX_RANGE)
    line = squares[square] - centres[cell]
    sight_share = np.maximum(1.0 - SIGHT_MARGIN / np.maximum(distance[cell, square], SIGHT_MARGIN), 0.0)
    line_end = centres[cell] + sight_share[:, None] * line
    clear = clear_of_walls(scene, centres[cell], line_end, centres[cell])
    visible = np.zeros(distance.shape, np.float32)
    visible[cell[clear], square[clear]] = 1.0

    # Sites are the squares that are visible from anywhere.
    is_site = visible.any(axis=0)
    visible = visible[:, is_site]
    positions = squares[is_site]
    distance = distance[:, is_site]
    nearest_site = KDTree(positions)

    # Objects belong to the site nearest to them.
    category = np.array(category_ids(scene.types, task.categories), int)
    has_category = category >= 0
    _, site = nearest_site.query(scene.boxes[has_category][:, [0, 2]])
    object_sites = np.zeros((num_categories, len(positions)), bool)
    object_sites[category[has_category], site] = True

    return Sites(
        views=_find_views(rules, centres, positions, visible > 0, distance),
        detected_site=_find_detected_sites(rules, centres, rows, num_categories, nearest_site),
        object_sites=object_sites,
        relations=_relate_sites(positions, visible),
        surroundings=_describe_surroundings(scene, positions, visible),
    )


def _square_centres(scene: Scene) -> np.ndarray:
    """Return the centres of the squares that cover a scene, float64 [N, 2]."""
    low, high = scene_extent(scene)
    x = np.arange(low[0] + SITE_SPACING / 2, high[0] + SITE_SPACING / 2, SITE_SPACING)
    z = np.arange(low[1] + SITE_SPACING / 2, high[1] + SITE_SPACING / 2, SITE_SPACING)
    return np.stack(np.meshgrid(x, z), axis=-1).reshape(-1, 2)


def _find_views(
    rules: Rules, centres: np.ndarray, positions: np.ndarray, visible: np.ndarray, distance: np.ndarray
) -> SiteViews:
    """Return the sites in view from each pose; `visible` and `distance` are [C, N]."""
    # Pairs of a cell and a site, and the headings whose field of view holds the site.
    cell, site = np.nonzero(visible)
    offset = positions[site] - centres[cell]
    directions = rules.heading_directions()
    ahead = offset @ directions.T
    right = offset @ np.stack([directions[:, 1], -directions[:, 0]])
    pair, heading = np.nonzero(np.abs(right) <= rules.half_view_tangents[0] * ahead)

    # Every horizon sees the same sites, but its looks count separately.
    horizon = np.arange(len(rules.horizons))[:, None]
    pose = rules.join_pose(cell[pair], heading, horizon)  # [T, pairs]
    distance_bin = (distance[cell, site][pair] / SITE_SPACING).astype(np.int16)
    look = distance_bin + (horizon * NUM_DISTANCE_BINS).astype(np.int16)
    pose_site = np.broadcast_to(site[pair], pose.shape)

    order = np.argsort(pose, axis=None, kind="stable")
    num_poses = len(centres) * rules.poses_per_cell
    views_per_pose = np.bincount(pose.ravel(), minlength=num_poses)
    return SiteViews(
        pose=pose.ravel()[order].astype(np.int32),
        site=pose_site.ravel()[order].astype(np.int32),
        look=look.ravel()[order],
        first_entry=np.concatenate([[0], np.cumsum(views_per_pose)]).astype(np.int32),
    )


def _find_detected_sites(
    rules: Rules, centres: np.ndarray, rows: np.ndarray, num_categories: int, nearest_site: KDTree
) -> np.ndarray:
    """Return the site at which each pose detects a category, int16 [P, K], -1 without a detection."""
    detections = RowFormat(num_categories).detections(rows)
    pose, category = np.nonzero(detections[..., 0])
    ahead, right = relative_position(detections[pose, category])

    # World positions of the detections.
    cell, heading, _ = rules.split_pose(pose)
    positions = centres[cell] + turn_offsets(ahead, right, rules.heading_directions()[heading])

    detected_site = np.full(detections.shape[:2], -1, np.int16)
    detected_site[pose, category] = nearest_site.query(positions)[1]
    return detected_site


def _relate_sites(positions: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the three relations of sites, bool [3, N, N], see `Sites`."""
    # Numbers of cells that see both sites of a pair, and either of them.
    num_both = visible.T @ visible
    num_each = visible.sum(axis=0)
    num_either = num_each + num_each[:, None] - num_both

    distance = np.linalg.norm(positions - positions[:, None], axis=-1)
    is_near = (distance <= NEAR_DISTANCE) & (num_both > 0)
    is_around = (distance <= AROUND_DISTANCE) & (num_both > 0)
    return np.stack([is_near, is_around, num_both / num_either >= SAME_PLACE_OVERLAP])


def _describe_surroundings(scene: Scene, positions: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the surroundings of each site, float32 [3, N], see `Sites`."""
    # The four cells around the centre of each site.
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * CELL_SIZE / 2
    cells = np.rint((positions[:, None] + corners - scene.origin) / CELL_SIZE).astype(int)
    column, row = np.moveaxis(cells, -1, 0)
    nz, nx = scene.reach.shape
    inside = (row >= 0) & (row < nz) & (column >= 0) & (column < nx)
    row = row.clip(0, nz - 1)
    column = column.clip(0, nx - 1)

    standable_share = np.mean(inside & scene.reach[row, column], axis=1)
    wall_share = np.mean(inside & scene.walls[row, column], axis=1)
    num_viewing_cells = visible.sum(axis=0)
    openness = num_viewing_cells / num_viewing_cells.max()
    return np.stack([standable_share, wall_share, openness]).astype(np.float32)
