"""Moves on the lattice and shortest paths.

`standable_cells` finds the cells that an agent can occupy, `cells_ahead` and `pose_successors` tabulate the actions on
them, and `best_lengths` computes the shortest action sequence from every pose to every goal at once. Arrays use
C standable cells, H headings, K categories and P = C * H * horizons poses. `cells_near_boxes` and
`cells_touching_boxes` find the cells around the footprints of objects and walls.
"""

import numpy as np

from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.visibility import TOLERANCE
from jaxnav.scenes.task import DONE, NUM_ACTIONS, Rules


def standable_cells(reach: np.ndarray) -> np.ndarray:
    """Return the cells of the largest 8-connected part.

    Args:
      reach: bool [nz, nx], True where an agent can stand. Of equally large parts the first in row order counts.

    Returns:
      int [C, 2], (iz, ix) in row order.
    """
    return max(connected_parts(reach), key=len, default=np.zeros((0, 2), np.int64))


def connected_parts(mask: np.ndarray) -> list[np.ndarray]:
    """Return the 8-connected parts of a mask [n, m].

    Returns:
      int [P, 2] each, the cells of a part; parts and cells are in row order.
    """
    from scipy import ndimage  # slow to import, and not needed to show the help of a command

    # Label the parts 1, 2, ...; cells outside of the mask have the label 0.
    label_grid = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, np.ones((3, 3)), output=label_grid)
    cells = np.argwhere(mask)
    cell_labels = label_grid[mask]

    # A stable sort by label keeps the cells of each part in row order.
    cells_by_label = cells[np.argsort(cell_labels, kind="stable")]
    part_ends = np.cumsum(np.bincount(cell_labels)[1:])
    parts = np.split(cells_by_label, part_ends)[:-1]
    return sorted(parts, key=lambda part: part[0].tolist())


def cells_ahead(cells: np.ndarray, rules: Rules) -> np.ndarray:
    """Return the cell after MoveAhead from every cell and heading.

    The agent stays in its cell where the move is blocked.

    Args:
      cells: int [C, 2], the standable cells (iz, ix).
      rules: the headings.

    Returns:
      int32 [C, H].
    """
    # A grid of cell indices with a margin of one blocked cell (-1) around the standable cells.
    low_corner = cells.min(axis=0, initial=0) - 1
    index_grid = np.full(cells.max(axis=0, initial=0) - low_corner + 2, -1)
    index_grid[tuple((cells - low_corner).T)] = np.arange(len(cells))

    # [C, H, 2] -> [C, H]
    target_cells = cells[:, None] - low_corner + rules.move_steps()
    next_cells = index_grid[tuple(np.moveaxis(target_cells, -1, 0))]
    return np.where(next_cells >= 0, next_cells, np.arange(len(cells))[:, None]).astype(np.int32)


def pose_successors(ahead: np.ndarray, rules: Rules) -> np.ndarray:
    """Return the pose after every action from every pose.

    Args:
      ahead: int32 [C, H], see `cells_ahead`.
      rules: headings and horizons.

    Returns:
      int32 [P, 6], P = C * H * horizons.
    """
    # Indices of every pose and of the cell ahead of it, [C, H, horizons] each.
    last_horizon = len(rules.horizons) - 1
    cell, heading, horizon = np.indices((len(ahead), rules.headings, last_horizon + 1), np.int32)
    next_cell = np.broadcast_to(ahead[..., None], cell.shape)

    def pose_index(cell: np.ndarray, heading: np.ndarray, horizon: np.ndarray) -> np.ndarray:
        return rules.join_pose(cell, heading % rules.headings, horizon)

    # One entry per action, in the order of `ACTIONS`.
    next_poses = [
        pose_index(next_cell, heading, horizon),
        pose_index(cell, heading - 1, horizon),
        pose_index(cell, heading + 1, horizon),
        pose_index(cell, heading, np.maximum(horizon - 1, 0)),
        pose_index(cell, heading, np.minimum(horizon + 1, last_horizon)),
        pose_index(cell, heading, horizon),
    ]
    return np.stack(next_poses, axis=-1).reshape(-1, NUM_ACTIONS).astype(np.int32)


