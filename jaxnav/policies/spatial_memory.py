"""Spatial memory: a map of where the agent has been and which cells it saw free or blocked.

The map is drawn from the agent's views by compass and odometry and holds nothing about objects. It is a window that
moves with the agent: cells farther away than half its size are forgotten. `SpatialMemory` draws and reads it; the
policy reads the cells around the agent on the direct pathway of the scene.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat
from jaxnav.scenes.task import FrontCell, Rules

#: State of a map cell. Where views disagree, the larger number wins.
UNKNOWN, BLOCKED, FREE, VISITED = range(4)


class ExplorationMap(NamedTuple):
    """Map of one episode.

    Attributes:
      cells: uint8 [N, N], state of each cell of the window around the agent, from N / 2 cells behind to N / 2 - 1 ahead
        along both axes. The map is toroidal: (z, x) is stored at (z mod N, x mod N).
      position: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], 0 to H - 1, its compass heading.
    """

    cells: jax.Array
    position: jax.Array
    heading: jax.Array


@dataclasses.dataclass(frozen=True)
class SpatialMemory:
    """Mapper without parameters; hashable.

    The map does not depend on how objects are laid out: its cells are free, blocked or visited, according to the views
    and the moves of the agent. All functions take one episode; callers `vmap`.

    Attributes:
      headings: H of the task.
      size: N, cells along each side of the map.
      reach: number of cells that are read on each side of the agent.
      stride: distance in cells between neighbouring cells that are read.
      front_cell: cell in front of the agent that a view shows, see `Rules.front_cell`; that of the task.

    Raises:
      ValueError: the map is too small for the cells that are read, and would show cells of its opposite side.
    """

    headings: int
    size: int = 64
    reach: int = 5
    stride: int = 2
    front_cell: FrontCell = "nearest"

    def __post_init__(self) -> None:
        num_spanned = 2 * self.reach * self.stride + 1
        if self.size < num_spanned:
            raise ValueError(f"size is {self.size}: the cells that are read span {num_spanned}; give at least as many")

    def init(self) -> ExplorationMap:
        """Return an empty map with the agent at its centre."""
        centre = jnp.full(2, self.size // 2, jnp.int32)
        return ExplorationMap(jnp.zeros((self.size, self.size), jnp.uint8), centre, jnp.int32(0))

    def update(
        self, explored: ExplorationMap, row: jax.Array, heading: jax.Array, moved: jax.Array, row_format: RowFormat
    ) -> ExplorationMap:
        """Move the agent and draw its view.

        Args:
          explored: the map before the step.
          row: uint8 [R], the observation row after the step.
          heading: int32 [], compass heading.
          moved: bool [], True where the step changed the cell.
          row_format: format of the row.
        """
        # Odometry: a successful step leads one cell ahead.
        step = jnp.where(moved, jnp.asarray(self._rules.move_steps(), jnp.int32)[heading], 0)
        position = (explored.position + step) % self.size
        known_cells = self._forget_left_cells(explored.cells, position, step)

        # Draw the V x V cells of the view, then the agent's own cell.
        view = row_format.view_cells(row)
        blocked_or_unknown = jnp.where(view == VIEW_BLOCKED, BLOCKED, UNKNOWN)
        view_states = jnp.where(view == VIEW_FREE, FREE, blocked_or_unknown).astype(jnp.uint8)
        offsets = self._rules.view_offsets(row_format.view).reshape(self.headings, -1, 2)
        rows, columns = self._cells_at(offsets, position, heading)
        # A state only ever grows (unknown, blocked, free, visited), so the maximum joins map and view.
        cells = known_cells.at[rows, columns].max(view_states)
        cells = cells.at[position[0], position[1]].set(jnp.uint8(VISITED))
        return ExplorationMap(cells, position, heading)

    def read(self, explored: ExplorationMap) -> jax.Array:
        """Return the states of the cells around the agent, uint8 [M].

        The order is ego-centric: from the farthest line behind the agent to the farthest ahead, each from left to
        right.
        """
        # Offsets [H, M, 2] of the cells that are read, for every heading.
        distances = self.stride * np.arange(-self.reach, self.reach + 1)
        offsets = self._rules.offsets_by_heading(distances, distances).reshape(self.headings, -1, 2)
        rows, columns = self._cells_at(offsets, explored.position, explored.heading)
        return explored.cells[rows, columns]

    @staticmethod
    def encode_surroundings(surroundings: jax.Array) -> jax.Array:
        """Encode what `read` returned for a network.

        Args:
          surroundings: uint8 [..., M].

        Returns:
          float32 [..., 3 M], flags of the blocked, the free and the visited cells.
        """
        # Unknown cells have no flag: all three are 0.
        flags = [surroundings == cell_state for cell_state in (BLOCKED, FREE, VISITED)]
        return jnp.concatenate(flags, axis=-1).astype(jnp.float32)

    @property
    def num_inputs(self) -> int:
        """Number of inputs to a network, 3 M."""
        return 3 * (2 * self.reach + 1) ** 2

    def _forget_left_cells(self, cells: jax.Array, position: jax.Array, step: jax.Array) -> jax.Array:
        """Clear the line of cells that leaves the window on each axis of a step, and enters it on the other side.

        Args:
          cells: uint8 [N, N], the map before the step.
          position: int32 [2], the agent's cell after the step.
          step: int32 [2], -1, 0 or 1 along each axis.
        """
        # The new line has the greatest offset after a step of 1, N / 2 - 1, and the least after a step of -1, -N / 2.
        new_lines = (position + self.size // 2 - jnp.maximum(step, 0)) % self.size
        lines = jnp.arange(self.size)
        is_new_row = (lines == new_lines[0]) & (step[0] != 0)
        is_new_column = (lines == new_lines[1]) & (step[1] != 0)
        return jnp.where(is_new_row[:, None] | is_new_column[None], jnp.uint8(UNKNOWN), cells)

    @property
    def _rules(self) -> Rules:
        return Rules(headings=self.headings, front_cell=self.front_cell)

    def _cells_at(self, offsets: np.ndarray, position: jax.Array, heading: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return rows and columns of the cells at offsets [H, M, 2] from the agent, by its heading."""
        cells = (jnp.asarray(offsets, jnp.int32)[heading] + position[None]) % self.size
        return cells[:, 0], cells[:, 1]
