"""Shortest paths by a wave of bits against a search with a queue, on maps that wrap around at their edges."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.policies.wavefront import (
    dilate_board,
    find_path,
    follow_path,
    is_on_board,
    pack_board,
    turn_towards,
    unpack_board,
    walking_steps,
)
from jaxnav.scenes.task import MOVE_AHEAD, NEIGHBOURS, ROTATE_LEFT, ROTATE_RIGHT, Rules

SIZE = 32


@jax.jit
@jax.vmap
def find_paths(targets, passable, start):
    return find_path(pack_board(targets), pack_board(passable), start)


@jax.jit
@jax.vmap
def count_walking_steps(passable, start):
    return walking_steps(pack_board(passable), start)


def neighbour_cells(cell):
    """The eight neighbours (z, x) of a cell."""
    return [tuple((np.array(cell) + step) % SIZE) for step in NEIGHBOURS]


def queue_path_length(targets, passable, start):
    """Steps from the start to the nearest target; -1 where there is no path."""
    queue = deque([(tuple(start), 0)])
    reached_cells = {tuple(start)}
    while queue:
        cell, length = queue.popleft()
        if targets[cell]:
            return length
        for next_cell in neighbour_cells(cell):
            if next_cell not in reached_cells and (passable[next_cell] or targets[next_cell]):
                reached_cells.add(next_cell)
                queue.append((next_cell, length + 1))
    return -1


def queue_walking_steps(passable, start):
    """Steps from the start to all cells, [SIZE, SIZE]; -1 where there is no path."""
    steps = np.full(passable.shape, -1)
    steps[tuple(start)] = 0
    queue = deque([tuple(start)])
    while queue:
        cell = queue.popleft()
        for next_cell in neighbour_cells(cell):
            if passable[next_cell] and steps[next_cell] < 0:
                steps[next_cell] = steps[cell] + 1
                queue.append(next_cell)
    return steps


def random_mazes(num_mazes):
    """Targets, passable cells and start of mazes of all densities, with no target, one, or several."""
    rng = np.random.default_rng(0)
    passable = rng.random((num_mazes, SIZE, SIZE)) < rng.uniform(0.3, 0.9, (num_mazes, 1, 1))
    targets = rng.random((num_mazes, SIZE, SIZE)) < rng.choice([0.0, 0.001, 0.01], (num_mazes, 1, 1))
    return targets, passable, rng.integers(0, SIZE, (num_mazes, 2)).astype(np.int32)


@pytest.mark.slow
@pytest.mark.parametrize("num_mazes", [50, pytest.param(1000, marks=pytest.mark.exhaustive)])
def test_paths_are_as_long_as_those_of_a_queue(num_mazes):
    targets, passable, start = random_mazes(num_mazes)
    lengths = np.asarray(find_paths(targets, passable, start).length)
    expected = [queue_path_length(*maze) for maze in zip(targets, passable, start, strict=True)]
    np.testing.assert_array_equal(lengths, expected)
    assert (lengths < 0).sum() > num_mazes / 25
    assert (lengths > 10).sum() > num_mazes / 25


def test_steps_to_all_cells_are_those_of_a_queue():
    _, passable, start = random_mazes(12)
    steps = np.asarray(count_walking_steps(passable, start))
    for maze, maze_start, maze_steps in zip(passable, start, steps, strict=True):
        np.testing.assert_array_equal(maze_steps, queue_walking_steps(maze, maze_start))
    assert (steps > 16).any()  # more than half of an open board: walls lengthen paths
    np.testing.assert_array_equal(unpack_board(pack_board(jnp.asarray(passable))), passable)


def test_following_a_path_leads_to_a_target_by_passable_cells():
    steps = jnp.asarray(Rules().move_steps(), jnp.int32)

    @jax.jit
    def choose_action(targets, passable, position, heading):
        path = find_path(pack_board(targets), pack_board(passable), position)
        return follow_path(path, position, heading, steps)

    all_targets, all_passable, start = random_mazes(20)
    lengths = np.asarray(find_paths(all_targets, all_passable, start).length)
    num_walks = 0
    for maze in np.flatnonzero(lengths > 0):
        targets = all_targets[maze]
        passable = all_passable[maze]
        position = start[maze]
        heading = 0
        num_moves = 0

        # Up to eight actions a step leave time for all turns.
        for _ in range(8 * lengths[maze]):
            if targets[tuple(position)]:
                break
            action = int(choose_action(targets, passable, position, jnp.int32(heading)))
            heading = (heading + (action == ROTATE_RIGHT) - (action == ROTATE_LEFT)) % 8
            if action == MOVE_AHEAD:
                position = (position + NEIGHBOURS[heading]).astype(np.int32) % SIZE
                num_moves += 1
                assert passable[tuple(position)] or targets[tuple(position)]
        assert targets[tuple(position)]
        assert num_moves == lengths[maze]
        num_walks += 1
    assert num_walks > 5


def test_path_around_a_drawn_wall_takes_the_gap():
    """From (1, 1) to (1, 5) around a wall in column 3 with a gap in line 4.

    The columns to the gap are 2, its lines 3: three steps to the gap, and as many back: six. Without the gap there is
    no path, for column 7 and lines 0 and 7 to 31 are blocked.
    """
    passable = np.zeros((SIZE, SIZE), bool)
    passable[1:7, 1:7] = True
    passable[1:7, 3] = False
    targets = np.zeros_like(passable)
    targets[1, 5] = True
    closed = passable.copy()
    passable[4, 3] = True
    start = np.array([[1, 1], [1, 1]], np.int32)
    path = find_paths(np.stack([targets, targets]), np.stack([passable, closed]), start)
    np.testing.assert_array_equal(path.length, [6, -1])


@pytest.mark.slow
@given(st.integers(0, SIZE - 1), st.integers(0, SIZE - 1))
def test_a_cell_spreads_to_its_eight_neighbours(z, x):
    cells = np.zeros((SIZE, SIZE), bool)
    cells[z, x] = True
    board = dilate_board(pack_board(jnp.asarray(cells)))

    # The cell and its neighbours, of which some may lie beyond the edges.
    spread_cells = np.concatenate([[(z, x)], np.add((z, x), NEIGHBOURS)])
    expected = np.zeros_like(cells)
    expected[tuple((spread_cells % SIZE).T)] = True
    all_cells = jnp.asarray(np.moveaxis(np.indices((SIZE, SIZE)), 0, -1), jnp.int32)
    np.testing.assert_array_equal(is_on_board(board, all_cells), expected)
    assert is_on_board(board, jnp.asarray(spread_cells, jnp.int32)).all()


def test_turns_take_the_shorter_way():
    turns = [int(turn_towards(jnp.int32(target_heading), jnp.int32(1), 8)) for target_heading in range(8)]
    turn_right, turn_left = ROTATE_RIGHT, ROTATE_LEFT
    assert turns == [turn_left, MOVE_AHEAD, turn_right, turn_right, turn_right, turn_right, turn_left, turn_left]
