"""Shortest paths on a toroidal grid map, found by a wave of bits.

A board uint32 [N, N / 32] holds one bit per cell: cell (z, x) is bit x % 32 of word x // 32 in line z. Lines and
columns wrap around at the edges. `find_path` spreads a wave from the targets to the eight neighbours of all cells,
which takes a few shifts per step, and `follow_path` returns the agent's next action. `walking_steps` measures the way
from one cell to all.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT

WORD_BITS = 32
_LAST_BIT = np.uint32(WORD_BITS - 1)

#: Steps in a round of `walking_steps`, and the binary digits of a step in its round.
STEPS_PER_ROUND = 8
_NUM_STEP_DIGITS = 3
#: Binary digits of the number of rounds, and the largest number of steps that can be counted.
_NUM_ROUND_DIGITS = 5
MAX_STEPS = STEPS_PER_ROUND * 2**_NUM_ROUND_DIGITS

#: State of the wave: number of steps, cells reached one step before, and cells reached so far.
_Wave = tuple[jax.Array, jax.Array, jax.Array]


class _CountingWave(NamedTuple):
    """State of a wave whose steps are counted, after some rounds.

    Attributes:
      num_rounds: int32 [], number of rounds.
      reached_before, reached: uint32 [N, N / 32], cells reached one round before, and so far.
      round_digits: bit i of the number of rounds that did not reach a cell is its bit on board i.
      step_digits: the same for the step, 0 to 7, of the round that reached it.
    """

    num_rounds: jax.Array
    reached_before: jax.Array
    reached: jax.Array
    round_digits: tuple[jax.Array, ...]
    step_digits: tuple[jax.Array, ...]


class PathField(NamedTuple):
    """Distance from a start to its nearest target, and the cells that are closer to it.

    Attributes:
      length: int32 [], steps to the nearest target; -1 where there is no path.
      closer_cells: uint32 [N, N / 32], the cells that are closer to a target than the start is.
    """

    length: jax.Array
    closer_cells: jax.Array


@jax.custom_batching.custom_vmap
def find_path(targets: jax.Array, passable: jax.Array, start: jax.Array) -> PathField:
    """Find a shortest path to the nearest target.

    A step leads to one of the eight neighbours. The start and the targets need not be passable. Under `vmap` on a CPU,
    one wave follows the other, so that each ends where its own path is found; elsewhere they spread side by side.

    Args:
      targets: uint32 [N, N / 32].
      passable: uint32 [N, N / 32].
      start: int32 [2], (z, x).
    """
    return _find_path(targets, passable, start)


def _find_path(targets: jax.Array, passable: jax.Array, start: jax.Array) -> PathField:
    """Find a shortest path; see `find_path`."""
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


@find_path.def_vmap
def _find_paths(
    num_paths: int, is_batched: list[bool], targets: jax.Array, passable: jax.Array, start: jax.Array
) -> tuple[PathField, Any]:
    """Find the paths of several maps: the batching rule of `find_path`.

    Returns:
      The paths, leaves [B, ...], and for each leaf True, because all have the batch axis.
    """
    arguments = []
    for argument, has_batch_axis in zip((targets, passable, start), is_batched, strict=True):
        arguments.append(argument if has_batch_axis else jnp.broadcast_to(argument, (num_paths, *argument.shape)))

    def one_by_one(*arguments: jax.Array) -> PathField:
        return jax.lax.map(lambda row: _find_path(*row), arguments)

    paths = jax.lax.platform_dependent(*arguments, cpu=one_by_one, default=jax.vmap(_find_path))
    return paths, jax.tree.map(lambda _: True, paths)


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

    # A cell that step s of round r is the first to reach is 8 r + s + 1 steps away. The digits of r and s are kept for
    # all cells together.
    no_bits = jnp.zeros_like(passable)

    def is_spreading(wave: _CountingWave) -> jax.Array:
        has_room = wave.num_rounds < MAX_STEPS // STEPS_PER_ROUND
        return has_room & ((wave.num_rounds == 0) | (wave.reached != wave.reached_before).any())

    def spread(reached: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        next_reached = reached | (dilate_board(reached) & enterable)
        return next_reached, next_reached & ~reached

    def spread_round(wave: _CountingWave) -> _CountingWave:
        reached, new_cells = jax.lax.scan(spread, wave.reached, None, length=STEPS_PER_ROUND)

        # Add 1 to the rounds of the cells that are still missing.
        carry = ~reached
        round_digits = []
        for digit in wave.round_digits:
            round_digits.append(digit ^ carry)
            carry = digit & carry

        # Store the steps of the new cells.
        step_digits = list(wave.step_digits)
        for step in range(STEPS_PER_ROUND):
            for index in range(_NUM_STEP_DIGITS):
                if step >> index & 1:
                    step_digits[index] |= new_cells[step]
        return _CountingWave(wave.num_rounds + 1, wave.reached, reached, tuple(round_digits), tuple(step_digits))

    start_wave = _CountingWave(
        num_rounds=jnp.int32(0),
        reached_before=reached,
        reached=reached,
        round_digits=(no_bits,) * _NUM_ROUND_DIGITS,
        step_digits=(no_bits,) * _NUM_STEP_DIGITS,
    )
    last_wave = jax.lax.while_loop(is_spreading, spread_round, start_wave)

    # Read the numbers of all cells from the boards.
    steps = jnp.ones((passable.shape[0], passable.shape[0]), jnp.int32)
    for index, digit in enumerate((*last_wave.step_digits, *last_wave.round_digits)):
        steps += unpack_board(digit).astype(jnp.int32) << index
    steps = steps.at[start_row, start_column].set(0)
    return jnp.where(unpack_board(last_wave.reached), steps, -1)


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