def best_lengths(successor: np.ndarray, success: np.ndarray) -> np.ndarray:
    """Return L*, the smallest number of actions to success, Done included.

    A breadth-first search runs backwards from all successful poses of all goals at once.

    Args:
      successor: int [P, 6], see `pose_successors`.
      success: bool [P, K], True where Done succeeds at a pose.

    Returns:
      uint16 [P, K]; 1 where Done succeeds at the pose itself, 0 where the goal cannot be reached.
    """
    num_goals = success.shape[1]
    lengths = success.astype(np.uint16)

    # The goals within reach of a pose are bits of 64-bit words, so one pass over the moves serves all goals.
    success_bits = np.packbits(success, axis=1, bitorder="little")
    reached_bits = np.pad(success_bits, ((0, 0), (0, -success_bits.shape[1] % 8))).view(np.uint64)  # [P, words]
    move_successors = np.ascontiguousarray(successor[:, :DONE].T)  # [5, P]

    length = 1
    while True:
        # A pose reaches every goal that one of its successors reaches.
        next_reached = reached_bits.copy()
        for successor_pose in move_successors:
            next_reached |= reached_bits[successor_pose]
        changed_poses = np.flatnonzero((next_reached != reached_bits).any(axis=1))
        if not len(changed_poses):
            return lengths

        # Unpack the new bits of the changed poses to (pose, goal) pairs.
        length += 1
        new_bytes = (next_reached ^ reached_bits)[changed_poses].view(np.uint8)
        new_goals = np.unpackbits(new_bytes, axis=1, bitorder="little", count=num_goals)
        changed_row, goal = np.nonzero(new_goals)
        lengths[changed_poses[changed_row], goal] = length
        reached_bits = next_reached


def best_actions(successor: np.ndarray, best_length: np.ndarray, pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the first action of a shortest path.

    Args:
      successor: int [P, 6], see `pose_successors`.
      best_length: uint16 [P, K], see `best_lengths`.
      pose: int [...], where each path starts.
      goal: int [...], category that each path leads to.

    Returns:
      int [...], Done where it succeeds, and the first of equally good actions; `NUM_ACTIONS`, which is no action, where
      the goal cannot be reached.
    """
    # A first action is good if it leads to a pose from which one action less is needed.
    num_actions_left = best_length[pose, goal]
    next_lengths = best_length[successor[pose, :DONE], goal[..., None]]
    is_nearer = next_lengths == num_actions_left[..., None] - 1

    # There is no move to choose where Done succeeds, and none that helps where the goal cannot be reached.
    at_goal_or_stuck = np.where(num_actions_left == 1, DONE, NUM_ACTIONS)
    return np.where(num_actions_left > 1, is_nearer.argmax(axis=-1), at_goal_or_stuck)


def walking_distances(ahead: np.ndarray, rules: Rules, direct: np.ndarray) -> np.ndarray:
    """Return the shortest walks from each cell to goals.

    Args:
      ahead: int32 [C, H], see `cells_ahead`.
      rules: the headings.
      direct: float64 [C, G], straight distance in metres from each cell to a goal, inf where the line is blocked.

    Returns:
      float64 [C, G], metres: the minimum, over all cells, of the walk to that cell plus its straight distance.
    """
    # Several headings can share a step; one heading for each distinct step is enough.
    distinct_steps, step_headings = np.unique(rules.move_steps(), axis=0, return_index=True)
    step_costs = CELL_SIZE * np.hypot(*distinct_steps.T)

    # Relax all steps until no distance changes (Bellman-Ford).
    distance = direct
    while True:
        next_distance = distance
        for heading, step_cost in zip(step_headings, step_costs, strict=True):
            next_distance = np.minimum(next_distance, distance[ahead[:, heading]] + step_cost)
        if np.array_equal(next_distance, distance):
            return distance
        distance = next_distance


# Boxes on the lattice


def interval_distances(positions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the distances of positions from the intervals [low, high]; 0 inside."""
    return np.maximum(np.maximum(low - positions, positions - high), 0.0)


def cells_touching_boxes(footprints: np.ndarray, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the cells that any box touches, bool [nz, nx].

    A cell is a closed square of 0.25 m.

    Args:
      footprints: float64 [N, 2, 2], low and high corner (x, z), metres.
      x, z: float64 [nx] and [nz], centres of the cells.
    """
    cell_mask = np.zeros((len(z), len(x)), bool)
    for low, high in footprints:
        touches_row = interval_distances(z, low[1], high[1]) <= CELL_SIZE / 2 + TOLERANCE
        touches_column = interval_distances(x, low[0], high[0]) <= CELL_SIZE / 2 + TOLERANCE
        cell_mask[np.ix_(touches_row, touches_column)] = True
    return cell_mask


def cells_near_boxes(footprints: np.ndarray, x: np.ndarray, z: np.ndarray, distance: float) -> np.ndarray:
    """Return the cells whose centre is nearer than `distance` metres to any box, bool [nz, nx].

    Args:
      footprints: float64 [N, 2, 2], low and high corner (x, z), metres.
      x, z: float64 [nx] and [nz], centres of the cells.
      distance: metres.
    """
    cell_mask = np.zeros((len(z), len(x)), bool)
    for low, high in footprints:
        distance_x = interval_distances(x, low[0], high[0])
        distance_z = interval_distances(z, low[1], high[1])
        # Only rows and columns near the box are measured.
        rows, columns = np.ix_(distance_z < distance, distance_x < distance)
        cell_mask[rows, columns] |= np.hypot(distance_z[rows], distance_x[columns]) < distance
    return cell_mask
