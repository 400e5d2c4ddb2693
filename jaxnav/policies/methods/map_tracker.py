"""The map of an episode, and how far the search with it has come."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.methods.base import Knowledge, Percept
from jaxnav.policies.semantic_map import EXPLORED, TRIED, Look, SemanticMap
from jaxnav.scenes.scene import CELL
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE, RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, Rules

SIDE = 8  # blocks along each side of the map, of which the policy chooses one
FAR, NEAR, AGREED = range(3)  # whether the goal is in view: no, or too far; near enough; and seen there before


class Course(NamedTuple):
    """Hold the map of an episode and where the agent wants to go.

    Attributes:
      cells: uint32 [N, N], see `SemanticMap`.
      place: int32 [2], (z, x) of the agent's cell.
      heading: int32 [], compass heading.
      horizon: int32 [], index of the camera's horizon.
      goal: int32 [], what is sought.
      sight: int32 [], `FAR`, `NEAR` or `AGREED`.
      enough: float32 [], metres to the goal's centre at which Done succeeds.
      aim: int32 [2], first cell of the block to search in.
      left: int32 [], actions until the policy chooses another; at 0 it does unless the goal is on the map.
      sweep: int32 [], index of the horizon to search with, the lowest first; -1 before anything is seen.
      tries: int32 [], cells from which the goal was looked at in vain since it was last near.
    """

    cells: jax.Array
    place: jax.Array
    heading: jax.Array
    horizon: jax.Array
    goal: jax.Array
    sight: jax.Array
    enough: jax.Array
    aim: jax.Array
    left: jax.Array
    sweep: jax.Array
    tries: jax.Array


class MapReading(NamedTuple):
    """Hold what a network reads of the map.

    Attributes:
      blocks: uint32 [..., M], the bits of all cells in each block around the agent, line by line; the bit `EXPLORED`
        says that a cell is not.
      compass: float32 [..., 2], sine and cosine of the heading.
    """

    blocks: jax.Array
    compass: jax.Array


@dataclasses.dataclass(frozen=True)
class MapTracker:
    """Keep the map; the method's knowledge is that of `learn_home`."""

    def init(self, knowledge: Knowledge) -> Course:
        """Return an empty map, the agent in its middle."""
        around = SemanticMap(len(knowledge.method["lines"]))
        none, middle = jnp.int32(0), jnp.full(2, around.size // 2, jnp.int32)
        enough = knowledge.method["enough"]
        return Course(around.init(), middle, none, none, none, none, enough, middle, none, jnp.int32(-1), none)

    def update(self, note: Course, knowledge: Knowledge, percept: Percept) -> Course:
        """Take in one view."""
        body, row_format = knowledge.method, RowFormat(knowledge.layout.shape[-1])
        strides, around = body["steps"], SemanticMap(len(note.cells))
        place = around.move(note.place, percept.moved, strides[percept.heading])
        look = Look(percept.row, place, percept.heading)
        turned = (percept.action != MOVE_AHEAD) | percept.moved
        sight, enough = self._sight(note, look, percept.goal, knowledge)
        cells = around.update(note.cells, look, row_format, len(strides))
        cells = around.bump(cells, place + strides[percept.heading], percept.action, percept.moved)
        cells = _once(note.cells, cells, place, percept.goal)
        return note._replace(
            cells=cells,
            place=place,
            heading=percept.heading,
            horizon=percept.horizon,
            goal=percept.goal,
            sight=jnp.where(turned, sight, jnp.minimum(sight, note.sight)),
            enough=enough,
            left=jnp.maximum(note.left - 1, 0),
            sweep=jnp.where(note.sweep < 0, body["horizons"] - 1, note.sweep),
            tries=jnp.where(sight == FAR, note.tries, 0),
        )

    def read(self, note: Course, knowledge: Knowledge, goal: jax.Array) -> MapReading:
        """Return the map around the agent, block by block."""
        del goal
        size, headings = len(note.cells), len(knowledge.method["steps"])
        around = jnp.roll(note.cells ^ EXPLORED, size // 2 - note.place, axis=(0, 1))
        blocks = around.reshape(SIDE, size // SIDE, SIDE, size // SIDE)
        joined = jax.lax.reduce(blocks, np.uint32(0), jax.lax.bitwise_or, (1, 3))
        forward = jnp.asarray(Rules(headings=headings).directions(), jnp.float32)[note.heading]
        return MapReading(joined.reshape(-1), forward)

    def _sight(self, note: Course, look: Look, goal: jax.Array, knowledge: Knowledge) -> tuple[jax.Array, jax.Array]:
        """Return whether the goal is in view, and from where Done succeeds.

        Where what is sought must be near on foot, the walk ends at its edge.
        """
        body, row_format = knowledge.method, RowFormat(knowledge.layout.shape[-1])
        detection = row_format.detections(look.row)[goal].astype(jnp.float32)
        away = jnp.hypot(detection[1] / AHEAD_SCALE, (detection[2] - 128.0) / RIGHT_SCALE)
        enough = body["enough"] + body["edge"] * detection[3] / SIZE_SCALE * jnp.maximum(away, CELL)
        around = SemanticMap(len(note.cells))
        at = around.places(look, row_format, len(body["steps"]))[goal]
        z, x = around.around(at)
        agreed = marked(note.cells[z, x], goal).any()
        detected = detection[0] > 0
        sight = jnp.where(detected & (away <= enough), jnp.where(agreed, AGREED, NEAR), FAR)
        return sight, jnp.where(detected, enough, note.enough)


def _once(before: jax.Array, cells: jax.Array, place: jax.Array, goal: jax.Array) -> jax.Array:
    """Let each cell clear the goal from the map in one view only.

    Where it is detected from there again, but not at the next heading, the agent would turn to and fro.
    """
    none = np.uint32(0)
    cleared = before & ~cells & mark(goal)
    here = cells[place[0], place[1]]
    cells = cells | jnp.where(here & TRIED > 0, cleared, none)
    return cells.at[place[0], place[1]].set(here | jnp.where((cleared > 0).any(), TRIED, none))


def marked(cells: jax.Array, goal: jax.Array) -> jax.Array:
    """Return where a category int32 [] is on the map, bool [...]."""
    return cells & mark(goal) > 0


def found(note: Course) -> jax.Array:
    """Return whether the goal is on the map, bool [...]."""
    return marked(note.cells, note.goal[..., None, None]).any(axis=(-2, -1))


def mark(goal: jax.Array) -> jax.Array:
    """Return the bit uint32 [] of a category int32 []."""
    return jnp.uint32(1) << goal.astype(jnp.uint32)
