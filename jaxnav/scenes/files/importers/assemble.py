"""Building blocks of the importers: scenes from standable points and objects, and polygons and walls on the lattice.

An importer describes objects as `SceneObject`s. Those that know standable points turn them to cells with
`lattice_cells`, and `build_scene_from_cells` lays out the arrays and derives the walls; importers that know the walls
call `build_scene`. The functions on polygons and walls find the cells of rooms and the pieces between doors.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, ParamSpec

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.account import IN_REFUSED_SCENE, ImportCount
from jaxnav.scenes.files.scene_file import SNAP_TOLERANCE, JsonRecord, derive_walls
from jaxnav.scenes.scene import CELL_SIZE, MAX_SIDE_CELLS, Room, Scene

Arguments = ParamSpec("Arguments")

#: Fields of a bounding box; see `read_bounding_box`.
BOX_FIELDS = frozenset({"center", "size", "min", "max"})

_MARGIN = 3  # cells around the standable ones; a cell beyond them is indistinguishable from a wall


class ImportNote(NamedTuple):
    """A remark about what an importer did to scenes, printed once after an import.

    Attributes:
      text: sentence without its first word, a number, such as `agents are moved to the nearest free cell`.
      number: number of scenes, objects or cells that the remark counts.
    """

    text: str
    number: int


class SceneObject(NamedTuple):
    """An object of a scene.

    Attributes:
      type: name of its type.
      box: centre x, y, z and full size sx, sy, sz in metres of its axis-aligned box.
      yaw: degrees.
      parent: index of the object that it rests on or in, or -1.
    """

    type: str
    box: Sequence[float]
    yaw: float = 0.0
    parent: int = -1


def scene_or_error(
    build: Callable[Arguments, Scene], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Scene | InputError:
    """Return the scene that a function builds, or the `InputError` that it raises."""
    try:
        return build(*args, **kwargs)
    except InputError as error:
        return error


def scene_and_count(
    build: Callable[..., Scene], *args: Any, unit: str = "objects"
) -> Iterator[Scene | InputError | ImportCount]:
    """Yield the scene that a function builds, or its error, and then the account of its objects.

    Args:
      build: function of `args` and an `ImportCount`, in which it counts what it reads and skips.
      args: the other arguments.
      unit: unit of the count.
    """
    import_count = ImportCount(unit)
    result = scene_or_error(build, *args, import_count)
    if isinstance(result, InputError):
        import_count.skip_all(IN_REFUSED_SCENE)
    yield result
    yield import_count


def read_bounding_box(box: JsonRecord) -> tuple[list[float], list[float]]:
    """Read centre and full size of a box, metres, from its `center` and `size` or from its corners `min` and `max`.

    Raises:
      InputError: a field is missing or is no number.
    """
    if not {"min", "max"} & set(box.fields):
        return box.get_record("center").get_numbers(), box.get_record("size").get_numbers()
    low_corner = np.array(box.get_record("min").get_numbers())
    high_corner = np.array(box.get_record("max").get_numbers())
    return ((low_corner + high_corner) / 2).tolist(), (high_corner - low_corner).tolist()


def lattice_cells(record: JsonRecord, field: str, points: Sequence[Sequence[float]]) -> np.ndarray:
    """Return the lattice indices of points.

    Args:
      record: the scene's record, for errors.
      field: name of the field that holds the points.
      points: (x, z) in metres.

    Returns:
      int [N, 2], (iz, ix).

    Raises:
      InputError: there is no point, one is not on the lattice, or they lie too far apart.
    """
    if not len(points):
        raise record.error(field, "contains no point to stand on; give at least one")

    # Index = metres / 0.25, to the nearest whole number, [N, 2].
    point_positions = np.asarray(points, np.float64)
    lattice_indices = np.rint(point_positions / CELL_SIZE).astype(np.int64)

    # A point off the lattice, or far away, is a mistake in the file.
    lattice_offsets = np.abs(point_positions - CELL_SIZE * lattice_indices).max(axis=1)
    if (lattice_offsets > SNAP_TOLERANCE).any():
        worst_point = point_positions[lattice_offsets.argmax()].tolist()
        expected = f"x and z must be multiples of {CELL_SIZE} (within {SNAP_TOLERANCE})"
        raise record.error(field, f"holds {worst_point}; {expected}")
    max_span = MAX_SIDE_CELLS - 2 * _MARGIN - 1  # the array has a margin on both sides
    if (np.ptp(lattice_indices, axis=0) > max_span).any():
        raise record.error(field, f"spans more than {max_span * CELL_SIZE:g} m; give one scene at a time")
    return lattice_indices[:, ::-1]


def check_lattice_spacing(record: JsonRecord, field: str, cells: np.ndarray) -> None:
    """Refuse positions of another lattice, such as one of 0.5 m, whose cells have no neighbours.

    Args:
      record: the scene's record, for errors.
      field: name of the field that holds the positions.
      cells: int [N, 2], lattice indices.

    Raises:
      InputError: most positions have no other one beside them; names the spacing that they seem to have.
    """
    from scipy import spatial  # slow to import, and not needed to show the help of a command

    distinct_cells = np.unique(cells, axis=0)
    if len(distinct_cells) < 2:
        return

    # Steps to the nearest other cell, in cells along the longer side: 1 for neighbours, diagonal ones too.
    nearest_distances, _ = spatial.KDTree(distinct_cells).query(distinct_cells, k=2, p=np.inf)
    spacing = float(np.median(nearest_distances[:, 1])) * CELL_SIZE
    if spacing > CELL_SIZE:
        problem = f"has positions that seem to be {spacing:g} m apart, but the agent moves by {CELL_SIZE} m"
        raise record.error(field, f"{problem}; give the positions of a grid of {CELL_SIZE} m (gridSize)")


def build_scene_from_cells(
    name: str, world: str, room_type: str, split: str, cells: np.ndarray, objects: Sequence[SceneObject]
) -> Scene:
    """Build a scene and derive its walls.

    Walls are the cells that can be neither standable nor furniture, see `derive_walls`.

    Args:
      name, world, room_type, split: see `Scene`.
      cells: int [N, 2], standable lattice indices (iz, ix), z = 0.25 iz and x = 0.25 ix.
      objects: the objects of the scene.
    """
    # Shift the indices so that the array begins a margin before the first cell.
    low_corner = cells.min(axis=0) - _MARGIN
    reach_mask = np.zeros(cells.max(axis=0) - low_corner + _MARGIN + 1, bool)
    reach_mask[tuple((cells - low_corner).T)] = True
    lattice_origin = (CELL_SIZE * float(low_corner[1]), CELL_SIZE * float(low_corner[0]))
    wall_mask = derive_walls(reach_mask, lattice_origin, object_boxes(objects))
    return build_scene(name, world, room_type, split, lattice_origin, reach_mask, wall_mask, objects)


def build_scene(
    name: str,
    world: str,
    room_type: str,
    split: str,
    origin: tuple[float, float],
    reach: np.ndarray,
    walls: np.ndarray,
    objects: Sequence[SceneObject],
    rooms: tuple[Room, ...] = (),
) -> Scene:
    """Build a scene of objects from its other attributes, see `Scene`."""
    return Scene(
        name=name,
        world=world,
        room_type=room_type,
        split=split,
        origin=origin,
        reach=reach,
        walls=walls,
        types=tuple(scene_object.type for scene_object in objects),
        boxes=object_boxes(objects),
        yaws=np.array([scene_object.yaw for scene_object in objects], np.float64),
        parents=np.array([scene_object.parent for scene_object in objects], np.int64),
        rooms=rooms,
    )


def object_boxes(objects: Sequence[SceneObject]) -> np.ndarray:
    """Return the boxes of objects, float64 [N, 6], centre and full size in metres."""
    return np.array([scene_object.box for scene_object in objects], np.float64).reshape(-1, 6)


# Polygons and walls on the lattice


def is_simple_polygon(corners: np.ndarray) -> bool:
    """Return True for a polygon, corners [P, 2] with P >= 3, that neither crosses nor touches itself."""
    edges = np.roll(corners, -1, axis=0) - corners
    next_edges = np.roll(edges, -1, axis=0)

    # An edge that turns back on the one before it.
    is_fold = (_cross_product(edges, next_edges) == 0) & ((edges * next_edges).sum(axis=1) <= 0)

    # Edge j straddles the line through edge i unless both of its ends are strictly on one side of this line.
    side_of_edge = np.sign(_cross_product(edges[:, None], corners - corners[:, None]))  # [P, P], of edge i, of corner j
    does_straddle = side_of_edge * np.roll(side_of_edge, -1, axis=1) <= 0

    # The bounding boxes of the edges decide where edges are on one line.
    edge_low = np.minimum(corners, corners + edges)
    edge_high = np.maximum(corners, corners + edges)
    boxes_overlap = ((edge_low[:, None] <= edge_high) & (edge_low <= edge_high[:, None])).all(axis=-1)

    # Neighbouring edges always share a corner.
    corner_index = np.arange(len(corners))
    index_distance = np.subtract.outer(corner_index, corner_index) % len(corners)
    are_neighbours = (index_distance <= 1) | (index_distance == len(corners) - 1)

    is_crossing = does_straddle & does_straddle.T & boxes_overlap & ~are_neighbours
    return not (is_fold.any() or is_crossing.any())


def points_in_polygon(corners: np.ndarray, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return which lattice points a polygon encloses, by the even-odd rule along the rows.

    A point on an edge that two polygons share is in exactly one of them: in the one beyond it in x, or else in z.

    Args:
      corners: float64 [P, 2], (x, z) in metres.
      x, z: float64 [nx] and [nz], ascending.

    Returns:
      bool [nz, nx].
    """
    start_x, start_z = corners.T
    end_x, end_z = np.roll(corners, -1, axis=0).T

    # Where edges cross the line through a row of points.
    row_indices, edge_indices = np.nonzero((start_z <= z[:, None]) != (end_z <= z[:, None]))
    edge_fraction = (z[row_indices] - start_z[edge_indices]) / (end_z - start_z)[edge_indices]
    crossing_x = start_x[edge_indices] + edge_fraction * (end_x - start_x)[edge_indices]

    # A point is inside after an odd number of crossings.
    crossing_counts = np.zeros((len(z), len(x) + 1), np.int64)
    np.add.at(crossing_counts, (row_indices, np.searchsorted(x, crossing_x)), 1)
    return crossing_counts.cumsum(axis=1)[:, :-1] % 2 == 1


