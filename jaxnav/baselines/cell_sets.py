"""Sets of cells as whole numbers.

A set has bit z SIDE + x for the cell (z, x) of a square with the start in the middle. A displacement is a shift, so
that a search over thousands of poses takes a few shifts.
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

#: Cells from the start to the edge of what counts as standable, and from there to the edge of the square. The margin
#: holds what is in view from there, so that no shift crosses the edge.
MEMORY, MARGIN = 64, 16
SIDE = 2 * (MEMORY + MARGIN) + 1
START = (SIDE + 1) * (MEMORY + MARGIN)


class Body(NamedTuple):
    """Describe how a searcher moves and sees, by heading.

    Displacements are those of a shift.

    Attributes:
      steps: displacement of MoveAhead.
      view: int [H, V V], cells of the view around `START`.
      near: set of the cells of the view in which everything is in the detector's range.
      offsets: displacements to those cells.
    """

    steps: list[int]
    view: np.ndarray
    near: list[int]
    offsets: list[list[int]]


@functools.lru_cache
def body(rules: Rules) -> Body:
    """Return the body under the rules of docs/environment.md."""
    view = RowFormat(0).view
    ahead, right = np.arange(view).repeat(view), np.tile(np.arange(view) - view // 2, view)
    offsets = rules.view_offsets(view).reshape(rules.headings, -1, 2)
    flat = offsets @ (SIDE, 1)
    near = (np.abs(right) <= rules.half_view[0] * ahead) & (CELL * np.hypot(*np.moveaxis(offsets, -1, 0)) <= MIN_RANGE)
    return Body(
        steps=(rules.steps() @ (SIDE, 1)).tolist(),
        view=START + flat,
        near=[cell_set(START + cells[mask]) for cells, mask in zip(flat, near, strict=True)],
        offsets=[np.unique(cells[mask]).tolist() for cells, mask in zip(flat, near, strict=True)],
    )


def facing(rules: Rules, at: np.ndarray, distance: float) -> list[int]:
    """Return the cells with a place in view, by heading.

    Args:
      rules: headings and field of view.
      at: float [2], (x, z) of the place from the start, metres.
      distance: of the cells from the place at most, metres.
    """
    around = np.rint(at / CELL).astype(int) + np.stack(np.meshgrid(*[np.arange(-MARGIN, MARGIN + 1)] * 2), axis=-1)
    v = at - CELL * around  # [N, N, (x, z)]
    close = (np.hypot(v[..., 0], v[..., 1]) <= distance) & (np.abs(around) <= MEMORY).all(axis=-1)
    cells = START + around[close] @ (1, SIDE)
    directions = rules.directions()
    ahead, right = v[close] @ directions.T, v[close] @ np.stack([directions[:, 1], -directions[:, 0]])
    in_view = (ahead > 0) & (np.abs(right) <= rules.half_view[0] * ahead)  # [cells, H]
    return [cell_set(cells[mask]) for mask in in_view.T]


def cell_set(indices: np.ndarray) -> int:
    """Return the set of cells with these indices."""
    bits = np.zeros(SIDE * SIDE, bool)
    bits[indices] = True
    return int.from_bytes(np.packbits(bits, bitorder="little").tobytes(), "little")


def union(sets: Iterable[int]) -> int:
    """Return the cells that are in any of the sets."""
    return functools.reduce(operator.or_, sets, 0)


def moved(cells: int, by: int) -> int:
    """Return a set displaced by a shift."""
    return cells << by if by >= 0 else cells >> -by


#: Displacements to the eight neighbours, and the set of the cells within `MEMORY` of the start.
AROUND = (NEIGHBOURS @ (SIDE, 1)).tolist()
WITHIN = sum(((1 << (2 * MEMORY + 1)) - 1) << (SIDE * z + MARGIN) for z in range(MARGIN, SIDE - MARGIN))
