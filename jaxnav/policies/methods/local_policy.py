"""How a search with a map becomes actions, without parameters."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.errors import InputError
from jaxnav.policies.methods.base import Knowledge
from jaxnav.policies.methods.map_tracker import AGREED, FAR, SIDE, Course, found, mark, marked
from jaxnav.policies.semantic_map import EXPLORED, TRIED, WALL, SemanticMap
from jaxnav.policies.wavefront import Way, find_way, follow, pack, turn_to
from jaxnav.scenes.scene import CELL
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, ROTATE_RIGHT, Rules

PATIENCE = 3  # cells to look at the goal from in vain until it is given up


class Place(NamedTuple):
    """Hold where the goal is on the map.

    Attributes:
      known: bool [], whether it is.
      at: int32 [2], the nearest cell that is marked with it.
      spots: bool [N, N], where it should be near enough, and was not looked at in vain.
    """

    known: jax.Array
    at: jax.Array
    spots: jax.Array


@dataclasses.dataclass(frozen=True)
class LocalPolicy:
    """Walk to where the policy wants to search, by the map alone.

    A choice is a block of cells around the agent. The agent walks to the nearest cell there that it has not seen from
    nearby or, where none can be reached, to the nearest one of all. Where the goal is on the map it walks to where it
    should be near enough, and says Done when it is in view at a place that was marked before.

    Attributes:
      interval: n, actions until the policy chooses again, at most, while it searches.
      nearest: whether to search in the nearest cell whatever is chosen.
    """

    interval: int = 25
    nearest: bool = False

    def __post_init__(self) -> None:
        if self.interval < 1:
            raise InputError(f"LocalPolicy: interval is {self.interval}; give 1 action or more from choice to choice")

    @property
    def num_choices(self) -> int:
        """Return the number of blocks."""
        return SIDE**2

    def due(self, note: Course) -> jax.Array:
        """Return whether the policy chooses a block now, bool [...].

        While the goal is on the map nothing is searched for, so nothing is chosen.
        """
        return (note.left == 0) & ~found(note)

    def act(self, choice: jax.Array, note: Course, knowledge: Knowledge) -> tuple[jax.Array, Course]:
        """Return the action, and the note with what was chosen."""
        strides = knowledge.method["steps"]
        note = self._chosen(choice, note)
        place = _place(note)
        unexplored = pack(note.cells & EXPLORED == 0)
        wanted = unexplored if self.nearest else unexplored & _block(note.aim, len(note.cells))
        way, reached = _way(jnp.where(place.known, pack(place.spots), wanted), unexplored, note)
        arrived, lost = way.length == 0, way.length < 0
        facing = _bearing(note.place, place.at, len(strides), len(note.cells))
        faced = arrived & (facing == note.heading)
        action = jnp.select(
            [note.sight == AGREED, note.horizon < note.sweep, note.horizon > note.sweep, lost | faced, arrived],
            [DONE, LOOK_DOWN, LOOK_UP, ROTATE_RIGHT, turn_to(facing, note.heading, len(strides))],
            follow(way, note.place, note.heading, strides),
        )
        vain = faced & (note.sight == FAR) & (note.horizon == note.sweep)
        note = _anew(_given_up(note, place, vain), lost, knowledge)
        left = jnp.where(place.known | reached, note.left, 1)  # what cannot be reached is not waited for
        return action.astype(jnp.int32), note._replace(left=left)

    def _chosen(self, choice: jax.Array, note: Course) -> Course:
        """Take a choice where one is due."""
        size = len(note.cells)
        block = jnp.stack([choice // SIDE, choice % SIDE]).astype(jnp.int32)
        aim = (note.place - size // 2 + size // SIDE * block) % size
        due = self.due(note)
        return note._replace(aim=jnp.where(due, aim, note.aim), left=jnp.where(due, self.interval, note.left))


def _block(aim: jax.Array, size: int) -> jax.Array:
    """Return the board of the block whose first cell is given."""
    lines, columns = (jnp.arange(size)[None] - aim[:, None]) % size < size // SIDE
    return jnp.where(lines[:, None], pack(columns)[None], np.uint32(0))


def _place(note: Course) -> Place:
    """Return where the goal is on the map."""
    size, far = len(note.cells), jnp.iinfo(jnp.int32).max
    where = jnp.where(marked(note.cells, note.goal), _squares(note.place, size), far)
    nearest = where.argmin()
    at = jnp.stack([nearest // size, nearest % size]).astype(jnp.int32)
    near = CELL**2 * _squares(at, size).astype(jnp.float32) <= note.enough**2
    return Place(where.min() < far, at, near & (note.cells & (WALL | TRIED) == 0))


def _squares(place: jax.Array, size: int) -> jax.Array:
    """Return squared distances from a cell, int32 [N, N]."""
    z, x = jnp.square(_between(place[:, None], jnp.arange(size)[None], size))
    return z[:, None] + x[None]


def _between(start: jax.Array, end: jax.Array, size: int) -> jax.Array:
    """Return displacements the shorter way round."""
    return (end - start + size // 2) % size - size // 2


def _bearing(start: jax.Array, end: jax.Array, headings: int, size: int) -> jax.Array:
    """Return the heading int32 [] nearest to the bearing of a cell."""
    directions = jnp.asarray(Rules(headings=headings).directions()[:, ::-1], jnp.float32)  # (z, x)
    return (directions @ _between(start, end, size).astype(jnp.float32)).argmax()


def _way(wanted: jax.Array, unexplored: jax.Array, note: Course) -> tuple[Way, jax.Array]:
    """Return the way to what is wanted, or else to anything unexplored.

    Returns:
      The way, and whether what is wanted can be reached, bool [].
    """
    passable = pack(note.cells & WALL == 0)
    first = find_way(wanted, passable, note.place)
    reached = first.length >= 0
    second = find_way(jnp.where(reached, np.uint32(0), unexplored), passable, note.place)
    return jax.tree.map(lambda a, b: jnp.where(reached, a, b), first, second), reached


def _given_up(note: Course, place: Place, vain: jax.Array) -> Course:
    """Leave a cell that the goal was looked at from in vain.

    After `PATIENCE` of them the goal is no longer on the map there.
    """
    z, x = note.place
    cells = note.cells.at[z, x].set(jnp.where(vain, note.cells[z, x] | TRIED, note.cells[z, x]))
    tries = note.tries + vain.astype(jnp.int32)
    gone = tries >= PATIENCE
    z, x = SemanticMap(len(cells)).around(place.at)
    cells = cells.at[z, x].set(cells[z, x] & ~jnp.where(gone, mark(note.goal), np.uint32(0)))
    return note._replace(cells=cells, tries=jnp.where(gone, 0, tries))


def _anew(note: Course, lost: jax.Array, knowledge: Knowledge) -> Course:
    """Begin a new search, with the next higher horizon."""
    forgotten = jnp.where(lost, EXPLORED | TRIED, np.uint32(0))
    sweep = jnp.where(lost, (note.sweep - 1) % knowledge.method["horizons"], note.sweep)
    return note._replace(cells=note.cells & ~forgotten, sweep=sweep)
