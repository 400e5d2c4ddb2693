"""Polygons of rooms, and openings in lines of walls."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.scenes.files.importers import assemble as polygons


@pytest.mark.parametrize(
    ("corners", "is_simple"),
    [
        ([(0, 0), (0, 4), (2, 4), (2, 2), (4, 2), (4, 0)], True),
        ([(0, 0), (1, 2), (3, 1)], True),
        ([(0, 0), (0, 3), (1, 3), (1, 1), (2, 1), (2, 3), (3, 3), (3, 0)], True),  # two edges on one line
        ([(0, 0), (0, 2), (0, 4), (3, 4), (3, 0)], True),  # a corner of 180 degrees
        ([(0, 0), (3, 3), (3, 0), (0, 3)], False),  # edges cross
        ([(0, 0), (0, 2), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2), (2, 0)], False),  # a corner twice
        ([(0, 0), (0, 3), (1, 3), (1, 0), (2, 0), (2, 3), (3, 3), (3, 0)], False),  # an edge along another
        ([(0, 0), (0, 3), (2, 3), (0, 1), (3, 0)], False),  # a corner on an edge
        ([(0, 0), (0, 3), (0, 1), (2, 1)], False),  # an edge that turns back
        ([(0, 0), (1, 1), (2, 2)], False),
        ([(0, 0), (0, 0), (0, 3), (3, 3)], False),
    ],
)
def test_is_simple_polygon_of_drawn_corners(corners, is_simple):
    # The first corner and the direction do not matter.
    for shift in range(len(corners)):
        rolled = np.roll(np.array(corners, float), shift, axis=0)
        assert polygons.is_simple_polygon(rolled) == is_simple
        assert polygons.is_simple_polygon(rolled[::-1]) == is_simple


@given(st.lists(st.floats(0.5, 3.0), min_size=7, max_size=7))
def test_points_in_polygon_equals_the_winding_number(radii):
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False) + 0.1
    corners = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert polygons.is_simple_polygon(corners)  # radii around a centre
    x = np.arange(-12, 13) * 0.25
    z = np.arange(-10, 11) * 0.25

    # The winding number of each point [Z, X] is the sum of the angles between successive corners [Z, X, 7, 2].
    to_corner = corners - np.stack(np.meshgrid(x, z), axis=-1)[..., None, :]
    to_next_corner = np.roll(to_corner, -1, axis=-2)
    cross_product = to_corner[..., 0] * to_next_corner[..., 1] - to_corner[..., 1] * to_next_corner[..., 0]
    dot_product = (to_corner * to_next_corner).sum(axis=-1)
    winding_number = np.arctan2(cross_product, dot_product).sum(axis=-1) / (2 * np.pi)

    # Points on the line of an edge do not count.
    off_edge = np.abs(cross_product).min(axis=-1) > 1e-9
    is_inside = polygons.points_in_polygon(corners, x, z)
    np.testing.assert_array_equal(is_inside[off_edge], (np.abs(winding_number) > 0.5)[off_edge])


def test_subtract_openings_removes_openings_along_a_wall():
    wall_line = np.array([(5.0, 2.0), (1.0, 2.0)])
    openings = [
        np.array([(4.0, 2.0), (3.5, 2.0)]),
        np.array([(3.0, 2.01), (3.8, 2.01)]),  # overlaps the first
        np.array([(3.1, 2.0), (3.2, 2.0)]),  # within the second
        np.array([(0.0, 2.0), (1.5, 2.0)]),  # beyond the end
        np.array([(2.0, 2.5), (2.5, 2.5)]),  # in a parallel wall
        np.array([(2.0, 1.5), (2.0, 2.5)]),  # across
    ]
    remaining_pieces = polygons.subtract_openings(wall_line, openings)
    assert np.array(remaining_pieces).tolist() == [[[1.5, 2.0], [3.0, 2.0]], [[4.0, 2.0], [5.0, 2.0]]]
