"""Semantic floor maps: points, boxes, thin walls and damage."""

import bz2
import collections
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.semantic_maps import CHAIR, l_shaped_floor, write_maps
from support.scene_geometry import points_of

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.habitat import build_scene_from_map, parse_floor_map, read_floor_maps
from jaxnav.scenes.files.scene_file import derive_walls
from jaxnav.scenes.lattice import connected_parts, standable_cells
from jaxnav.scenes.scene import Scene


def scene_of(tmp_path: Path, floor: dict) -> Scene:
    record = read_floor_maps(write_maps(tmp_path / "maps.pbz2", {"Home": {0: floor}}))["Home"][0]
    return build_scene_from_map(record, "Home_floor0", "val", parse_floor_map(record))


@pytest.mark.parametrize(
    ("origin", "block", "points"),
    [
        # Pixels 8-12 and 13-17: x from 2.40 to 2.65 m, z from -0.35 to -0.10 m. Their middles are from 2.425 to 2.625
        # and from -0.325 to -0.125 m, and those at 2.625 and -0.125 are nearer to no point: they count above.
        ((-100, 200), (slice(8, 13), slice(13, 18)), {(2.5, 0.25)}),  # 4 x 4 pixels here
        ((-100, 200), (slice(7, 10), slice(12, 15)), {(2.5, 0.25)}),  # 3 x 3
        ((-100, 200), (slice(7, 9), slice(12, 16)), {(2.5, 0.25)}),  # 2 x 4
        ((-100, 200), (slice(7, 8), slice(9, 20)), set()),  # 11 pixels of a line, at most 5 in a cell
        ((-98, 203), (slice(7, 9), slice(12, 16)), {(2.5, 0.25)}),  # x 2.38 to 2.48 and z -0.38 to -0.18 m
        ((-103, 203), (slice(7, 9), slice(13, 16)), set()),  # 2 x 3
    ],
)
def test_eight_of_the_pixels_around_a_point_make_it_standable(tmp_path, origin, block, points):
    floor = l_shaped_floor(origin=np.array(origin))
    floor["sem_map"][0] = 0
    floor["sem_map"][0][block] = 1
    try:
        scene = scene_of(tmp_path, floor)
    except InputError as error:
        assert "floor 0: sem_map has no cell with 8 pixels of layer 0" in str(error)  # noqa: PT017  (it may succeed)
        assert not points
    else:
        assert points_of(scene, scene.reach) == points


def counted_points(floor: dict) -> set[tuple[float, float]]:
    """Return the standable points, pixel by pixel, in half centimetres."""
    counts = collections.Counter()
    for i, j in np.argwhere(floor["sem_map"][0]).tolist():
        middles = (2 * floor["origin"][k] + 10 * pixel + 5 for k, pixel in ((1, i), (0, j)))
        counts[tuple(math.floor(middle / 50 + 0.5) for middle in middles)] += 1
    return {(0.25 * x, -0.25 * z) for (x, z), count in counts.items() if count >= 8}


def test_l_shaped_floor_with_a_chair(tmp_path):
    floor = l_shaped_floor()
    scene = scene_of(tmp_path, floor)
    points = points_of(scene, scene.reach)
    assert points == counted_points(floor)
    # The floor ends at x = 2 m, where a cell has two columns of its pixels, and at 5 m, where it has three.
    assert {(2.0, 0.0), (5.0, 0.0)} <= points
    assert not {(1.75, 0.0), (5.25, 0.0)} & points
    # Around the chair pixels 36-53 and 0-17 are x 3.80 to 4.70 m and z -1.00 to -0.10 m.
    assert not {(x, z) for x in (4.0, 4.25, 4.5) for z in (1.0, 0.75, 0.5, 0.25)} & points
    assert len(standable_cells(scene.reach)) == len(points)
    # Chair: pixels 40-49 and 4-13, so x 4.00 to 4.50 and Habitat's z -0.80 to -0.30 m; a chair is 0.95 m high.
    assert (scene.world, scene.room_type, scene.types) == ("gibson", "house", ("Chair",))
    np.testing.assert_allclose(scene.boxes, [[4.25, 0.48, 0.55, 0.5, 0.95, 0.5]], atol=1e-12)
    assert not (scene.walls & scene.reach).any()


def rooms_parted_by(strip: slice, door: slice) -> dict:
    """Return a floor of two parts with a door.

    The parts are 4 x 4 m in all, and divided at the pixels `strip` of x but for the pixels `door` of z.
    """
    layers = np.zeros((16, 80, 80), np.uint8)
    layers[0] = 1
    layers[0, strip] = 0
    layers[0, strip, door] = 1
    layers[CHAIR, 2:8, 2:8] = 1
    layers[0, 2:8, 2:8] = 0
    return {"floor_height": 0.0, "sem_map": layers, "origin": np.array([0, 0])}


def inner_walls(scene: Scene) -> np.ndarray:
    """Return the walls without those far from everything."""
    return scene.walls & ~derive_walls(scene.reach, scene.origin, scene.boxes)


