"""Moves on the lattice, and shortest paths."""

import numpy as np
from scipy import ndimage

from jaxnav.scenes.scene import CELL
from jaxnav.scenes.task import DONE, NUM_ACTIONS, Rules


def standable_cells(reach: np.ndarray) -> np.ndarray:
    """Return the cells of the largest 8-connected part.

    Args:
      reach: bool [nz, nx], where one can stand. Of equally large parts the first in row order counts.

    Returns:
      int [C, 2], (iz, ix) in row order.
    """
    return max(connected_parts(reach), key=len, default=np.zeros((0, 2), np.int64))


def connected_parts(mask: np.ndarray) -> list[np.ndarray]:
    """Return the 8-connected parts of a mask [n, m].

    Returns:
      int [P, 2] each, the cells of a part; parts and cells are in row order.
    """
    labels = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, np.ones((3, 3)), output=labels)
    cells, label = np.argwhere(mask), labels[mask]
    parts = np.split(cells[np.argsort(label, kind="stable")], np.cumsum(np.bincount(label)[1:]))[:-1]
    return sorted(parts, key=lambda part: part[0].tolist())


def ahead_of(cells: np.ndarray, rules: Rules) -> np.ndarray:
    """Return the cell after MoveAhead from every cell and heading.

    Where the way is blocked the agent stays.

    Args:
      cells: int [C, 2], the standable cells (iz, ix).
      rules: the headings.

    Returns:
      int32 [C, H].
    """
    low = cells.min(axis=0, initial=0) - 1
    index = np.full(cells.max(axis=0, initial=0) - low + 2, -1)
    index[tuple((cells - low).T)] = np.arange(len(cells))
    ahead = index[tuple(np.moveaxis(cells[:, None] - low + rules.steps(), -1, 0))]
    return np.where(ahead >= 0, ahead, np.arange(len(cells))[:, None]).astype(np.int32)


def successors(ahead: np.ndarray, rules: Rules) -> np.ndarray:
    """Return the pose after every action from every pose.

    Args:
      ahead: int32 [C, H], see `ahead_of`.
      rules: headings and horizons.

    Returns:
      int32 [P, 6], P = C * H * horizons.
    """
    last = len(rules.horizons) - 1
    cell, heading, horizon = np.indices((len(ahead), rules.headings, last + 1), np.int32)

    def pose(cell: np.ndarray, heading: np.ndarray, horizon: np.ndarray) -> np.ndarray:
        return (cell * rules.headings + heading % rules.headings) * len(rules.horizons) + horizon

    table = [
        pose(np.broadcast_to(ahead[..., None], cell.shape), heading, horizon),
        pose(cell, heading - 1, horizon),
        pose(cell, heading + 1, horizon),
        pose(cell, heading, np.maximum(horizon - 1, 0)),
        pose(cell, heading, np.minimum(horizon + 1, last)),
        pose(cell, heading, horizon),
    ]
    return np.stack(table, axis=-1).reshape(-1, NUM_ACTIONS).astype(np.int32)


def best_lengths(successor: np.ndarray, success: np.ndarray) -> np.ndarray:
    """Return L*, the least number of actions to success.

    Done counts as an action.

    Args:
      successor: int [P, 6].
      success: bool [P, K], whether Done would succeed at a pose.

    Returns:
      uint16 [P, K]; 1 where Done succeeds at the pose itself, 0 where the goal cannot be reached.
    """
    lengths = success.astype(np.uint16)
    # The goals reached so far are the bits of a word, so that one pass over the moves serves them all.
    bits = np.packbits(success, axis=1, bitorder="little")
    reached = np.pad(bits, ((0, 0), (0, -bits.shape[1] % 8))).view(np.uint64)  # [P, words]
    moves = np.ascontiguousarray(successor[:, :DONE].T)
    length = 1
    while True:
        spread = reached.copy()
        for move in moves:
            spread |= reached[move]
        new = np.flatnonzero((spread != reached).any(axis=1))
        if not len(new):
            return lengths
        length += 1
        fresh = np.unpackbits((spread ^ reached)[new].view(np.uint8), axis=1, bitorder="little", count=success.shape[1])
        pose, goal = np.nonzero(fresh)
        lengths[new[pose], goal] = length
        reached = spread


def best_actions(successor: np.ndarray, best_length: np.ndarray, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the first action of a shortest path.

    Args:
      successor: int [P, 6].
      best_length: uint16 [P, K], see `best_lengths`.
      pose, goal: int [...], of which to which.

    Returns:
      int [...], Done where it succeeds; of equally good actions the first. `NUM_ACTIONS`, which is none, where there is
      no way.
    """
    left = best_length[pose, goal]
    nearer = best_length[successor[pose, :DONE], goal[..., None]] == left[..., None] - 1
    return np.where(left > 1, nearer.argmax(axis=-1), np.where(left == 1, DONE, NUM_ACTIONS))


def walking_distances(ahead: np.ndarray, rules: Rules, direct: np.ndarray) -> np.ndarray:
    """Return the shortest walks from each cell to goals.

    Args:
      ahead: int32 [C, H], see `ahead_of`.
      rules: the headings.
      direct: float64 [C, G], metres straight from each cell to a goal, inf where there is no straight way.

    Returns:
      float64 [C, G], metres: the least, over all cells, of the walk there and the straight way from there.
    """
    ways, first = np.unique(rules.steps(), axis=0, return_index=True)
    costs = CELL * np.hypot(*ways.T)
    distance = direct
    while True:
        nearer = distance
        for heading, cost in zip(first, costs, strict=True):
            nearer = np.minimum(nearer, distance[ahead[:, heading]] + cost)
        if np.array_equal(nearer, distance):
            return distance
        distance = nearer
