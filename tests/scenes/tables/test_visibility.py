"""Rectangles that cover a mask of walls."""

import numpy as np
import pytest

from jaxnav.scenes.tables.visibility import cover_with_rectangles


@pytest.mark.parametrize("wall_share", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_cover_with_rectangles_covers_every_wall_cell_once(wall_share):
    draws = np.random.default_rng(0)
    for _ in range(20):
        wall_mask = draws.random(draws.integers(1, 9, 2)) < wall_share
        cover_count = np.zeros(wall_mask.shape, int)
        for low_z, low_x, high_z, high_x in cover_with_rectangles(wall_mask):
            cover_count[low_z:high_z, low_x:high_x] += 1
        np.testing.assert_array_equal(cover_count, wall_mask)
    assert cover_with_rectangles(np.ones((3, 5), bool)).tolist() == [[0, 0, 3, 5]]
