"""Rectangles that a mask of walls is divided into."""

import numpy as np
import pytest

from jaxnav.scenes.tables.visibility import cover_with_rectangles


@pytest.mark.parametrize("density", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_rectangles_cover_a_mask_once(density):
    draws = np.random.default_rng(0)
    for _ in range(20):
        mask = draws.random(draws.integers(1, 9, 2)) < density
        cover = np.zeros(mask.shape, int)
        for z0, x0, z1, x1 in cover_with_rectangles(mask):
            cover[z0:z1, x0:x1] += 1
        np.testing.assert_array_equal(cover, mask)
    assert cover_with_rectangles(np.ones((3, 5), bool)).tolist() == [[0, 0, 3, 5]]
