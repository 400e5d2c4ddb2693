"""Floor plans of homes: walls, doors and outlines of rooms."""

import numpy as np
import pytest

from jaxnav.scenes.generate.homes import CellRectangle, room_shape_from_walls, sample_apartment_plan, sample_house_plan
from jaxnav.scenes.generate.room_shapes import make_room_shape, wall_mask
from jaxnav.scenes.scene import CELL_SIZE


@pytest.mark.parametrize("high", [(True, True), (True, False), (False, True), (False, False)])
def test_faces_of_a_wall_mask_are_those_of_the_shape(high: tuple[bool, bool]):
    expected = make_room_shape(np.array([4.0, 3.0]), np.array([1.5, 1.0]), np.array(high))
    shape = room_shape_from_walls(wall_mask(expected))

    def faces(shape) -> list[tuple[float, ...]]:
        return sorted((*start, turn, length) for start, turn, length in zip(*shape[2:], strict=True))

    np.testing.assert_allclose(faces(shape), faces(expected))


def test_there_is_no_wall_to_put_anything_at_in_a_door_and_a_partition_has_two_faces():
    # A floor of 8 x 4 cells has walls of 2 (8 + 4) cells; a door of 4 cells leaves 20, in two pieces on its side.
    walls = np.pad(np.zeros((4, 8), bool), 1, constant_values=True)
    walls[0, 3:7] = False
    shape = room_shape_from_walls(walls)
    assert shape.wall_lengths.sum() == pytest.approx(20 * CELL_SIZE)
    assert sorted(shape.wall_lengths[shape.wall_turns == 0] / CELL_SIZE) == [2, 2]
    # A free-standing partition of 3 x 1 cells adds its outline of 8 cells.
    walls[3, 3:6] = True
    assert room_shape_from_walls(walls).wall_lengths.sum() == pytest.approx(28 * CELL_SIZE)


def test_plans_repeat_and_have_the_walls_that_they_list():
    for seed in range(20):
        plan, again = (sample_house_plan(np.random.default_rng(seed)) for _ in range(2))
        assert plan.rooms == again.rooms
        assert plan.walls.tobytes() == again.walls.tobytes()
        open_cells = sum(part.area for part in (*plan.rooms, *plan.doors))
        assert (~plan.walls).sum() == open_cells
        apartment = sample_apartment_plan(np.random.default_rng(seed))
        assert all(apartment.walls[wall.cells].all() for wall in apartment.partitions)


def test_box_of_a_door():
    # A door in cells [4, 5) x [2, 6), above a room of rows 1 to 3 and columns 1 to 8: flat, at z = 3 x 0.25 m.
    room, door = CellRectangle(1, 1, 4, 9), CellRectangle(4, 2, 5, 6)
    assert door.is_inside(room.with_ring)
    assert not door.is_inside(room)
    assert door.to_box(room, 2.5).tolist() == [[0.25, 0.0, 0.75], [1.25, 2.5, 0.75]]
