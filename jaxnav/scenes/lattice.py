"""Moves on the lattice: headings, the standable part of a scene, and shortest action counts."""

import numpy as np

NUM_HEADINGS = 8
HORIZONS = (0.0, 30.0)  # degrees downwards
NUM_ACTIONS = 6
MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(NUM_ACTIONS)
POSES_PER_CELL = NUM_HEADINGS * len(HORIZONS)

#: (dz, dx) of MoveAhead for each heading, clockwise from +z.
HEADING_STEPS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])


def heading_vectors() -> np.ndarray:
    """Unit vectors (x, z) of the headings, float64 [8, 2]."""
    angles = np.deg2rad(45.0 * np.arange(NUM_HEADINGS))
    return np.stack([np.sin(angles), np.cos(angles)], axis=-1)


def standable_cells(reach: np.ndarray) -> np.ndarray:
    """Cells (iz, ix) of the largest 8-connected part of `reach` [nz, nx], int [C, 2] in row order.

    Of equally large parts it takes the one that comes first in row order.
    """
    # Labels spread by taking the smallest label of the neighbourhood until nothing changes.
    labels = np.where(reach, np.arange(reach.size).reshape(reach.shape), reach.size)
    while True:
        padded = np.pad(labels, 1, constant_values=reach.size)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        spread = np.where(reach, windows.min(axis=(2, 3)), reach.size)
        if np.array_equal(spread, labels):
            break
        labels = spread
    parts, counts = np.unique(labels[reach], return_counts=True)
    if not len(parts):
        return np.zeros((0, 2), np.int64)
    return np.argwhere(labels == parts[np.argmax(counts)])


def successors(cells: np.ndarray) -> np.ndarray:
    """Pose reached by every action from every pose of a scene.

    Args:
      cells: int [C, 2], the standable cells (iz, ix).

    Returns:
      int32 [C * 16, 6]; pose `(cell * 8 + heading) * 2 + horizon`.
    """
    num_cells = len(cells)
    index = {tuple(cell): i for i, cell in enumerate(cells.tolist())}
    steps = HEADING_STEPS.tolist()
    ahead = [[index.get((z + dz, x + dx), i) for dz, dx in steps] for i, (z, x) in enumerate(cells.tolist())]
    cell, heading, horizon = np.indices((num_cells, NUM_HEADINGS, len(HORIZONS)))

    def pose(cell: np.ndarray, heading: np.ndarray, horizon: np.ndarray | int) -> np.ndarray:
        return (cell * NUM_HEADINGS + heading % NUM_HEADINGS) * len(HORIZONS) + horizon

    table = np.stack(
        [
            pose(np.broadcast_to(np.array(ahead).reshape(num_cells, NUM_HEADINGS, 1), cell.shape), heading, horizon),
            pose(cell, heading - 1, horizon),
            pose(cell, heading + 1, horizon),
            pose(cell, heading, 0),
            pose(cell, heading, 1),
            pose(cell, heading, horizon),
        ],
        axis=-1,
    )
    return table.reshape(-1, NUM_ACTIONS).astype(np.int32)


def best_lengths(successor: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Shortest number of actions to success, Done included (L*).

    Args:
      successor: int [P, 6].
      found: bool [P, K], whether Done would succeed at a pose.

    Returns:
      uint16 [P, K]; 1 where the goal is found at the pose itself, 0 where it cannot be reached.
    """
    lengths = found.astype(np.uint16)
    reached, length = found, 1
    moves = successor[:, :DONE]
    while True:
        spread = reached | reached[moves].any(axis=1)
        new = spread & ~reached
        if not new.any():
            return lengths
        length += 1
        lengths[new] = length
        reached = spread
