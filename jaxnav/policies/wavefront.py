"""Shortest ways on a map, as a wave of bits.

A board uint32 [N, N / 32] holds one bit a cell: cell (z, x) is bit x % 32 of word x // 32 in line z. It goes on at the
opposite edge. A wave spreads to the eight neighbours of all cells by a few shifts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT

WORD = 32
_LAST = np.uint32(WORD - 1)


class Way(NamedTuple):
    """Tell how far targets are, and which cells are one step nearer.

    Attributes:
      length: int32 [], steps to the nearest target; -1 where there is no way.
      nearer: uint32 [N, N / 32], the cells that are nearer to a target than the start is.
    """

    length: jax.Array
    nearer: jax.Array


def pack(cells: jax.Array) -> jax.Array:
    """Return the board uint32 [..., N / 32] of cells bool [..., N]."""
    words = cells.reshape(*cells.shape[:-1], -1, WORD).astype(jnp.uint32)
    shifts = np.arange(WORD, dtype=np.uint32).reshape((1,) * cells.ndim + (WORD,))
    return (words << shifts).sum(axis=-1, dtype=jnp.uint32)


def holds(board: jax.Array, places: jax.Array) -> jax.Array:
    """Return whether cells int32 [..., 2] are on a board, bool [...].

    Beyond an edge it goes on at the opposite one.
    """
    z, x = jnp.moveaxis(places % board.shape[0], -1, 0)
    return (board[z, x // WORD] >> (x % WORD).astype(jnp.uint32)) & np.uint32(1) > 0


def spread(board: jax.Array) -> jax.Array:
    """Return the cells of a board and their eight neighbours."""
    east = board << np.uint32(1) | jnp.roll(board, 1, axis=1) >> _LAST
    west = board >> np.uint32(1) | jnp.roll(board, -1, axis=1) << _LAST
    lines = board | east | west
    return lines | jnp.roll(lines, 1, axis=0) | jnp.roll(lines, -1, axis=0)


def find_way(targets: jax.Array, passable: jax.Array, start: jax.Array) -> Way:
    """Find a shortest way to the nearest of the targets.

    A step leads to one of eight neighbours. The start and the targets need not be passable.

    Args:
      targets: uint32 [N, N / 32].
      passable: uint32 [N, N / 32].
      start: int32 [2], (z, x).
    """

    def goes_on(state: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        _, nearer, reached = state
        return ~holds(reached, start) & (reached != nearer).any()

    def step(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        length, _, reached = state
        return length + 1, reached, reached | (spread(reached) & open_)

    cell = (
        jnp.zeros_like(passable)
        .at[start[0], start[1] // WORD]
        .set(jnp.uint32(1) << (start[1] % WORD).astype(jnp.uint32))
    )
    open_ = passable | cell
    length, nearer, reached = jax.lax.while_loop(goes_on, step, (jnp.int32(0), jnp.zeros_like(targets), targets))
    return Way(jnp.where(holds(reached, start), length, -1), nearer)


def follow(way: Way, start: jax.Array, heading: jax.Array, strides: jax.Array) -> jax.Array:
    """Return the action int32 [] that follows a way of one step or more.

    Of several steps that lead nearer it takes the one that needs the fewest turns.

    Args:
      way: see `find_way`.
      start: int32 [2], (z, x).
      heading: int32 [].
      strides: int32 [H, 2], the displacement of a step ahead by heading.
    """
    turns = (jnp.arange(len(strides)) - heading) % len(strides)
    away = jnp.where(holds(way.nearer, start[None] + strides), jnp.minimum(turns, len(strides) - turns), len(strides))
    return turn_to(away.argmin(), heading, len(strides))


def turn_to(wanted: jax.Array, heading: jax.Array, headings: int) -> jax.Array:
    """Return the action int32 [] that turns to a heading, or goes ahead."""
    turns = (wanted - heading) % headings
    turn = jnp.where(2 * turns <= headings, ROTATE_RIGHT, ROTATE_LEFT)
    return jnp.where(turns == 0, MOVE_AHEAD, turn).astype(jnp.int32)
