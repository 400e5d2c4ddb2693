"""Visibility in a scene: the objects and the floor cells that are visible from every pose.

`find_sightings` pairs objects with the cells that have a clear line of sight to them, `detect_objects` turns sightings
into the detector's reports, and `ego_views` computes the views of the floor. The geometry follows: walls as rectangles,
intersections of segments and boxes, and offsets relative to the camera.

Symbols in shapes: C cells, H headings, T horizons, P = C H T poses, K categories, N objects, M pairs.
"""

import functools
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import CELL_SIZE, Scene
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, VIEW_UNKNOWN, detection_range, object_size
from jaxnav.scenes.task import Rules, Task

#: Distance from the target's centre at which a line of sight ends, metres.
SIGHT_MARGIN = 0.3
#: Depth to which a line of sight may touch a surface without being blocked, metres.
GRAZE = 1e-6
#: Metres added to limits, so that rounding errors do not decide.
TOLERANCE = 1e-9

# Bulky furniture on the floor is opaque.
_MIN_OPAQUE_THICKNESS = 0.3  # metres
_MAX_OPAQUE_BOTTOM = 0.3  # height of the underside, metres
_MIN_OPAQUE_TOP = 0.85  # height of the top, metres


class Targets(NamedTuple):
    """The N objects of a scene that belong to a category.

    Attributes:
      objects: int [N], indices of the objects in the scene.
      category: int [N].
      distance: float64 [C, N], horizontal metres from each cell to the object's centre.
    """

    objects: np.ndarray
    category: np.ndarray
    distance: np.ndarray


