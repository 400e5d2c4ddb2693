"""Sightings: which objects can be seen from which poses."""

from typing import NamedTuple

import numpy as np

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.detector import detection_range, object_size
from jaxnav.scenes.tables.visibility import TOLERANCE, line_of_sight, offsets_in_view
from jaxnav.scenes.task import Rules, Task


class Targets(NamedTuple):
    """Hold the N objects of categories in a scene.

    Attributes:
      objects: int [N], indices into the scene.
      category: int [N].
      distance: float64 [C, N], horizontal metres from each cell to the centre.
    """

    objects: np.ndarray
    category: np.ndarray
    distance: np.ndarray


class Sightings(NamedTuple):
    """Hold which objects have a clear line to which cells.

    There are M pairs, sorted by distance: the nearest object (then the first in the scene) is last.

    Attributes:
      cell: int [M].
      category: int [M], of the object.
      distance: float64 [M], horizontal metres from the cell to the object's centre.
      size: float64 [M], of the object, metres, see `object_size`.
      ahead, right: float64 [M, H], metres to the object's centre, by heading.
      in_view: bool [M, H, T], whether the object is in the camera's view, by heading and horizon.
    """

    cell: np.ndarray
    category: np.ndarray
    distance: np.ndarray
    size: np.ndarray
    ahead: np.ndarray
    right: np.ndarray
    in_view: np.ndarray

    def expand(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where pairs are in view.

        Args:
          pairs: bool [M], the pairs to choose.

        Returns:
          Pair, heading and pose, int [...] each, in the order of the pairs.
        """
        _, headings, horizons = self.in_view.shape
        pair, heading, horizon = np.nonzero(self.in_view & pairs[:, None, None])
        return pair, heading, (self.cell[pair] * headings + heading) * horizons + horizon

    def within(self, distance: float, shape: tuple[int, int]) -> np.ndarray:
        """Return where a category is in view within a distance.

        Args:
          distance: horizontal metres.
          shape: (P, K).

        Returns:
          bool [P, K].
        """
        pair, _, pose = self.expand(self.distance <= distance + TOLERANCE)
        table = np.zeros(shape, bool)
        table[pose, self.category[pair]] = True
        return table


def find_sightings(scene: Scene, rules: Rules, centres: np.ndarray, targets: Targets, limit: np.ndarray) -> Sightings:
    """Find which objects have a clear line to which cells.

    Args:
      scene: whose walls and opaque boxes hide things.
      rules: camera, headings and horizons.
      centres: float64 [C, 2], world (x, z) of the cells.
      targets: the objects.
      limit: float [N], the distance up to which each of them counts, metres.
    """
    size, distance = object_size(scene.boxes[targets.objects]), targets.distance
    cell, target = np.nonzero(distance <= limit + TOLERANCE)
    clear = line_of_sight(scene, rules, centres[cell], targets.objects[target])
    cell, target = cell[clear], target[clear]
    order = np.lexsort((-target, -distance[cell, target]))
    cell, target = cell[order], target[order]
    offsets = offsets_in_view(rules, centres[cell], scene.boxes[targets.objects[target], :3])
    return Sightings(cell, targets.category[target], distance[cell, target], size[target], *offsets)


def detect(scene: Scene, task: Task, sightings: Sightings, num_poses: int) -> np.ndarray:
    """Return what the detector reports at every pose.

    Returns:
      uint8 [P, K, 4], see `Detector.detect`.
    """
    shape = (num_poses, len(task.categories))
    pair, heading, pose = sightings.expand(sightings.distance <= detection_range(sightings.size) + TOLERANCE)
    category = sightings.category[pair]
    seen = np.zeros(shape, bool)
    seen[pose, category] = True
    # Of several objects of a category the nearest counts: where indices repeat, the last value stays.
    fields = np.zeros((4, *shape))
    ahead, right = sightings.ahead[pair, heading], sightings.right[pair, heading]
    fields[:, pose, category] = ahead, right, sightings.distance[pair], sightings.size[pair]
    return task.detector.detect(scene.name, task.rules.half_view[0], seen, *fields)
