"""Polygons of rooms, and openings in lines of walls."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.scenes.files.importers import assemble as polygons


@pytest.mark.parametrize(
    ("corners", "simple"),
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
def test_simple_polygons(corners, simple):
    for shift in range(len(corners)):
        turned = np.roll(np.array(corners, float), shift, axis=0)
        assert polygons.is_simple_polygon(turned) == polygons.is_simple_polygon(turned[::-1]) == simple


@given(st.lists(st.floats(0.5, 3.0), min_size=7, max_size=7))
def test_inside_equals_the_winding_number(radii):
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False) + 0.1
    corners = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert polygons.is_simple_polygon(corners)  # radii around a centre
    x, z = np.arange(-12, 13) * 0.25, np.arange(-10, 11) * 0.25
    to = corners - np.stack(np.meshgrid(x, z), axis=-1)[..., None, :]
    after = np.roll(to, -1, axis=-2)
    cross = to[..., 0] * after[..., 1] - to[..., 1] * after[..., 0]
    turns = np.arctan2(cross, (to * after).sum(axis=-1)).sum(axis=-1) / (2 * np.pi)
    clear = np.abs(cross).min(axis=-1) > 1e-9  # not on the line of an edge
    np.testing.assert_array_equal(polygons.points_in_polygon(corners, x, z)[clear], (np.abs(turns) > 0.5)[clear])


def test_openings_are_taken_out_of_walls_along_them():
    wall_line = np.array([(5.0, 2.0), (1.0, 2.0)])
    openings = [
        np.array([(4.0, 2.0), (3.5, 2.0)]),
        np.array([(3.0, 2.01), (3.8, 2.01)]),  # overlaps the first
        np.array([(3.1, 2.0), (3.2, 2.0)]),  # within the second
        np.array([(0.0, 2.0), (1.5, 2.0)]),  # beyond the end
        np.array([(2.0, 2.5), (2.5, 2.5)]),  # in a parallel wall
        np.array([(2.0, 1.5), (2.0, 2.5)]),  # across
    ]
    pieces = polygons.subtract_openings(wall_line, openings)
    assert np.array(pieces).tolist() == [[[1.5, 2.0], [3.0, 2.0]], [[4.0, 2.0], [5.0, 2.0]]]
