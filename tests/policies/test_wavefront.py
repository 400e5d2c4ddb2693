"""The wave of bits against a search with a queue, on boards that go on at the opposite edge."""

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
find_ways = jax.jit(
    jax.vmap(lambda targets, passable, start: find_path(pack_board(targets), pack_board(passable), start))
)


def by_queue(targets, passable, start):
    """Steps from the start to the nearest target; -1 where there is no way."""
    size, queue, seen = len(targets), deque([(tuple(start), 0)]), {tuple(start)}
    while queue:
        cell, length = queue.popleft()
        if targets[cell]:
            return length
        for step in NEIGHBOURS:
            after = tuple((np.array(cell) + step) % size)
            if after not in seen and (passable[after] or targets[after]):
                seen.add(after)
                queue.append((after, length + 1))
    return -1


def random_maps(count, size=SIZE):
    """Mazes of all densities, with no target, one, or several."""
    generator = np.random.default_rng(0)
    passable = generator.random((count, size, size)) < generator.uniform(0.3, 0.9, (count, 1, 1))
    targets = generator.random((count, size, size)) < generator.choice([0.0, 0.001, 0.01], (count, 1, 1))
    return targets, passable, generator.integers(0, size, (count, 2)).astype(np.int32)


@pytest.mark.slow
@pytest.mark.parametrize("maps", [50, 1000])
def test_ways_are_as_long_as_those_of_a_queue(maps):
    targets, passable, start = random_maps(maps)
    lengths = np.asarray(find_ways(targets, passable, start).length)
    expected = [by_queue(*maze) for maze in zip(targets, passable, start, strict=True)]
    np.testing.assert_array_equal(lengths, expected)
    assert (lengths < 0).sum() > maps / 25
    assert (lengths > 10).sum() > maps / 25


def test_steps_to_all_cells_are_those_of_a_queue():
    _, passable, start = random_maps(12)
    steps = jax.jit(jax.vmap(lambda passable, start: walking_steps(pack_board(passable), start)))(passable, start)
    for maze, maze_start, maze_steps in zip(passable, start, np.asarray(steps), strict=True):
        # The queue of all cells that can be entered from the start.
        expected = np.full(maze.shape, -1)
        expected[tuple(maze_start)] = 0
        queue = deque([tuple(maze_start)])
        while queue:
            cell = queue.popleft()
            for step in NEIGHBOURS:
                after = tuple((np.array(cell) + step) % SIZE)
                if maze[after] and expected[after] < 0:
                    expected[after] = expected[cell] + 1
                    queue.append(after)
        np.testing.assert_array_equal(maze_steps, expected)
    assert (np.asarray(steps) > 16).any()  # more than half of an open board: walls lengthen ways
    np.testing.assert_array_equal(unpack_board(pack_board(jnp.asarray(passable))), passable)


def test_following_a_way_gets_there_by_passable_cells():
    steps = jnp.asarray(Rules().move_steps(), jnp.int32)

    @jax.jit
    def act(targets, passable, place, heading):
        return follow_path(find_path(pack_board(targets), pack_board(passable), place), place, heading, steps)

    targets, passable, start = random_maps(20)
    lengths, walked = np.asarray(find_ways(targets, passable, start).length), 0
    for i in np.flatnonzero(lengths > 0):
        place, heading, moves = start[i], 0, 0
        for _ in range(8 * lengths[i]):
            if targets[i][tuple(place)]:
                break
            action = int(act(targets[i], passable[i], place, jnp.int32(heading)))
            heading = (heading + (action == ROTATE_RIGHT) - (action == ROTATE_LEFT)) % 8
            if action == MOVE_AHEAD:
                place, moves = (place + NEIGHBOURS[heading]).astype(np.int32) % SIZE, moves + 1
                assert passable[i][tuple(place)] or targets[i][tuple(place)]
        assert targets[i][tuple(place)]
        assert moves == lengths[i]
        walked += 1
    assert walked > 5


def test_a_drawn_way_takes_the_gap():
    """From (1, 1) to (1, 5) around a wall in column 3 with a gap in line 4.

    The columns to the gap are 2, its lines 3: three steps there, and as many back: six. Without the gap there is no
    way, for column 7 and lines 0 and 7 to 31 are blocked.
    """
    passable = np.zeros((SIZE, SIZE), bool)
    passable[1:7, 1:7] = True
    passable[1:7, 3] = False
    targets = np.zeros_like(passable)
    targets[1, 5] = True
    closed = passable.copy()
    passable[4, 3] = True
    start = np.array([[1, 1], [1, 1]], np.int32)
    way = find_ways(np.stack([targets, targets]), np.stack([passable, closed]), start)
    np.testing.assert_array_equal(way.length, [6, -1])


@pytest.mark.slow
@given(st.integers(0, SIZE - 1), st.integers(0, SIZE - 1))
def test_a_cell_spreads_to_its_eight_neighbours(z, x):
    cells = np.zeros((SIZE, SIZE), bool)
    cells[z, x] = True
    around = np.concatenate([[(z, x)], np.add((z, x), NEIGHBOURS)])
    board = dilate_board(pack_board(jnp.asarray(cells)))
    everywhere = jnp.asarray(np.moveaxis(np.indices((SIZE, SIZE)), 0, -1), jnp.int32)
    expected = np.zeros_like(cells)
    expected[tuple((around % SIZE).T)] = True
    np.testing.assert_array_equal(is_on_board(board, everywhere), expected)
    assert is_on_board(board, jnp.asarray(around, jnp.int32)).all()  # also beyond the edges


def test_turns_take_the_shorter_way():
    turns = [int(turn_towards(jnp.int32(wanted), jnp.int32(1), 8)) for wanted in range(8)]
    turn_right, turn_left = ROTATE_RIGHT, ROTATE_LEFT
    assert turns == [turn_left, MOVE_AHEAD, turn_right, turn_right, turn_right, turn_right, turn_left, turn_left]
