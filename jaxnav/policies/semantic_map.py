"""What an agent knows of a home, one word a cell, by compass and odometry."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.errors import InputError
from jaxnav.policies.wavefront import WORD
from jaxnav.scenes.scene import CELL
from jaxnav.scenes.tables.detector import MIN_RANGE
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, VIEW_BLOCKED, VIEW_FREE, RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, Rules

#: Bits of a word above those of the categories: seen from nearby, standable, not standable, visited, and stood in to
#: look at the goal in vain.
EXPLORED, FREE, WALL, VISITED, TRIED = (np.uint32(1 << bit) for bit in range(27, 32))
MAX_CATEGORIES = 27
CATEGORIES = np.uint32((1 << MAX_CATEGORIES) - 1)


class Look(NamedTuple):
    """Hold one view, and from where it was.

    Attributes:
      row: uint8 [R], the observation row.
      place: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], compass heading.
    """

    row: jax.Array
    place: jax.Array
    heading: jax.Array


@dataclasses.dataclass(frozen=True)
class SemanticMap:
    """Keep a map uint32 [N, N] of one episode; hashable.

    It goes on at the opposite edge, so a home fits wherever the agent starts. All functions take one episode; callers
    `vmap`.

    Attributes:
      size: N, cells along each side, a multiple of 32.
    """

    size: int = 64

    def __post_init__(self) -> None:
        if self.size < WORD or self.size % WORD:
            raise InputError(f"SemanticMap: size is {self.size}; give a multiple of {WORD}, {WORD} or more")

    def init(self) -> jax.Array:
        """Return the map before anything is seen."""
        return jnp.zeros((self.size, self.size), jnp.uint32)

    def move(self, place: jax.Array, moved: jax.Array, step: jax.Array) -> jax.Array:
        """Return the cell int32 [2] after a step (dz, dx), if it moved."""
        return (place + jnp.where(moved, step, 0)) % self.size

    def update(self, cells: jax.Array, look: Look, row_format: RowFormat, headings: int) -> jax.Array:
        """Take in a view.

        Categories that are not detected are cleared where the view shows the floor nearby: an object would be.

        Args:
          cells: uint32 [N, N], before it.
          look: the view.
          row_format: of the row.
          headings: H of the task.
        """
        offsets, twins = _view(headings, row_format.view)
        near = CELL * np.hypot(*np.moveaxis(offsets, -1, 0)) <= MIN_RANGE
        offset, twin, near = (jnp.asarray(table)[look.heading] for table in (offsets, twins, near))
        z, x = ((look.place[None] + offset) % self.size).T
        view = row_format.view_cells(look.row)
        view = jnp.maximum(view, view[twin])
        free, known = view == VIEW_FREE, (view == VIEW_FREE) | (view == VIEW_BLOCKED)
        flags = jnp.where(free, FREE, WALL) | jnp.where(near, EXPLORED, np.uint32(0))
        gone = CATEGORIES & ~self.detected(look.row, row_format)
        kept = ~(jnp.where(near, gone, np.uint32(0)) | jnp.where(free, WALL, FREE))
        before = cells[z, x]
        cells = cells.at[z, x].set(jnp.where(known, before & kept | flags, before))
        here = cells[look.place[0], look.place[1]] & ~WALL | VISITED | FREE | EXPLORED
        cells = cells.at[look.place[0], look.place[1]].set(here)
        z, x = self.places(look, row_format, headings).T
        bits = jnp.where(row_format.presence(look.row), _bits(row_format), np.uint32(0))
        return cells.at[z, x].add(bits & ~cells[z, x])  # every category has a bit of its own: adding is joining

    def places(self, look: Look, row_format: RowFormat, headings: int) -> jax.Array:
        """Return the cells int32 [K, 2] in which categories are detected."""
        detections = row_format.detections(look.row).astype(jnp.float32)
        ahead, right = detections[:, 1] / AHEAD_SCALE, (detections[:, 2] - 128.0) / RIGHT_SCALE
        forward = jnp.asarray(Rules(headings=headings).directions(), jnp.float32)[look.heading][::-1]  # (z, x)
        rightward = jnp.stack([-forward[1], forward[0]])
        away = (ahead[:, None] * forward[None] + right[:, None] * rightward[None]) / CELL
        return (look.place[None] + jnp.rint(away).astype(jnp.int32)) % self.size

    def around(self, place: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return lines and columns of a cell int32 [2] and its neighbours.

        Both are int32 [9].
        """
        block = np.moveaxis(np.indices((3, 3)), 0, -1).reshape(-1, 2).astype(np.int32) - 1
        z, x = ((place[None] + block) % self.size).T
        return z, x

    @staticmethod
    def detected(row: jax.Array, row_format: RowFormat) -> jax.Array:
        """Return the word uint32 [] of the categories in view."""
        return jnp.where(row_format.presence(row), _bits(row_format), np.uint32(0)).sum(dtype=jnp.uint32)

    def bump(self, cells: jax.Array, ahead: jax.Array, action: jax.Array, moved: jax.Array) -> jax.Array:
        """Mark what the agent ran into; ahead is the cell int32 [2].

        The cell ahead counts as explored, whatever can be seen of it.
        """
        ahead, wall = ahead % self.size, (action == MOVE_AHEAD) & ~moved
        word = cells[ahead[0], ahead[1]]
        return cells.at[ahead[0], ahead[1]].set(jnp.where(wall, word & ~FREE | WALL, word) | EXPLORED)


def _bits(row_format: RowFormat) -> np.ndarray:
    """Return the bit of every category, uint32 [K]."""
    return np.uint32(1) << np.arange(row_format.num_categories, dtype=np.uint32)


@functools.lru_cache
def _view(headings: int, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of a view on the map, by heading.

    Turned by less than a right angle, up to two cells of the view are one of the map.

    Returns:
      int32 [H, V V, 2], (dz, dx) from the agent, and int32 [H, V V], the cell of the view that is the same one of the
      map; itself where there is no other.
    """
    offsets = Rules(headings=headings).view_offsets(view).reshape(headings, -1, 2).astype(np.int32)
    same = (offsets[:, :, None] == offsets[:, None]).all(axis=-1)
    first, last = same.argmax(axis=-1), same.shape[-1] - 1 - same[..., ::-1].argmax(axis=-1)
    return offsets, np.where(first == np.arange(same.shape[-1]), last, first).astype(np.int32)
