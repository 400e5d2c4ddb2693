"""Outlines of rooms."""

import numpy as np
import pytest

from jaxnav.scenes.generate.room_shapes import is_inside_room, make_room_shape, wall_mask
from jaxnav.scenes.scene import CELL_SIZE


@pytest.mark.parametrize("high", [(True, True), (True, False), (False, True), (False, False)])
def test_walls_of_an_l_shape_face_inwards(high: tuple[bool, bool]):
    shape = make_room_shape(np.array([4.0, 3.0]), np.array([1.5, 1.0]), np.array(high))
    # An L-shape has the perimeter of its rectangle, 2 (4 + 3), and lacks 1.5 x 1.0 of its 12 square metres.
    assert shape.wall_lengths.sum() == 14.0
    assert (~wall_mask(shape)).sum() * CELL_SIZE**2 == 12.0 - 1.5
    forward = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])[shape.wall_turns]
    along = np.roll(shape.wall_starts, -1, axis=0) - shape.wall_starts
    middles = shape.wall_starts + along / 2
    for side, expected in ((0.2, True), (-0.2, False)):
        points = middles + side * forward
        assert (is_inside_room(shape, points - 0.1, points + 0.1) == expected).all()
