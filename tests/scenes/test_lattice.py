"""Moves on the lattice: connected parts and shortest action counts."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as hnp
from support.scenes import HOUSES, ROOMS

from jaxnav.scenes.lattice import best_lengths, cells_ahead, connected_parts, pose_successors, standable_cells


def searched_parts(mask):
    """The 8-connected parts by a breadth-first search; parts and cells in row order."""
    unvisited = dict.fromkeys(map(tuple, np.argwhere(mask).tolist()))
    parts = []
    while unvisited:
        start = next(iter(unvisited))
        del unvisited[start]
        queue = deque([start])
        part = []
        while queue:
            z, x = queue.popleft()
            part.append([z, x])
            for neighbour in [(z + dz, x + dx) for dz in (-1, 0, 1) for dx in (-1, 0, 1)]:
                if neighbour in unvisited:
                    del unvisited[neighbour]
                    queue.append(neighbour)
        parts.append(sorted(part))
    return parts


@given(hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=9)))
def test_connected_parts_are_those_of_a_search(mask):
    assert [part.tolist() for part in connected_parts(mask)] == searched_parts(mask)


def test_connected_parts_of_large_masks_are_those_of_a_search():
    draws = np.random.default_rng(0)
    for share in (0.2, 0.35, 0.5):
        mask = draws.random((60, 70)) < share
        assert [part.tolist() for part in connected_parts(mask)] == searched_parts(mask)


def test_connected_parts_of_a_long_snake():
    snake = np.zeros((40, 41), bool)
    snake[::4] = snake[2::8, -1] = snake[6::8, 0] = True
    snake[1::8, -1] = snake[3::8, -1] = snake[5::8, 0] = snake[7::8, 0] = True
    assert [len(part) for part in connected_parts(snake)] == [snake.sum()]


def test_standable_cells_are_the_largest_part_and_the_first_of_equal_ones():
    def cells(*rows):
        return [tuple(cell) for cell in standable_cells(np.array([[c == "." for c in row] for row in rows])).tolist()]

    assert cells(".#..", "##..", "####") == [(0, 2), (0, 3), (1, 2), (1, 3)]
    assert cells("#.#..", "#.###") == [(0, 1), (1, 1)]
    assert cells("##..", ".###", ".###") == [(0, 2), (0, 3)]  # [0, 2] comes before [1, 0] in row order
    assert cells(".#.", "#.#", ".#.") == [(0, 0), (0, 2), (1, 1), (2, 0), (2, 2)]  # diagonals connect
    assert cells("##") == []


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_best_lengths_are_those_of_a_breadth_first_search(rules):
    draws = np.random.default_rng(0)
    successor = pose_successors(cells_ahead(standable_cells(draws.random((9, 9)) < 0.55), rules), rules)
    succeeds = draws.random((len(successor), 3)) < [0.002, 0.02, 0.0]
    lengths = best_lengths(successor, succeeds)

    def search(start, goal):
        length, queue = {start: 1}, deque([start])
        while queue:
            pose = queue.popleft()
            if succeeds[pose, goal]:
                return length[pose]
            for after in successor[pose, :5].tolist():
                if after not in length:
                    length[after] = length[pose] + 1
                    queue.append(after)
        return 0

    starts = range(0, len(successor), 7)
    assert [[search(start, goal) for goal in range(3)] for start in starts] == lengths[::7].tolist()
    assert lengths[:, 0].max() > 8
    assert not lengths[:, 2].any()
    np.testing.assert_array_equal(lengths == 1, succeeds)
