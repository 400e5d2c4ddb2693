"""Walls that follow from the standable cells and the boxes."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.scenes.files.scene_file import derive_walls


def test_walls_are_three_cells_from_the_floor_in_either_axis():
    # One standable cell in the corner of 5 x 5: the square of cells less than three away in both axes is no wall.
    reach = np.zeros((5, 5), bool)
    reach[0, 0] = True
    expected = np.ones((5, 5), bool)
    expected[:3, :3] = False
    np.testing.assert_array_equal(derive_walls(reach, (0.0, 0.0), np.zeros((0, 6))), expected)


def test_walls_keep_a_quarter_metre_from_boxes():
    # A row of cells at z = 0 and x = 0, 0.25, ..., 2.25; the first is standable, so without objects 3..9 are walls.
    reach = np.arange(10)[None] == 0
    # A box 0.5 wide at x = 1.75 covers 1.5..2.0 = cells 6..8; cells 5 and 9 are exactly 0.25 away: near as well.
    wide = [1.75, 9.0, 0.0, 0.5, 0.1, 0.1]  # its height does not matter
    walls = derive_walls(reach, (0.0, 0.0), np.array([wide]))
    assert np.flatnonzero(walls[0]).tolist() == [3, 4]
    # The point (1.4, 0.2) is hypot(0.1, 0.2) = 0.224 from cell 6 and hypot(0.15, 0.2) = 0.25 from cell 5 at x = 1.25.
    walls = derive_walls(reach, (0.0, 0.0), np.array([[1.4, 0.0, 0.2, 0.0, 0.0, 0.0]]))
    assert np.flatnonzero(walls[0]).tolist() == [3, 4, 7, 8, 9]
    # At z = 0.21 cell 5 is hypot(0.15, 0.21) = 0.258 away, a wall again; cell 6 at hypot(0.1, 0.21) = 0.233 is not.
    walls = derive_walls(reach, (0.0, 0.0), np.array([[1.4, 0.0, 0.21, 0.0, 0.0, 0.0]]))
    assert np.flatnonzero(walls[0]).tolist() == [3, 4, 5, 7, 8, 9]


@given(st.integers(0, 2**32 - 1))
def test_walls_equal_the_rule_cell_by_cell(seed):
    rng = np.random.default_rng(seed)
    reach = rng.random((9, 8)) < 0.04
    reach[rng.integers(9), rng.integers(8)] = True
    boxes = np.concatenate([rng.uniform(-1, 3, (4, 3)), rng.uniform(0, 1, (4, 3))], axis=1)
    walls = derive_walls(reach, (0.5, -0.25), boxes)
    floor = np.argwhere(reach)
    for iz, ix in np.ndindex(reach.shape):
        far = all(max(abs(iz - fz), abs(ix - fx)) >= 3 for fz, fx in floor)
        x, z = 0.5 + 0.25 * ix, -0.25 + 0.25 * iz
        gaps = [
            math.dist(
                (x, z), (np.clip(x, b[0] - b[3] / 2, b[0] + b[3] / 2), np.clip(z, b[2] - b[5] / 2, b[2] + b[5] / 2))
            )
            for b in boxes
        ]
        assert walls[iz, ix] == (far and min(gaps) > 0.25)