def test_a_long_thin_strip_between_floors_is_a_wall(tmp_path):
    # Pixels 36-45 are x 1.80 to 2.30 m, their middle pixel 2.00 to 2.05 m: cells at x = 2.00, index 8 + 3 of margin.
    scene = scene_of(tmp_path, rooms_parted_by(slice(36, 46), slice(30, 45)))
    walls = np.argwhere(inner_walls(scene))
    assert set(walls[:, 1].tolist()) == {11}
    # The door is at Habitat's z 1.50 to 2.25 m: two rows of pixels of the cell at 1.50 m and three of that at 2.25 m.
    z = [-(scene.origin[1] + 0.25 * iz) for iz in walls[::-1, 0].tolist()]
    assert z == [*np.arange(0, 1.5, 0.25), *np.arange(2.5, 4.25, 0.25)]


@pytest.mark.parametrize("start", range(30, 35))
@pytest.mark.parametrize("width", range(4, 13))
def test_walls_part_the_floor_wherever_they_lie_on_the_lattice(tmp_path, start, width):
    strip = slice(start, start + width)
    scene = scene_of(tmp_path, rooms_parted_by(strip, slice(0, 0)))
    assert len(connected_parts(scene.reach)) == 2
    assert min(map(len, connected_parts(scene.reach))) >= 80  # at least 6 of 17 columns of 16 rows, less the chair
    # A door of two cells joins them.
    assert len(connected_parts(scene_of(tmp_path, rooms_parted_by(strip, slice(30, 40))).reach)) == 1


@pytest.mark.parametrize(("door", "parts"), [(slice(31, 34), 1), (slice(30, 32), 1), (slice(31, 32), 2)])
def test_narrow_doors_stay_open(tmp_path, door, parts):
    # Pixels 31-33 are z 1.55 to 1.70 m, with no multiple of 0.25 m; two of them are in the cell at 1.75 m.
    scene = scene_of(tmp_path, rooms_parted_by(slice(36, 46), door))
    assert len(connected_parts(scene.reach)) == parts


@pytest.mark.parametrize(
    ("strip", "door"),
    [
        (slice(30, 48), slice(30, 45)),  # 0.9 m wide: may be furniture
        (slice(36, 46), slice(12, 80)),  # 0.6 m long
        (slice(36, 38), slice(30, 45)),  # 0.1 m: no obstacle leaves so little
    ],
)
def test_wide_short_or_narrow_strips_are_no_walls(tmp_path, strip, door):
    assert not inner_walls(scene_of(tmp_path, rooms_parted_by(strip, door))).any()


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"floor_height": np.float64("nan")}, "floor_height is no finite number"),
        ({"floor_height": 10**5000}, "floor_height is no finite number"),
        ({"origin": [0, 0]}, "origin is no array"),
        ({"origin": np.array([0.0, np.inf])}, "origin is no array"),
        ({"origin": np.array([0, -(2**63)])}, "origin is no array"),
        ({"sem_map": np.zeros((15, 4, 4))}, r"sem_map is no array \[16, H, W\]"),
        ({"sem_map": np.zeros((16, 2001, 1))}, r"sem_map is no array \[16, H, W\]"),
        ({"sem_map": np.zeros((16, 0, 4))}, r"sem_map is no array \[16, H, W\]"),
        ({"sem_map": np.full((16, 4, 4), np.nan)}, "sem_map holds other values"),
        ({"sem_map": np.full((16, 4, 4), 2)}, "sem_map holds other values"),
        ({"sem_map": np.zeros((16, 40, 40))}, "sem_map has no cell with 8 pixels"),
        ({"sem_map": np.pad(np.ones((1, 40, 40)), ((0, 15), (0, 0), (0, 0)))}, "sem_map has no object"),
    ],
)
def test_bad_floors_are_refused(tmp_path, changes, problem):
    with pytest.raises(InputError, match=r"maps\.pbz2, scene 'Home': floor 0: " + problem):
        scene_of(tmp_path, l_shaped_floor(**changes))


FLOOR = {
    "floor_height": 0.5,
    "sem_map": np.eye(16, 100, dtype=np.uint8).reshape(16, 10, 10),
    "origin": np.zeros(2, int),
}
PICKLES = [pickle.dumps({"Home": {0: FLOOR}}, protocol) for protocol in (3, 4, 5)]


@given(st.sampled_from(PICKLES), st.data())
def test_mutated_pickles_never_raise_another_error(tmp_path_factory, whole, data):
    places = st.integers(0, 200) | st.integers(0, len(whole) - 1)  # most of what is not the layers stands in front
    mutated = bytearray(whole)
    for place in data.draw(st.lists(places, min_size=1, max_size=3)):
        mutated[place] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "mutated.pbz2"
    path.write_bytes(
        bz2.compress(mutated[: data.draw(st.integers(100, len(whole)))] if data.draw(st.booleans()) else mutated)
    )
    try:
        for floors in read_floor_maps(path).values():
            for record in floors.values():
                assert isinstance(build_scene_from_map(record, "Home", "val", parse_floor_map(record)), Scene)
    except InputError as error:
        assert str(error).startswith(str(path))  # noqa: PT017  (reading may also succeed)
