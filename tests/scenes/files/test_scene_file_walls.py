"""Walls derived from standable cells and boxes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.scenes.files.scene_file import derive_walls


def test_derive_walls_starts_three_cells_from_the_floor():
    # One standable cell in the corner of 5 x 5: the square of cells less than three away in both axes is no wall.
    reach = np.zeros((5, 5), bool)
    reach[0, 0] = True
    expected_walls = np.ones((5, 5), bool)
    expected_walls[:3, :3] = False
    np.testing.assert_array_equal(derive_walls(reach, (0.0, 0.0), np.zeros((0, 6))), expected_walls)


def test_derive_walls_keeps_a_quarter_metre_from_boxes():
    # A row of cells at z = 0 and x = 0, 0.25, ..., 2.25; the first is standable, so without objects 3..9 are walls.
    reach = np.arange(10)[None] == 0

    # A box 0.5 wide at x = 1.75 covers 1.5..2.0 = cells 6..8; cells 5 and 9 are exactly 0.25 away: near as well.
    wide_box = [1.75, 9.0, 0.0, 0.5, 0.1, 0.1]  # its height does not matter
    derived_walls = derive_walls(reach, (0.0, 0.0), np.array([wide_box]))
    assert np.flatnonzero(derived_walls[0]).tolist() == [3, 4]

    # The point (1.4, 0.2) is hypot(0.1, 0.2) = 0.224 from cell 6 and hypot(0.15, 0.2) = 0.25 from cell 5 at x = 1.25.
    derived_walls = derive_walls(reach, (0.0, 0.0), np.array([[1.4, 0.0, 0.2, 0.0, 0.0, 0.0]]))
    assert np.flatnonzero(derived_walls[0]).tolist() == [3, 4, 7, 8, 9]

    # At z = 0.21 cell 5 is hypot(0.15, 0.21) = 0.258 away, a wall again; cell 6 at hypot(0.1, 0.21) = 0.233 is not.
    derived_walls = derive_walls(reach, (0.0, 0.0), np.array([[1.4, 0.0, 0.21, 0.0, 0.0, 0.0]]))
    assert np.flatnonzero(derived_walls[0]).tolist() == [3, 4, 5, 7, 8, 9]


@given(st.integers(0, 2**32 - 1))
def test_derive_walls_equals_the_rule_cell_by_cell(seed):
    rng = np.random.default_rng(seed)
    reach = rng.random((9, 8)) < 0.04
    reach[rng.integers(9), rng.integers(8)] = True
    boxes = np.concatenate([rng.uniform(-1, 3, (4, 3)), rng.uniform(0, 1, (4, 3))], axis=1)
    derived_walls = derive_walls(reach, (0.5, -0.25), boxes)
    floor_cells = np.argwhere(reach)
    low_corners = boxes[:, [0, 2]] - boxes[:, [3, 5]] / 2
    high_corners = boxes[:, [0, 2]] + boxes[:, [3, 5]] / 2
    for iz, ix in np.ndindex(reach.shape):
        # A wall is three cells from the floor along either axis, and more than 0.25 m from all boxes.
        cell_distance = np.abs(floor_cells - (iz, ix)).max(axis=1).min()
        centre = np.array([0.5 + 0.25 * ix, -0.25 + 0.25 * iz])
        box_gaps = np.linalg.norm(np.clip(centre, low_corners, high_corners) - centre, axis=1)
        assert derived_walls[iz, ix] == (cell_distance >= 3 and box_gaps.min() > 0.25)
