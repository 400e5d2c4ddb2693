"""Outlines of rooms."""

import numpy as np
import pytest

from jaxnav.scenes.generate.room_shapes import is_inside_room, make_room_shape, wall_mask
from jaxnav.scenes.scene import CELL_SIZE


@pytest.mark.parametrize("at_high_end", [(True, True), (True, False), (False, True), (False, False)])
def test_room_shape_walls_of_an_l_shape_face_inwards(at_high_end: tuple[bool, bool]):
    room_shape = make_room_shape(np.array([4.0, 3.0]), np.array([1.5, 1.0]), np.array(at_high_end))
    # An L-shape has the perimeter of its rectangle, 2 (4 + 3), and lacks 1.5 x 1.0 of its 12 square metres.
    assert room_shape.wall_lengths.sum() == 14.0
    assert (~wall_mask(room_shape)).sum() * CELL_SIZE**2 == 12.0 - 1.5
    inward_normals = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])[room_shape.wall_turns]
    wall_vectors = np.roll(room_shape.wall_starts, -1, axis=0) - room_shape.wall_starts
    wall_middles = room_shape.wall_starts + wall_vectors / 2

    # A box of 0.2 m before a wall is inside, and one behind it outside.
    for offset, is_inside in ((0.2, True), (-0.2, False)):
        points = wall_middles + offset * inward_normals
        assert (is_inside_room(room_shape, points - 0.1, points + 0.1) == is_inside).all()
