"""What is detected from one pose of a scene."""

from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import RowFormat, detected_places
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Rules, Task


class View(NamedTuple):
    """Hold the detections at one pose with a level camera.

    Attributes:
      place: float64 [2], world (x, z).
      yaw: heading, degrees.
      seen: distance in metres, category and world (x, z) of each detected object, the nearest first.
    """

    place: np.ndarray
    yaw: float
    seen: list[tuple[float, str, np.ndarray]]


def view_from(scene: Scene, task: Task, pose: tuple[float, float, float] | None = None) -> View:
    """Return what is detected from a pose of a scene.

    Args:
      scene: where.
      task: categories, rules and detector; a detector without errors reports what is there.
      pose: x and z in metres and heading in degrees; None for the first of the poses that detect most categories.

    Raises:
      InputError: nobody can stand there, or look that way.
    """
    rules, row_format = task.rules, RowFormat(len(task.categories))
    centres = cell_centres(scene, standable_cells(scene.reach))
    rows = compile_scene(scene, task).rows[:: len(rules.horizons)]  # of the level camera
    best = int(row_format.presence(rows).sum(axis=1).argmax()) if pose is None else _pose(centres, rules, *pose)
    cell, heading = divmod(best, rules.headings)
    place = centres[cell]
    detections = row_format.detections(rows[best])
    reported = detected_places(detections, place, rules.directions()[heading])
    ids, places = np.array(category_ids(scene.types, task.categories)), scene.boxes[:, [0, 2]]
    seen: list[tuple[float, str, np.ndarray]] = []
    for category in np.flatnonzero(detections[:, 0]):
        # A detection is rounded to bytes: the object is the one nearest to where it points.
        candidates = places[ids == category]
        point = candidates[np.linalg.norm(candidates - reported[category], axis=1).argmin()]
        seen.append((float(np.linalg.norm(point - place)), task.categories[category], point))
    return View(place, 360.0 / rules.headings * heading, sorted(seen, key=lambda item: item[0]))


def _pose(centres: np.ndarray, rules: Rules, x: float, z: float, yaw: float) -> int:
    """Return a level pose as cell * H + heading."""
    distance = np.linalg.norm(centres - (x, z), axis=1)
    cell, turn = int(np.argmin(distance)), 360.0 / rules.headings
    if not np.abs(centres[cell] - (x, z)).max() <= CELL / 2:
        raise InputError(
            f"--pose {x:g} {z:g} {yaw:g}: nobody can stand there; the nearest place is {centres[cell, 0]:g} "
            f"{centres[cell, 1]:g}"
        )
    if yaw % turn != 0:
        raise InputError(f"--pose {x:g} {z:g} {yaw:g}: give a heading that is a multiple of {turn:g} degrees")
    return cell * rules.headings + int(yaw // turn) % rules.headings
