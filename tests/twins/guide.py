"""The twin of a scene, and comparisons with compiled tables.

The byte row is taken apart here by the words of docs/environment.md, without `RowFormat`.
"""

import math
from collections.abc import Iterator

import numpy as np
from twins.environment import Twin
from twins.scene import largest_component

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import Task


class Guide:
    """The twin of a scene, with its poses by number."""

    def __init__(self, scene: Scene, task: Task):
        reach = largest_component({(iz, ix) for iz, ix in np.argwhere(scene.reach).tolist()})
        self.cells = sorted(reach)
        self.rules = task.rules
        self.index = {cell: i for i, cell in enumerate(self.cells)}
        self.twin = Twin(scene, task.categories, task.rules, 0, self.cells[0], 0, 0, 1)

    def place(self, pose: int, goal: int = 0, step_limit: int = 2) -> Twin:
        """Start an episode at a pose index within the scene."""
        cell, turn = divmod(pose, self.rules.poses_per_cell)
        heading, horizon = divmod(turn, len(self.rules.horizons))
        self.twin.reset(goal, self.cells[cell], heading, horizon, step_limit)
        return self.twin

    def pose(self) -> int:
        """Return the index of the twin's pose within the scene."""
        cell_and_heading = self.index[self.twin.cell] * self.rules.headings + self.twin.heading
        return cell_and_heading * len(self.rules.horizons) + self.twin.horizon


def agrees(entry: np.ndarray, instance: tuple[float, float, float]) -> bool:
    """Check four bytes against an instance, within half a quantum."""
    ahead, right, apparent = instance
    distance = math.hypot(ahead, right)
    reach = min(max(apparent * max(distance, 0.25) / 0.12, 1.5), 5.0)
    values = (255 * (1 - 0.5 * distance / reach), 51 * ahead, 128 + 25.4 * right, min(127.5 * apparent, 255))
    return all(abs(int(byte) - value) <= 0.5 + 1e-6 for byte, value in zip(entry, values, strict=True))


def same_distance(metres: float, expected: float) -> bool:
    """Check a distance against the twin's, less a metre."""
    distance = max(float(metres) - 1.0, 0.0)
    return distance == expected or abs(distance - expected) < 1e-6


def row_differences(row: np.ndarray, twin: Twin, num_categories: int, has_counts: bool = False) -> Iterator[str]:
    """Yield the names of what differs between row and twin; rows with instance counts hold them after the view."""
    entries, view = np.split(row, [4 * num_categories])
    view_cells = (view[:31, None] >> [0, 2, 4, 6] & 3).ravel()[:121]
    if view_cells.tolist() != twin.view():
        yield "view"
    if has_counts and view[31 : 31 + num_categories].tolist() != twin.instance_counts():
        yield "instance counts"
    for entry, instances in zip(entries.reshape(-1, 4), twin.detections(), strict=True):
        if bool(entry[0]) != bool(instances):
            yield "presence"
        elif instances and not any(agrees(entry, instance) for instance in instances):
            yield "bytes"
        elif not instances and entry.any():
            yield "bytes of nothing"
