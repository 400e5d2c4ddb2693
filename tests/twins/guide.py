"""The twin of a scene by pose index, and comparisons of the twin with compiled tables.

Byte rows are unpacked as docs/environment.md says, without `RowFormat`.
"""

import math
from collections.abc import Iterator

import numpy as np
from twins.environment import Twin
from twins.scene import largest_component

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Task


class Guide:
    """The twin of a scene, with its poses by index."""

    def __init__(self, scene: Scene, task: Task):
        reachable_cells = {(iz, ix) for iz, ix in np.argwhere(scene.reach).tolist()}
        self.cells = sorted(largest_component(reachable_cells))
        self.rules = task.rules
        self.cell_indices = {cell: index for index, cell in enumerate(self.cells)}
        self.twin = Twin(scene, task.categories, task.rules, 0, self.cells[0], 0, 0, 1)

    def place(self, pose: int, goal: int = 0, step_limit: int = 2) -> Twin:
        """Start an episode at a pose index within the scene."""
        cell_index, pose_in_cell = divmod(pose, self.rules.poses_per_cell)
        heading, horizon = divmod(pose_in_cell, len(self.rules.horizons))
        self.twin.reset(goal, self.cells[cell_index], heading, horizon, step_limit)
        return self.twin

    def pose(self) -> int:
        """Return the index of the twin's pose within the scene."""
        cell_and_heading = self.cell_indices[self.twin.cell] * self.rules.headings + self.twin.heading
        return cell_and_heading * len(self.rules.horizons) + self.twin.horizon


def entry_matches(entry: np.ndarray, instance: tuple[float, float, float]) -> bool:
    """Check four bytes against an instance, within half a quantum."""
    ahead, right, apparent_size = instance
    distance = math.hypot(ahead, right)
    size = apparent_size * max(distance, 0.25)
    detection_range = min(max(size / 0.12, 1.5), 5.0)
    confidence = 1 - 0.5 * distance / detection_range
    values = (255 * confidence, 51 * ahead, 128 + 25.4 * right, min(127.5 * apparent_size, 255))
    return all(abs(int(byte) - value) <= 0.5 + 1e-6 for byte, value in zip(entry, values, strict=True))


def same_distance(metres: float, expected: float) -> bool:
    """Check that a distance less a metre equals the twin's goal distance."""
    distance = max(float(metres) - 1.0, 0.0)
    return distance == expected or abs(distance - expected) < 1e-6


def row_differences(row: np.ndarray, twin: Twin, num_categories: int, has_counts: bool = False) -> Iterator[str]:
    """Yield the names of the parts that differ between row and twin.

    Args:
      row: uint8 [R], an observation row.
      twin: the twin at the pose of the row.
      num_categories: number of categories.
      has_counts: whether the row holds instance counts, which follow the view.
    """
    # The view, two bits per cell.
    entries, view = np.split(row, [4 * num_categories])
    view_cells = (view[:31, None] >> [0, 2, 4, 6] & 3).ravel()[:121]
    if view_cells.tolist() != twin.view():
        yield "view"
    if has_counts and view[31 : 31 + num_categories].tolist() != twin.instance_counts():
        yield "instance counts"

    # Four bytes per category.
    for entry, instances in zip(entries.reshape(-1, 4), twin.detections(), strict=True):
        if bool(entry[0]) != bool(instances):
            yield "presence"
        elif instances and not any(entry_matches(entry, instance) for instance in instances):
            yield "bytes"
        elif not instances and entry.any():
            yield "bytes of nothing"
