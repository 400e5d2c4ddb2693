"""Moves on the lattice: connected parts and shortest action counts."""

import itertools
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as hnp
from support.scenes import HOUSES, ROOMS

from jaxnav.scenes.lattice import best_lengths, cells_ahead, connected_parts, pose_successors, standable_cells


def search_connected_parts(free_mask):
    """Cells [[z, x], ...] of each 8-connected part by a breadth-first search; parts and cells in row order."""
    unvisited_cells = dict.fromkeys(map(tuple, np.argwhere(free_mask).tolist()))
    parts = []
    while unvisited_cells:
        # Begin a part at the first cell in row order that no part has.
        first_part_cell = next(iter(unvisited_cells))
        del unvisited_cells[first_part_cell]
        pending = deque([first_part_cell])
        part_cells = []
        while pending:
            z, x = pending.popleft()
            part_cells.append([z, x])
            for dz, dx in itertools.product((-1, 0, 1), repeat=2):
                neighbour_cell = (z + dz, x + dx)
                if neighbour_cell in unvisited_cells:
                    del unvisited_cells[neighbour_cell]
                    pending.append(neighbour_cell)
        parts.append(sorted(part_cells))
    return parts


@given(hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=9)))
def test_connected_parts_equal_a_breadth_first_search(free_mask):
    assert [part.tolist() for part in connected_parts(free_mask)] == search_connected_parts(free_mask)


def test_connected_parts_of_large_masks_equal_a_breadth_first_search():
    draws = np.random.default_rng(0)
    for free_share in (0.2, 0.35, 0.5):
        free_mask = draws.random((60, 70)) < free_share
        assert [part.tolist() for part in connected_parts(free_mask)] == search_connected_parts(free_mask)


def test_connected_parts_of_a_long_snake():
    snake_mask = np.zeros((40, 41), bool)
    snake_mask[::4] = snake_mask[2::8, -1] = snake_mask[6::8, 0] = True
    snake_mask[1::8, -1] = snake_mask[3::8, -1] = snake_mask[5::8, 0] = snake_mask[7::8, 0] = True
    assert [len(part) for part in connected_parts(snake_mask)] == [snake_mask.sum()]


def test_standable_cells_are_the_first_largest_connected_part():
    def draw_standable_cells(*rows):
        """Standable cells (z, x) of a drawing with `.` for free cells."""
        marks = np.array([list(row) for row in rows])
        return [tuple(cell) for cell in standable_cells(marks == ".").tolist()]

    assert draw_standable_cells(".#..", "##..", "####") == [(0, 2), (0, 3), (1, 2), (1, 3)]
    assert draw_standable_cells("#.#..", "#.###") == [(0, 1), (1, 1)]
    assert draw_standable_cells("##..", ".###", ".###") == [(0, 2), (0, 3)]  # [0, 2] comes before [1, 0] in row order
    assert draw_standable_cells(".#.", "#.#", ".#.") == [(0, 0), (0, 2), (1, 1), (2, 0), (2, 2)]  # diagonals connect
    assert draw_standable_cells("##") == []


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_best_lengths_equal_a_breadth_first_search(rules):
    draws = np.random.default_rng(0)
    successor = pose_successors(cells_ahead(standable_cells(draws.random((9, 9)) < 0.55), rules), rules)
    succeeds = draws.random((len(successor), 3)) < [0.002, 0.02, 0.0]
    best_length = best_lengths(successor, succeeds)

    def search(start_pose, goal):
        """Number of actions from a pose to a goal, Done included; 0 if there is no path."""
        path_length = {start_pose: 1}
        pending = deque([start_pose])
        while pending:
            pose = pending.popleft()
            if succeeds[pose, goal]:
                return path_length[pose]
            for next_pose in successor[pose, :5].tolist():
                if next_pose not in path_length:
                    path_length[next_pose] = path_length[pose] + 1
                    pending.append(next_pose)
        return 0

    # Compare from every seventh pose; the third goal cannot be reached.
    for start_pose in range(0, len(successor), 7):
        assert [search(start_pose, goal) for goal in range(3)] == best_length[start_pose].tolist()
    assert best_length[:, 0].max() > 8
    assert not best_length[:, 2].any()
    np.testing.assert_array_equal(best_length == 1, succeeds)
