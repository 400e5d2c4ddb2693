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
from support.refusals import assert_message_names
from support.scene_geometry import block, points_of

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.habitat import build_scene_from_map, parse_floor_map, read_floor_maps
from jaxnav.scenes.files.scene_file import derive_walls
from jaxnav.scenes.lattice import connected_parts, standable_cells
from jaxnav.scenes.scene import Scene


def scene_from_map(tmp_path: Path, floor: dict) -> Scene:
    """Return the scene of a floor map, written to a file and read back."""
    record = read_floor_maps(write_maps(tmp_path / "maps.pbz2", {"Home": {0: floor}}))["Home"][0]
    return build_scene_from_map(record, "Home_floor0", "val", parse_floor_map(record))


@pytest.mark.parametrize(
    ("origin", "free_pixels", "expected_points"),
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
def test_point_with_eight_free_pixels_is_standable(tmp_path, origin, free_pixels, expected_points):
    floor = l_shaped_floor(origin=np.array(origin))
    floor["sem_map"][0] = 0
    floor["sem_map"][0][free_pixels] = 1
    if expected_points:
        scene = scene_from_map(tmp_path, floor)
        assert points_of(scene, scene.reach) == expected_points
    else:
        with pytest.raises(InputError, match=r"floor 0: sem_map .*8 pixels of layer 0"):
            scene_from_map(tmp_path, floor)


def count_standable_points(floor: dict) -> set[tuple[float, float]]:
    """Return the standable points (x, z), counted pixel by pixel in half centimetres."""
    pixel_counts = collections.Counter()
    origin_z, origin_x = floor["origin"]
    for pixel_x, pixel_z in np.argwhere(floor["sem_map"][0]).tolist():
        middle_x = 2 * origin_x + 10 * pixel_x + 5
        middle_z = 2 * origin_z + 10 * pixel_z + 5
        pixel_counts[math.floor(middle_x / 50 + 0.5), math.floor(middle_z / 50 + 0.5)] += 1
    return {(0.25 * x, -0.25 * z) for (x, z), count in pixel_counts.items() if count >= 8}


def test_semantic_map_of_an_l_shaped_floor_with_a_chair(tmp_path):
    floor = l_shaped_floor()
    scene = scene_from_map(tmp_path, floor)
    standable_points = points_of(scene, scene.reach)
    assert standable_points == count_standable_points(floor)

    # The floor ends at x = 2 m, where a cell has two columns of its pixels, and at 5 m, where it has three.
    assert {(2.0, 0.0), (5.0, 0.0)} <= standable_points
    assert not {(1.75, 0.0), (5.25, 0.0)} & standable_points

    # Around the chair pixels 36-53 and 0-17 are x 3.80 to 4.70 m and z -1.00 to -0.10 m.
    assert not block(4.0, 4.5, 0.25, 1.0) & standable_points
    assert len(standable_cells(scene.reach)) == len(standable_points)

    # Chair: pixels 40-49 and 4-13, so x 4.00 to 4.50 and Habitat's z -0.80 to -0.30 m; a chair is 0.95 m high.
    assert (scene.world, scene.room_type, scene.types) == ("gibson", "house", ("Chair",))
    np.testing.assert_allclose(scene.boxes, [[4.25, 0.48, 0.55, 0.5, 0.95, 0.5]], atol=1e-12)
    assert not (scene.walls & scene.reach).any()


def two_part_floor(wall_pixels: slice, door_pixels: slice) -> dict:
    """Return a floor map of 80 x 80 pixels, 4 x 4 m, in two parts with a door.

    The parts are divided at the pixels `strip` of x except for the pixels `door` of z.
    """
    map_layers = np.zeros((16, 80, 80), np.uint8)
    map_layers[0] = 1
    map_layers[0, wall_pixels] = 0
    map_layers[0, wall_pixels, door_pixels] = 1
    map_layers[CHAIR, 2:8, 2:8] = 1
    map_layers[0, 2:8, 2:8] = 0
    return {"floor_height": 0.0, "sem_map": map_layers, "origin": np.array([0, 0])}


def inner_walls(scene: Scene) -> np.ndarray:
    """Return the walls without those far from everything."""
    return scene.walls & ~derive_walls(scene.reach, scene.origin, scene.boxes)


def test_long_thin_strip_between_floors_becomes_a_wall(tmp_path):
    # Pixels 36-45 are x 1.80 to 2.30 m, their middle pixel 2.00 to 2.05 m: cells at x = 2.00, index 8 + 3 of margin.
    scene = scene_from_map(tmp_path, two_part_floor(slice(36, 46), slice(30, 45)))
    wall_cells = np.argwhere(inner_walls(scene))
    assert set(wall_cells[:, 1].tolist()) == {11}

    # The door is at Habitat's z 1.50 to 2.25 m: two rows of pixels of the cell at 1.50 m and three of that at 2.25 m.
    wall_z = -(scene.origin[1] + 0.25 * wall_cells[::-1, 0])
    assert wall_z.tolist() == [*np.arange(0, 1.5, 0.25), *np.arange(2.5, 4.25, 0.25)]


@pytest.mark.parametrize("first_pixel", range(30, 35))
@pytest.mark.parametrize("num_pixels", range(4, 13))
def test_walls_separate_floors_at_any_offset_and_width(tmp_path, first_pixel, num_pixels):
    wall_pixels = slice(first_pixel, first_pixel + num_pixels)
    scene = scene_from_map(tmp_path, two_part_floor(wall_pixels, slice(0, 0)))
    assert len(connected_parts(scene.reach)) == 2
    assert min(map(len, connected_parts(scene.reach))) >= 80  # at least 6 of 17 columns of 16 rows, less the chair

    # A door of two cells joins them.
    joined_scene = scene_from_map(tmp_path, two_part_floor(wall_pixels, slice(30, 40)))
    assert len(connected_parts(joined_scene.reach)) == 1


@pytest.mark.parametrize(("door_pixels", "num_parts"), [(slice(31, 34), 1), (slice(30, 32), 1), (slice(31, 32), 2)])
def test_narrow_doors_connect_floors(tmp_path, door_pixels, num_parts):
    # Pixels 31-33 are z 1.55 to 1.70 m, with no multiple of 0.25 m; two of them are in the cell at 1.75 m.
    scene = scene_from_map(tmp_path, two_part_floor(slice(36, 46), door_pixels))
    assert len(connected_parts(scene.reach)) == num_parts


@pytest.mark.parametrize(
    ("wall_pixels", "door_pixels"),
    [
        (slice(30, 48), slice(30, 45)),  # 0.9 m wide: may be furniture
        (slice(36, 46), slice(12, 80)),  # 0.6 m long
        (slice(36, 38), slice(30, 45)),  # 0.1 m: no obstacle leaves so little
    ],
)
def test_wide_short_or_narrow_strips_become_no_walls(tmp_path, wall_pixels, door_pixels):
    assert not inner_walls(scene_from_map(tmp_path, two_part_floor(wall_pixels, door_pixels))).any()


@pytest.mark.parametrize(
    ("changed_fields", "field_name", "remedy"),
    [
        ({"floor_height": np.float64("nan")}, "floor_height", "give metres"),
        ({"floor_height": 10**5000}, "floor_height", "give metres"),
        ({"origin": [0, 0]}, "origin", "give (z, x) in centimetres"),
        ({"origin": np.array([0.0, np.inf])}, "origin", "give (z, x) in centimetres"),
        ({"origin": np.array([0, -(2**63)])}, "origin", "give (z, x) in centimetres"),
        ({"sem_map": np.zeros((15, 4, 4))}, "sem_map", "give the floor and 15 categories"),
        ({"sem_map": np.zeros((16, 2001, 1))}, "sem_map", "give the floor and 15 categories"),
        ({"sem_map": np.zeros((16, 0, 4))}, "sem_map", "give the floor and 15 categories"),
        ({"sem_map": np.full((16, 4, 4), np.nan)}, "sem_map", "give layers of 0 and 1"),
        ({"sem_map": np.full((16, 4, 4), 2)}, "sem_map", "give layers of 0 and 1"),
        ({"sem_map": np.zeros((16, 40, 40))}, "sem_map", "layer 0; leave the floor out"),
        ({"sem_map": np.pad(np.ones((1, 40, 40)), ((0, 15), (0, 0), (0, 0)))}, "sem_map", "up; leave the floor out"),
    ],
)
def test_parse_floor_map_refuses_bad_floors_naming_field_and_remedy(tmp_path, changed_fields, field_name, remedy):
    with pytest.raises(InputError) as error:
        scene_from_map(tmp_path, l_shaped_floor(**changed_fields))
    assert_message_names(error.value, "maps.pbz2, scene 'Home': floor 0: ", f"{field_name} ", remedy)


FLOOR = {
    "floor_height": 0.5,
    "sem_map": np.eye(16, 100, dtype=np.uint8).reshape(16, 10, 10),
    "origin": np.zeros(2, int),
}
PICKLES = [pickle.dumps({"Home": {0: FLOOR}}, protocol) for protocol in (3, 4, 5)]


@given(st.sampled_from(PICKLES), st.data())
def test_read_floor_maps_reads_or_refuses_mutated_pickles(tmp_path_factory, original_pickle, data):
    # Change up to three bytes; most bytes outside the layers are among the first 200.
    byte_indices = st.integers(0, 200) | st.integers(0, len(original_pickle) - 1)
    mutated_pickle = bytearray(original_pickle)
    for byte_index in data.draw(st.lists(byte_indices, min_size=1, max_size=3)):
        mutated_pickle[byte_index] = data.draw(st.integers(0, 255))

    # Cut off the end of some.
    if data.draw(st.booleans()):
        del mutated_pickle[data.draw(st.integers(100, len(original_pickle))) :]
    map_file = tmp_path_factory.getbasetemp() / "mutated.pbz2"
    map_file.write_bytes(bz2.compress(mutated_pickle))

    # Every floor is a scene, or an error names the file.
    try:
        for floors in read_floor_maps(map_file).values():
            for record in floors.values():
                assert isinstance(build_scene_from_map(record, "Home", "val", parse_floor_map(record)), Scene)
    except InputError as error:
        assert str(error).startswith(str(map_file))  # noqa: PT017  (reading may also succeed)