class Sightings(NamedTuple):
    """The M pairs of a cell and an object with a clear line of sight between them.

    Pairs are sorted by falling distance: the nearest object comes last, and equally near objects in reverse order.

    Attributes:
      cell: int [M].
      category: int [M], category of the object.
      distance: float64 [M], horizontal metres from the cell to the object's centre.
      size: float64 [M], size of the object, metres, see `object_size`.
      ahead: float64 [M, H], metres ahead to the object's centre, by heading.
      right: float64 [M, H], metres to the right, by heading.
      in_view: bool [M, H, T], True where the object is in the camera's view, by heading and horizon.
    """

    cell: np.ndarray
    category: np.ndarray
    distance: np.ndarray
    size: np.ndarray
    ahead: np.ndarray
    right: np.ndarray
    in_view: np.ndarray

    def expand(self, is_selected: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the poses at which selected pairs are in view.

        Args:
          is_selected: bool [M], True for the selected pairs.

        Returns:
          Pair, heading and pose, int [...] each, in the order of the pairs.
        """
        _, num_headings, num_horizons = self.in_view.shape
        pair, heading, horizon = np.nonzero(self.in_view & is_selected[:, None, None])
        return pair, heading, (self.cell[pair] * num_headings + heading) * num_horizons + horizon

    def visible_within(self, max_distance: float, table_shape: tuple[int, int]) -> np.ndarray:
        """Return True where a category is in view within a distance.

        Args:
          max_distance: horizontal metres.
          table_shape: numbers of poses and categories, (P, K).

        Returns:
          bool [P, K].
        """
        pair, _, pose = self.expand(self.distance <= max_distance + TOLERANCE)
        is_visible = np.zeros(table_shape, bool)
        is_visible[pose, self.category[pair]] = True
        return is_visible


def find_sightings(scene: Scene, rules: Rules, centres: np.ndarray, targets: Targets, limits: np.ndarray) -> Sightings:
    """Find the cells with a clear line of sight to each object.

    Args:
      scene: the scene, whose walls and opaque boxes block the sight.
      rules: camera, headings and horizons.
      centres: float64 [C, 2], world (x, z) of the cells.
      targets: the objects.
      limits: float [N], greatest distance at which each object counts, metres.
    """
    # Pairs within the limits, and with a clear line.
    size = object_size(scene.boxes[targets.objects])
    cell, target = np.nonzero(targets.distance <= limits + TOLERANCE)
    is_clear = line_of_sight(scene, rules, centres[cell], targets.objects[target])
    cell = cell[is_clear]
    target = target[is_clear]

    # Sort by falling distance, so that the nearest object comes last.
    order = np.lexsort((-target, -targets.distance[cell, target]))
    cell = cell[order]
    target = target[order]

    # Offsets and field of view at every heading and horizon.
    ahead, right, in_view = offsets_in_view(rules, centres[cell], scene.boxes[targets.objects[target], :3])
    return Sightings(
        cell=cell,
        category=targets.category[target],
        distance=targets.distance[cell, target],
        size=size[target],
        ahead=ahead,
        right=right,
        in_view=in_view,
    )


def detect_objects(
    scene: Scene, task: Task, sightings: Sightings, num_poses: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the detections at every pose, and the instance counts if the task has them.

    Returns:
      Detections uint8 [P, K, 4], see `Detector.detect`, and counts uint8 [P, K], see `Detector.count`, or None.
    """
    # Categories with an object within its detection range, [P, K].
    table_shape = (num_poses, len(task.categories))
    is_in_range = sightings.distance <= detection_range(sightings.size) + TOLERANCE
    pair, heading, pose = sightings.expand(is_in_range)
    category = sightings.category[pair]
    visible = np.zeros(table_shape, bool)
    visible[pose, category] = True

    # The nearest of several objects of a category counts: assignments to equal indices keep the last value.
    offsets = (sightings.ahead[pair, heading], sightings.right[pair, heading])
    nearest = np.zeros((4, *table_shape))
    nearest[:, pose, category] = np.stack([*offsets, sightings.distance[pair], sightings.size[pair]])
    detections = task.detector.detect(scene.name, task.rules.half_view_tangents[0], visible, *nearest)
    if not task.instance_counts:
        return detections, None

    # Instances behind the nearest one of their category: all entries but the last one of each pose and category.
    last_entry = np.zeros(table_shape, np.int64)
    last_entry[pose, category] = np.arange(len(pose))
    is_further = last_entry[pose, category] != np.arange(len(pose))
    further_pair = pair[is_further]
    counts = task.detector.count(
        scene.name,
        detections[..., 0] > 0,
        pose[is_further],
        category[is_further],
        sightings.distance[further_pair],
        sightings.size[further_pair],
    )
    return detections, counts


def ego_views(scene: Scene, rules: Rules, cells: np.ndarray, view: int) -> np.ndarray:
    """Return the ego-centric view of every pose.

    Args:
      scene: the scene, whose walls and tall opaque boxes hide cells.
      rules: headings, horizons and camera.
      cells: int [C, 2], the standable cells (iz, ix).
      view: V, cells along each side of a view.

    Returns:
      uint8 [P, V, V]: `VIEW_UNKNOWN`, `VIEW_FREE` for standable cells, or `VIEW_BLOCKED`.
    """
    # Displacements (dz, dx) of all cells in the view cone, once for all headings.
    ahead = np.arange(view)
    right = np.arange(view) - view // 2
    in_cone = np.abs(right) <= rules.half_view_tangents[0] * ahead[:, None]  # [V, V], with the cell of the agent
    cone_offsets = rules.view_offsets(view)[:, in_cone].reshape(-1, 2)
    offsets, offset_index = np.unique(cone_offsets, axis=0, return_inverse=True)  # [O, 2]

    # State of the cell at each displacement from each standable cell, [C, O].
    radius = int(np.abs(offsets).max())
    is_standable = np.zeros(np.add(scene.reach.shape, 2 * radius), bool)
    is_standable[tuple((cells + radius).T)] = True
    viewed_cells = cells[:, None] + radius + offsets  # [C, O, 2]
    cell_states = np.where(is_standable[viewed_cells[..., 0], viewed_cells[..., 1]], VIEW_FREE, VIEW_BLOCKED)
    is_visible = _floor_in_sight(scene, rules, cells, offsets)
    cell_states = np.where(is_visible, cell_states, VIEW_UNKNOWN).astype(np.uint8)

    # Gather the views by heading; they do not depend on the horizon.
    views = np.full((len(cells), rules.headings, view, view), VIEW_UNKNOWN, np.uint8)
    views[:, :, in_cone] = cell_states[:, offset_index.reshape(rules.headings, -1)]
    return np.repeat(views.reshape(-1, view, view), len(rules.horizons), axis=0)


def _floor_in_sight(scene: Scene, rules: Rules, cells: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return True for the visible floor cells around each cell.

    Walls and opaque boxes at least as high as the camera hide the cells behind them.

    Args:
      scene: the scene.
      rules: the camera's height.
      cells: int [C, 2], the cells (iz, ix) of the camera.
      offsets: int [O, 2], displacements (dz, dx) of the floor cells.

    Returns:
      bool [C, O].
    """
    radius = int(np.abs(offsets).max())
    is_clear = ~np.pad(scene.walls | _tall_box_cells(scene, rules), radius)

    # On the flattened lattice a displacement is the same shift for all cells.
    stride = is_clear.shape[1]
    flat_clear = is_clear.ravel()
    margin = radius * (stride + 1)
    num_shifted = flat_clear.size - 2 * margin
    cell_index = (cells + radius) @ (stride, 1) - margin

    # A floor cell is visible if all cells on the line to it are clear.
    in_sight = np.ones((len(offsets), len(cells)), bool)
    lattice_in_sight = np.empty(num_shifted, bool)
    for cells_in_sight, offset in zip(in_sight, offsets.tolist(), strict=True):
        lattice_in_sight[:] = True
        for dz, dx in _cells_between(*offset, radius):
            shift = margin + dz * stride + dx
            lattice_in_sight &= flat_clear[shift : shift + num_shifted]
        cells_in_sight[:] = lattice_in_sight[cell_index]
    return in_sight.T


def _tall_box_cells(scene: Scene, rules: Rules) -> np.ndarray:
    """Return True for the cells under opaque boxes as high as the camera, bool [nz, nx]."""
    # Footprints of the opaque boxes at least as high as the camera.
    x, y, z, size_x, size_y, size_z = scene.boxes[is_opaque(scene.boxes)].T
    is_tall = y + size_y / 2 >= rules.camera - TOLERANCE
    box_centres = np.stack([x, z], axis=-1)[is_tall]
    half_sizes = np.stack([size_x, size_z], axis=-1)[is_tall] / 2

    # Cells whose centre lies in a footprint, [cells, N].
    centres = cell_centres(scene, np.argwhere(np.ones_like(scene.walls)))
    centre_offsets = np.abs(centres[:, None] - box_centres)  # [cells, N, 2]
    is_under_box = (centre_offsets <= half_sizes + TOLERANCE).all(axis=-1)
    return np.any(is_under_box, axis=-1).reshape(scene.walls.shape)


@functools.lru_cache(maxsize=4096)
def _cells_between(dz: int, dx: int, radius: int) -> list[tuple[int, int]]:
    """Return the cells strictly between (0, 0) and (dz, dx)."""
    # Points at half-cell steps along the longest line, rounded to cells.
    half_steps = np.arange(1, 2 * radius)
    # Rounding is symmetric about 0, so that a mirrored room has a mirrored view.
    z = np.rint(dz * half_steps / (2 * radius)).astype(int).tolist()
    x = np.rint(dx * half_steps / (2 * radius)).astype(int).tolist()
    crossed_cells = set(zip(z, x, strict=True))
    return sorted(crossed_cells - {(0, 0), (dz, dx)})


def cell_centres(scene: Scene, cells: np.ndarray) -> np.ndarray:
    """Return the centres of cells.

    Args:
      scene: the scene.
      cells: int [C, 2], (iz, ix).

    Returns:
      float64 [C, 2], world (x, z), metres.
    """
    return np.asarray(scene.origin) + CELL_SIZE * cells[:, ::-1]


def is_opaque(boxes: np.ndarray) -> np.ndarray:
    """Return True for the boxes [N, 6] that block the sight, bulky furniture on the floor, bool [N]."""
    # A box is opaque if all its margins are at least 0.
    _, y, _, size_x, size_y, size_z = boxes.T
    thickness_margin = np.minimum(size_x, size_z) - _MIN_OPAQUE_THICKNESS
    bottom_margin = _MAX_OPAQUE_BOTTOM - (y - size_y / 2)
    top_margin = y + size_y / 2 - _MIN_OPAQUE_TOP
    return np.minimum(np.minimum(thickness_margin, bottom_margin), top_margin) >= -TOLERANCE


def cover_with_rectangles(mask: np.ndarray) -> np.ndarray:
    """Cover a mask [nz, nx] with disjoint rectangles.

    Returns:
      int [R, 4], z0, x0, z1, x1 of each rectangle; z1 and x1 are exclusive.
    """
    # Runs (x0, x1) of True cells in the current row, with the first row of each.
    open_runs: dict[tuple[int, int], int] = {}
    rectangles = []
    row_edges = np.diff(np.pad(mask, ((0, 1), (1, 1))).astype(np.int8), axis=1)
    for z, edges in enumerate(row_edges):
        run_starts = np.flatnonzero(edges == 1).tolist()
        run_ends = np.flatnonzero(edges == -1).tolist()
        runs = list(zip(run_starts, run_ends, strict=True))

        # A run that ends or changes in this row closes its rectangle.
        for (x0, x1), z0 in open_runs.items():
            if (x0, x1) not in runs:
                rectangles.append((z0, x0, z, x1))
        open_runs = {run: open_runs.get(run, z) for run in runs}
    return np.array(rectangles, int).reshape(-1, 4)


def wall_boxes(scene: Scene, walls: np.ndarray) -> np.ndarray:
    """Return boxes that cover wall cells [nz, nx] of a scene, float64 [R, 2, 2], low and high corner (x, z)."""
    map_corner = np.asarray(scene.origin) - CELL_SIZE / 2
    return map_corner + CELL_SIZE * cover_with_rectangles(walls)[:, [[1, 0], [3, 2]]]


def clear_of_walls(scene: Scene, start: np.ndarray, end: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return True for segments that cross no wall cell.

    Args:
      scene: the scene.
      start: float64 [M, 2], world (x, z).
      end: float64 [M, 2], world (x, z).
      target: float64 [M, 2], world (x, z); wall cells that contain `start` or `target` are exempt and do not count.

    Returns:
      bool [M].
    """
    # Segments are grouped by their exempt wall cells; most segments have none.
    exempt = np.concatenate([_wall_cells_at(scene, start), _wall_cells_at(scene, target)], axis=1)
    has_exempt = (exempt >= 0).any(axis=1)
    segment_groups: list[tuple[np.ndarray, np.ndarray]] = [(np.flatnonzero(~has_exempt), np.zeros(0, int))]
    if has_exempt.any():
        exempt_sets, set_index = np.unique(np.sort(exempt[has_exempt], axis=1), axis=0, return_inverse=True)
        segments = np.flatnonzero(has_exempt)
        for index, exempt_cells in enumerate(exempt_sets):
            segment_groups.append((segments[set_index.ravel() == index], exempt_cells[exempt_cells >= 0]))

    # Test each group against the rectangles of the walls without its exempt cells.
    is_clear = np.ones(len(start), bool)
    for segments, exempt_cells in segment_groups:
        walls = scene.walls.copy()
        walls.flat[exempt_cells] = False
        is_clear[segments] = ~_enters_any_box(start[segments], end[segments], wall_boxes(scene, walls))
    return is_clear


def _wall_cells_at(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Return the wall cells that contain points [M, 2].

    Returns:
      int [M, 4], flat indices of up to four cells for each point, padded with -1.
    """
    # A point on the border of cells belongs to all of them.
    cell_position = (points - scene.origin) / CELL_SIZE
    graze = GRAZE / CELL_SIZE
    corners = np.rint([cell_position - graze, cell_position + graze]).astype(int)
    columns, rows = np.moveaxis(corners, -1, 0)  # [2, M] each
    row_index, column_index = np.stack([rows[[0, 0, 1, 1]], columns[[0, 1, 0, 1]]]).swapaxes(1, 2)  # [M, 4] each

    # Cells outside the lattice are no walls.
    num_rows, num_columns = scene.walls.shape
    is_inside = (row_index >= 0) & (row_index < num_rows) & (column_index >= 0) & (column_index < num_columns)
    cell = np.where(is_inside, row_index * num_columns + column_index, 0)
    return np.where(is_inside & scene.walls.flat[cell], cell, -1)


def _enters_any_box(start: np.ndarray, end: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return True for segments [M, D] that enter a box [R, 2, D] shrunk by `GRAZE`, bool [M]."""
    # Test all unblocked segments against one box at a time.
    direction = end - start
    segment_low = np.minimum(start, end)
    segment_high = np.maximum(start, end)
    is_blocked = np.zeros(len(start), bool)
    for low, high in zip(boxes[:, 0] + GRAZE, boxes[:, 1] - GRAZE, strict=True):
        # Only segments whose bounding box overlaps the box need the exact test.
        boxes_overlap = (segment_low < high).all(axis=1) & (segment_high > low).all(axis=1)
        candidate_segments = np.flatnonzero(~is_blocked & boxes_overlap)
        is_blocked[candidate_segments] = _enters_box(
            start[candidate_segments], direction[candidate_segments], low, high
        )
    return is_blocked


def _enters_box(start: np.ndarray, direction: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return True for segments that enter an open box, bool [M].

    The segments are start + t direction [M, D], 0 <= t <= 1; the box is (low, high) [D].
    """
    # Slab test: the segment is inside all slabs between the last entry and the first exit.
    is_moving = direction != 0.0
    slope = np.where(is_moving, direction, 1.0)
    t_low = (low - start) / slope
    t_high = (high - start) / slope
    entry_time = np.where(is_moving, np.minimum(t_low, t_high), 0.0).max(axis=1, initial=0.0)
    exit_time = np.where(is_moving, np.maximum(t_low, t_high), 1.0).min(axis=1, initial=1.0)

    # Along an axis without motion the segment must lie in the slab.
    in_slabs = (is_moving | ((low < start) & (start < high))).all(axis=1)
    return in_slabs & (entry_time < exit_time)


def line_of_sight(scene: Scene, rules: Rules, cameras: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return True for cameras with a clear line of sight to their target object.

    Args:
      scene: the scene, whose walls and opaque boxes block the sight.
      rules: the camera's height.
      cameras: float64 [M, 2], world (x, z).
      targets: int [M], indices of the target objects.

    Returns:
      bool [M].
    """
    # The line ends `SIGHT_MARGIN` before the target's centre.
    start = np.insert(cameras, 1, rules.camera, axis=1)  # [M, (x, y, z)]
    centres = scene.boxes[targets, :3]
    sight_line = centres - start
    line_length = np.linalg.norm(sight_line, axis=-1, keepdims=True)
    end = start + sight_line * np.maximum(1.0 - SIGHT_MARGIN / np.maximum(line_length, SIGHT_MARGIN), 0.0)

    # Walls hide the target.
    is_clear = clear_of_walls(scene, cameras, end[:, [0, 2]], centres[:, [0, 2]])

    # Opaque boxes between camera and target hide it, too.
    floor_low = np.minimum(cameras, end[:, [0, 2]])
    floor_high = np.maximum(cameras, end[:, [0, 2]])
    for blocker in np.flatnonzero(is_opaque(scene.boxes)):
        box_centre = scene.boxes[blocker, :3]
        half_size = scene.boxes[blocker, 3:] / 2
        low = box_centre - half_size
        high = box_centre + half_size

        # Only segments whose bounding box overlaps the box on the floor need the exact test.
        boxes_overlap = (floor_low < high[[0, 2]]).all(axis=1) & (floor_high > low[[0, 2]]).all(axis=1)
        near_segments = np.flatnonzero(is_clear & boxes_overlap)

        # A box hides neither itself nor an object inside it, and does not blind a camera inside it.
        contains_target = (np.abs(centres[near_segments] - box_centre) <= half_size + GRAZE).all(axis=1)
        is_target = targets[near_segments] == blocker
        floor_distance = np.abs(cameras[near_segments] - box_centre[[0, 2]])
        contains_camera = (floor_distance <= half_size[[0, 2]] + GRAZE).all(axis=1)
        near_segments = near_segments[~(contains_target | is_target | contains_camera)]
        is_clear[near_segments] = ~_enters_box(
            start[near_segments], end[near_segments] - start[near_segments], low + GRAZE, high - GRAZE
        )
    return is_clear


def offsets_in_view(rules: Rules, cameras: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the offsets of points from cameras, and the views that show the points.

    Args:
      rules: headings, horizons and camera.
      cameras: float64 [M, 2], world (x, z).
      points: float64 [M, 3], world (x, y, z).

    Returns:
      Metres ahead and metres to the right, float64 [M, H] each, by heading; and True where a point is in view, bool
      [M, H, T], by heading and horizon.
    """
    # Offsets on the floor, by heading.
    directions = rules.heading_directions()  # [H, 2]
    offsets = points[:, [0, 2]] - cameras
    ahead = offsets @ directions.T
    right = offsets @ np.stack([directions[:, 1], -directions[:, 0]])

    # Pitch the camera: depth along its axis, rise across it, [M, H, T].
    height_offset = (points[:, 1] - rules.camera)[:, None, None]
    pitch = np.deg2rad(rules.horizons)
    depth = ahead[..., None] * np.cos(pitch) - height_offset * np.sin(pitch)
    vertical_offset = ahead[..., None] * np.sin(pitch) + height_offset * np.cos(pitch)

    # A point is in view if it lies in front of the camera, within both fields of view.
    tan_horizontal, tan_vertical = rules.half_view_tangents
    is_in_width = np.abs(right)[..., None] <= tan_horizontal * depth
    is_in_height = np.abs(vertical_offset) <= tan_vertical * depth
    return ahead, right, (depth > 0) & is_in_width & is_in_height
