"""Where an agent has been and what it has seen there, by compass and odometry."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat
from jaxnav.scenes.task import Rules

#: What is known of a cell; where views disagree the larger number stays.
UNKNOWN, BLOCKED, FREE, VISITED = range(4)


class Explored(NamedTuple):
    """Hold the map of one episode.

    Attributes:
      cells: uint8 [N, N], what is known of each cell; it goes on at the opposite edge.
      place: int32 [2], the agent's cell.
      heading: int32 [], 0 to H - 1, its compass heading.
    """

    cells: jax.Array
    place: jax.Array
    heading: jax.Array


@dataclasses.dataclass(frozen=True)
class SpatialMemory:
    """Remember the surroundings of one episode, without parameters; hashable.

    It holds nothing that depends on how objects are laid out: cells that were free, blocked or visited, from the views
    and the agent's moves. All functions take one episode; callers `vmap`.

    Attributes:
      headings: H of the task.
      size: N, cells along each side of the map.
      reach: the agent reads so many cells to each side,
      stride: of which only every so many-th.
    """

    headings: int
    size: int = 64
    reach: int = 5
    stride: int = 2

    @property
    def num_inputs(self) -> int:
        """Return the number of inputs to a network, 3 M."""
        return 3 * (2 * self.reach + 1) ** 2

    @staticmethod
    def inputs(surroundings: jax.Array) -> jax.Array:
        """Return what a network reads of cells [..., M].

        Returns:
          float32 [..., 3 M]: which are blocked, which free, which visited.
        """
        known = [surroundings == code for code in (BLOCKED, FREE, VISITED)]
        return jnp.concatenate(known, axis=-1).astype(jnp.float32)

    def init(self) -> Explored:
        """Return the map before anything is seen."""
        centre = jnp.full(2, self.size // 2, jnp.int32)
        return Explored(jnp.zeros((self.size, self.size), jnp.uint8), centre, jnp.int32(0))

    def update(
        self, explored: Explored, row: jax.Array, heading: jax.Array, moved: jax.Array, row_format: RowFormat
    ) -> Explored:
        """Take in one step.

        Args:
          explored: before it.
          row: uint8 [R], the observation row after it.
          heading: int32 [], compass heading.
          moved: bool [], whether the step changed the cell.
          row_format: of the row.
        """
        step = jnp.asarray(self._rules.steps(), jnp.int32)[heading]
        place = (explored.place + jnp.where(moved, step, 0)) % self.size
        view = row_format.view_cells(row)
        seen = jnp.where(view == VIEW_FREE, FREE, jnp.where(view == VIEW_BLOCKED, BLOCKED, UNKNOWN)).astype(jnp.uint8)
        offsets = self._rules.view_offsets(row_format.view).reshape(self.headings, -1, 2)
        rows, columns = self._at(offsets, place, heading)
        cells = explored.cells.at[rows, columns].max(seen)
        return Explored(cells.at[place[0], place[1]].set(jnp.uint8(VISITED)), place, heading)

    def read(self, explored: Explored) -> jax.Array:
        """Return what is known around the agent, uint8 [M].

        Ego-centric: from the farthest cells behind to those ahead, each line from left to right.
        """
        along = self.stride * np.arange(-self.reach, self.reach + 1)
        offsets = self._rules.turned_offsets(along, along).reshape(self.headings, -1, 2)
        rows, columns = self._at(offsets, explored.place, explored.heading)
        return explored.cells[rows, columns]

    @property
    def _rules(self) -> Rules:
        return Rules(headings=self.headings)

    def _at(self, offsets: np.ndarray, place: jax.Array, heading: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return rows and columns of the cells at offsets [H, M, 2]."""
        at = (jnp.asarray(offsets, jnp.int32)[heading] + place[None]) % self.size
        return at[:, 0], at[:, 1]