def subtract_openings(wall_line: np.ndarray, openings: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the pieces of a wall between openings.

    Args:
      wall_line: float64 [2, 2], both ends (x, z) of the wall, along x or z, metres.
      openings: both ends of each, also of those in other walls.

    Returns:
      Low and high corner [2, 2] of each piece.
    """
    low_end = wall_line.min(axis=0)
    high_end = wall_line.max(axis=0)
    along_axis = int(np.argmax(high_end - low_end))
    across_axis = 1 - along_axis

    # The intervals of the openings in this wall.
    opening_spans: list[list[float]] = []
    for opening in openings:
        if np.abs(opening[:, across_axis] - low_end[across_axis]).max() <= SNAP_TOLERANCE:
            opening_spans.append(sorted(opening[:, along_axis]))

    # Each piece ends where an opening begins, the last one at the end of the wall.
    wall_pieces: list[np.ndarray] = []
    for span_start, span_end in [*sorted(opening_spans), (high_end[along_axis], high_end[along_axis])]:
        wall_piece = np.stack([low_end, high_end])
        wall_piece[1, along_axis] = min(span_start, high_end[along_axis])
        if wall_piece[0, along_axis] < wall_piece[1, along_axis]:
            wall_pieces.append(wall_piece)
        low_end[along_axis] = max(low_end[along_axis], span_end)
    return wall_pieces


def component_containing(free: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the 8-connected component of a cell, bool [nz, nx].

    Args:
      free: bool [nz, nx].
      start: int [2], (iz, ix), a cell of `free`.
    """
    from scipy import ndimage  # slow to import, and not needed to show the help of a command

    part_labels = np.zeros(free.shape, np.int32)
    ndimage.label(free, np.ones((3, 3)), output=part_labels)
    return part_labels == part_labels[tuple(start)]


def _cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
