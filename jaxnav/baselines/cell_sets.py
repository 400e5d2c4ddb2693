"""Sets of cells as whole numbers, so that a search over thousands of poses is a few shifts, and a body's moves in them.

A set has bit z SIDE + x for the cell (z, x) of a square with the start in the middle; a displacement is a shift.
"""

import functools
import operator
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import CELL
from jaxnav.scenes.tables.detector import MIN_RANGE
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NEIGHBOURS, Rules

#: Cells from the start to the edge of what counts as standable, and from there to the edge of the square: room for
#: what is in view from there, so that no shift runs over the edge.
MEMORY, MARGIN = 64, 16
SIDE = 2 * (MEMORY + MARGIN) + 1
START = (SIDE + 1) * (MEMORY + MARGIN)


class Body(NamedTuple):
    """What a searcher knows of its own body; displacements are those of a shift.

    Attributes:
      steps: by heading, of MoveAhead.
      view: int [H, V V], cells of the view around `START`, by heading.
      near: by heading, cells of the view in which everything is in the detector's range.
      offsets: by heading, the displacements to those cells.
    """

    steps: list[int]
    view: np.ndarray
    near: list[int]
    offsets: list[list[int]]


@functools.lru_cache
def body(rules: Rules) -> Body:
    """How it moves and sees under the rules (docs/environment.md)."""
    view = RowFormat(0).view
    ahead, right = np.arange(view).repeat(view), np.tile(np.arange(view) - view // 2, view)
    offsets = rules.view_offsets(view).reshape(rules.headings, -1, 2)
    flat = offsets @ (SIDE, 1)
    near = (np.abs(right) <= rules.half_view[0] * ahead) & (CELL * np.hypot(*np.moveaxis(offsets, -1, 0)) <= MIN_RANGE)
    return Body(
        steps=(rules.steps() @ (SIDE, 1)).tolist(),
        view=START + flat,
        near=[cell_set(START + own[mask]) for own, mask in zip(flat, near, strict=True)],
        offsets=[np.unique(own[mask]).tolist() for own, mask in zip(flat, near, strict=True)],
    )


def facing(rules: Rules, at: np.ndarray, distance: float) -> list[int]:
    """For each heading, the cells at most a distance (metres) from a place (x, z) that have it in view."""
    around = np.rint(at / CELL).astype(int) + np.stack(np.meshgrid(*[np.arange(-MARGIN, MARGIN + 1)] * 2), axis=-1)
    v = at - CELL * around  # [N, N, (x, z)]
    close = (np.hypot(v[..., 0], v[..., 1]) <= distance) & (np.abs(around) <= MEMORY).all(axis=-1)
    cells = START + around[close] @ (1, SIDE)
    directions = rules.directions()
    ahead, right = v[close] @ directions.T, v[close] @ np.stack([directions[:, 1], -directions[:, 0]])
    in_view = (ahead > 0) & (np.abs(right) <= rules.half_view[0] * ahead)  # [cells, H]
    return [cell_set(cells[own]) for own in in_view.T]


def cell_set(indices: np.ndarray) -> int:
    """The set of cells with these indices."""
    bits = np.zeros(SIDE * SIDE, bool)
    bits[indices] = True
    return int.from_bytes(np.packbits(bits, bitorder="little").tobytes(), "little")


def union(sets: Iterable[int]) -> int:
    """The cells that are in any of the sets."""
    return functools.reduce(operator.or_, sets, 0)


def moved(cells: int, by: int) -> int:
    """A set displaced."""
    return cells << by if by >= 0 else cells >> -by


#: Displacements to the eight neighbours, and the set of the cells within `MEMORY` of the start.
AROUND = (NEIGHBOURS @ (SIDE, 1)).tolist()
WITHIN = sum(((1 << (2 * MEMORY + 1)) - 1) << (SIDE * z + MARGIN) for z in range(MARGIN, SIDE - MARGIN))
