"""Floor plans of homes: walls, doors and outlines of rooms."""

import numpy as np
import pytest

from jaxnav.scenes.generate.homes import CellRectangle, room_shape_from_walls, sample_apartment_plan, sample_house_plan
from jaxnav.scenes.generate.room_shapes import make_room_shape, wall_mask
from jaxnav.scenes.scene import CELL_SIZE


@pytest.mark.parametrize("at_high_end", [(True, True), (True, False), (False, True), (False, False)])
def test_room_shape_from_walls_recovers_the_shape(at_high_end: tuple[bool, bool]):
    expected_shape = make_room_shape(np.array([4.0, 3.0]), np.array([1.5, 1.0]), np.array(at_high_end))
    room_shape = room_shape_from_walls(wall_mask(expected_shape))

    def sorted_faces(room_shape) -> list[tuple[float, ...]]:
        """Faces (start x, start z, turn, length) in ascending order."""
        return sorted((*start, turn, length) for start, turn, length in zip(*room_shape[2:], strict=True))

    np.testing.assert_allclose(sorted_faces(room_shape), sorted_faces(expected_shape))


def test_room_shape_from_walls_leaves_out_doors_and_outlines_partitions():
    # A floor of 8 x 4 cells has walls of 2 (8 + 4) cells; a door of 4 cells leaves 20, in two pieces on its side.
    room_walls = np.pad(np.zeros((4, 8), bool), 1, constant_values=True)
    room_walls[0, 3:7] = False
    room_shape = room_shape_from_walls(room_walls)
    assert room_shape.wall_lengths.sum() == pytest.approx(20 * CELL_SIZE)
    assert sorted(room_shape.wall_lengths[room_shape.wall_turns == 0] / CELL_SIZE) == [2, 2]

    # A free-standing partition of 3 x 1 cells adds its outline of 8 cells.
    room_walls[3, 3:6] = True
    assert room_shape_from_walls(room_walls).wall_lengths.sum() == pytest.approx(28 * CELL_SIZE)


def test_sampled_floor_plans_repeat_and_have_the_listed_walls():
    for seed in range(20):
        # A seed gives one plan.
        plan = sample_house_plan(np.random.default_rng(seed))
        repeated_plan = sample_house_plan(np.random.default_rng(seed))
        assert plan.rooms == repeated_plan.rooms
        assert plan.walls.tobytes() == repeated_plan.walls.tobytes()

        # All cells outside rooms and doors are walls, and partitions are walls.
        open_cells = sum(rectangle.area for rectangle in (*plan.rooms, *plan.doors))
        assert (~plan.walls).sum() == open_cells
        apartment_plan = sample_apartment_plan(np.random.default_rng(seed))
        assert all(apartment_plan.walls[wall.cells].all() for wall in apartment_plan.partitions)


def test_cell_rectangle_of_a_door_gives_a_flat_box():
    # A door in cells [4, 5) x [2, 6), above a room of rows 1 to 3 and columns 1 to 8: flat, at z = 3 x 0.25 m.
    room = CellRectangle(1, 1, 4, 9)
    door = CellRectangle(4, 2, 5, 6)
    assert door.is_inside(room.with_ring)
    assert not door.is_inside(room)
    assert door.to_box(room, 2.5).tolist() == [[0.25, 0.0, 0.75], [1.25, 2.5, 0.75]]
