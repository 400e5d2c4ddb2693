"""Shortest paths on a toroidal grid map, found by a wave of bits.

A board uint32 [N, N / 32] holds one bit per cell: cell (z, x) is bit x % 32 of word x // 32 in line z. Lines and
columns wrap around at the edges. `find_path` spreads a wave from the targets to the eight neighbours of all cells,
which takes a few shifts per step, and `follow_path` returns the agent's next action. `walking_steps` measures the way
from one cell to all.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT

WORD_BITS = 32
_LAST_BIT = np.uint32(WORD_BITS - 1)

#: Binary digits in which `walking_steps` counts, and the largest number of steps that they hold.
_NUM_STEP_DIGITS = 8
MAX_STEPS = 2**_NUM_STEP_DIGITS - 1

#: State of the wave: number of steps, cells reached one step before, and cells reached so far.
_Wave = tuple[jax.Array, jax.Array, jax.Array]
#: The same with the digits of the distances so far.
_CountingWave = tuple[jax.Array, jax.Array, jax.Array, tuple[jax.Array, ...]]


class PathField(NamedTuple):
    """Distance from a start to its nearest target, and the cells that are closer to it.

    Attributes:
      length: int32 [], steps to the nearest target; -1 where there is no path.
      closer_cells: uint32 [N, N / 32], the cells that are closer to a target than the start is.
    """

    length: jax.Array
    closer_cells: jax.Array


def find_path(targets: jax.Array, passable: jax.Array, start: jax.Array) -> PathField:
    """Find a shortest path to the nearest target.

    A step leads to one of the eight neighbours. The start and the targets need not be passable.

    Args:
      targets: uint32 [N, N / 32].
      passable: uint32 [N, N / 32].
      start: int32 [2], (z, x).
    """
    # The wave runs backwards, from the targets to the start, and must be able to enter the start.
    start_row, start_column = start
    start_bit = jnp.uint32(1) << (start_column % WORD_BITS).astype(jnp.uint32)
    start_board = jnp.zeros_like(passable).at[start_row, start_column // WORD_BITS].set(start_bit)
    enterable = passable | start_board

    # The wave ends at the start, or where it reaches nothing new.
    def is_spreading(wave: _Wave) -> jax.Array:
        _, reached_before, reached = wave
        return ~is_on_board(reached, start) & (reached != reached_before).any()

    def spread(wave: _Wave) -> _Wave:
        length, _, reached = wave
        return length + 1, reached, reached | (dilate_board(reached) & enterable)

    # What was reached one step before the start is closer to a target than the start is.
    first_wave = (jnp.int32(0), jnp.zeros_like(targets), targets)
    length, reached_before, reached = jax.lax.while_loop(is_spreading, spread, first_wave)
    return PathField(jnp.where(is_on_board(reached, start), length, -1), reached_before)


def walking_steps(passable: jax.Array, start: jax.Array) -> jax.Array:
    """Number of steps from a cell to every cell, int32 [N, N]; -1 where there is no path of at most `MAX_STEPS` steps.

    A step leads to one of the eight neighbours. The start need not be passable.

    Args:
      passable: uint32 [N, N / 32].
      start: int32 [2], (z, x).
    """
    start_row, start_column = start
    start_bit = jnp.uint32(1) << (start_column % WORD_BITS).astype(jnp.uint32)
    reached = jnp.zeros_like(passable).at[start_row, start_column // WORD_BITS].set(start_bit)
    enterable = passable | reached

    # A cell is at a distance of as many steps as the wave has made without reaching it. The numbers of all cells are
    # counted together: digit i of a cell's number is its bit on board i.
    digits = (jnp.zeros_like(passable),) * _NUM_STEP_DIGITS

    def is_spreading(wave: _CountingWave) -> jax.Array:
        step, reached_before, reached, _ = wave
        return (step < MAX_STEPS) & ((step == 0) | (reached != reached_before).any())

    def spread(wave: _CountingWave) -> _CountingWave:
        step, _, reached, digits = wave
        carry = ~reached
        next_digits = []
        for digit in digits:
            next_digits.append(digit ^ carry)
            carry = digit & carry
        return step + 1, reached, reached | (dilate_board(reached) & enterable), tuple(next_digits)

    _, _, reached, digits = jax.lax.while_loop(is_spreading, spread, (jnp.int32(0), reached, reached, digits))

    # Read the numbers of all cells from the boards.
    steps = jnp.zeros((passable.shape[0], passable.shape[0]), jnp.int32)
    for index, digit in enumerate(digits):
        steps += unpack_board(digit).astype(jnp.int32) << index
    return jnp.where(unpack_board(reached), steps, -1)


def follow_path(path_field: PathField, start: jax.Array, heading: jax.Array, strides: jax.Array) -> jax.Array:
    """Return the next action int32 [] along a path of at least one step.

    Where several steps lead closer, the one that needs the fewest turns is chosen.

    Args:
      path_field: result of `find_path` for this start.
      start: int32 [2], (z, x).
      heading: int32 [].
      strides: int32 [H, 2], the displacement (dz, dx) of a step ahead by heading.
    """
    num_headings = len(strides)
    # Number of turns to each heading, [H], by the shorter way.
    right_turns = (jnp.arange(num_headings) - heading) % num_headings
    num_turns = jnp.minimum(right_turns, num_headings - right_turns)

    # Headings that do not lead closer cost more than any turn.
    leads_closer = is_on_board(path_field.closer_cells, start[None] + strides)
    turn_costs = jnp.where(leads_closer, num_turns, num_headings)
    return turn_towards(turn_costs.argmin(), heading, num_headings)


def turn_towards(target_heading: jax.Array, heading: jax.Array, num_headings: int) -> jax.Array:
    """Return the action int32 [] that turns towards a heading, or MoveAhead where the agent already has it."""
    right_turns = (target_heading - heading) % num_headings
    turn_action = jnp.where(2 * right_turns <= num_headings, ROTATE_RIGHT, ROTATE_LEFT)
    return jnp.where(right_turns == 0, MOVE_AHEAD, turn_action).astype(jnp.int32)


def pack_board(cells: jax.Array) -> jax.Array:
    """Pack cells bool [..., N] into a board uint32 [..., N / 32]."""
    # Bit i of a word is cell 32 w + i of the line.
    cells_by_word = cells.reshape(*cells.shape[:-1], -1, WORD_BITS).astype(jnp.uint32)
    shifts = np.arange(WORD_BITS, dtype=np.uint32).reshape((1,) * cells.ndim + (WORD_BITS,))
    return (cells_by_word << shifts).sum(axis=-1, dtype=jnp.uint32)


def unpack_board(board: jax.Array) -> jax.Array:
    """Unpack a board uint32 [..., N / 32] into cells bool [..., N]."""
    shifts = np.arange(WORD_BITS, dtype=np.uint32).reshape((1,) * board.ndim + (WORD_BITS,))
    cells_by_word = (board[..., None] >> shifts) & np.uint32(1) > 0
    return cells_by_word.reshape(*board.shape[:-1], -1)


def is_on_board(board: jax.Array, positions: jax.Array) -> jax.Array:
    """Return True where the bit of a cell int32 [..., 2] is set, bool [...].

    Positions beyond an edge wrap around.
    """
    # Look the word of each cell up, then test its bit.
    rows, columns = jnp.moveaxis(positions % board.shape[0], -1, 0)
    words = board[rows, columns // WORD_BITS]
    return (words >> (columns % WORD_BITS).astype(jnp.uint32)) & np.uint32(1) > 0


def dilate_board(board: jax.Array) -> jax.Array:
    """Return the cells of a board and their eight neighbours."""
    # Shifts carry the bit at a word's end into the neighbouring word.
    shifted_up = board << np.uint32(1) | jnp.roll(board, 1, axis=1) >> _LAST_BIT
    shifted_down = board >> np.uint32(1) | jnp.roll(board, -1, axis=1) << _LAST_BIT
    # Along the lines first, then across them: together these are all eight neighbours.
    dilated_rows = board | shifted_up | shifted_down
    return dilated_rows | jnp.roll(dilated_rows, 1, axis=0) | jnp.roll(dilated_rows, -1, axis=0)
