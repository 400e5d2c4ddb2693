"""Plans and views of scenes as JSON, for replays.

Lengths are whole centimetres. Rectangles are [x, z, width, depth], from their lowest corner.
"""

import base64
import dataclasses

import numpy as np

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene, extent
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.detector import MAX_RANGE
from jaxnav.scenes.tables.observation_row import RowFormat, detected_places
from jaxnav.scenes.tables.visibility import cell_centres, rectangles
from jaxnav.viz.plan import TALL, view_cone

Rectangle = tuple[int, int, int, int]


@dataclasses.dataclass(frozen=True)
class Floor:
    """Hold where one can stand in a type of room; without a name, outside of rooms."""

    name: str
    cells: list[Rectangle]


@dataclasses.dataclass(frozen=True)
class View:
    """Hold what one pose shows.

    Attributes:
      x, z: of the agent.
      yaw: degrees clockwise from +z.
      cone: packed, the depths of every other ray of the view cone from left to right, as shares of `MAX_RANGE`.
      seen: index of the category, x, z and confidence in percent of each detection, the surest first.
    """

    x: int
    z: int
    yaw: float
    cone: str
    seen: list[tuple[int, int, int, int]]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Hold a scene from above, and views of it.

    Attributes:
      name, room: of the scene, and of its type of room.
      box: what the plan covers.
      floors: of each type of room.
      walls: that end the sight.
      furniture: rectangle and height from 0 to 100 of every object, the highest last.
      objects: index of the category, x and z of each object of a category.
      views: those that are replayed.
    """

    name: str
    room: str
    box: Rectangle
    floors: list[Floor]
    walls: list[Rectangle]
    furniture: list[tuple[int, ...]]
    objects: list[tuple[int, int, int]]
    views: list[View]


def pack(shares: np.ndarray) -> str:
    """Return numbers from 0 to 1 as base64, a byte each; others are clipped."""
    return base64.b64encode(np.rint(255.0 * np.clip(shares, 0.0, 1.0)).astype(np.uint8).tobytes()).decode()


def make_plan(scene: Scene, bank: Bank, index: int, poses: np.ndarray) -> Plan:
    """Return the plan of a scene with views from some poses.

    Args:
      scene: with at least one cell to stand on.
      bank: its tables.
      index: of the scene in the bank.
      poses: int [V], of the bank, in this scene.
    """
    low, high = extent(scene)
    x, y, z, sx, sy, sz = scene.boxes.T
    order = np.argsort(y + sy / 2)
    height = np.rint(100 * np.clip((y + sy / 2) / TALL, 0, 1)).astype(int)
    boxes = _centimetres(np.stack([x - sx / 2, z - sz / 2, sx, sz], axis=-1))
    ids = category_ids(scene.types, bank.task.categories)
    return Plan(
        name=scene.name,
        room=scene.room_type,
        box=tuple(_centimetres(np.concatenate([low, high - low])).tolist()),
        floors=_floors(scene),
        walls=_rectangles(scene, scene.walls),
        furniture=[(*boxes[i].tolist(), int(height[i])) for i in order],
        objects=[(ids[i], *_centimetres(scene.boxes[i, [0, 2]]).tolist()) for i in np.flatnonzero(np.array(ids) >= 0)],
        views=_views(scene, bank, index, poses),
    )


def _floors(scene: Scene) -> list[Floor]:
    kinds = sorted({room.type for room in scene.rooms})
    named = {kind: np.any([room.cells for room in scene.rooms if room.type == kind], axis=0) for kind in kinds}
    free = scene.reach & ~np.any([*named.values(), np.zeros_like(scene.reach)], axis=0)
    return [Floor(kind, _rectangles(scene, cells & scene.reach)) for kind, cells in {"": free, **named}.items()]


def _views(scene: Scene, bank: Bank, index: int, poses: np.ndarray) -> list[View]:
    rules, row_format = bank.task.rules, RowFormat(len(bank.task.categories))
    centres = cell_centres(scene, standable_cells(scene.reach))
    views = []
    for pose in poses:
        cell, heading, _ = rules.split(int(pose))
        place = centres[cell - bank.first_cell[index]]
        yaw = 360.0 / rules.headings * heading
        outline = view_cone(scene, rules, place, yaw)
        depth = np.linalg.norm(outline[1::2] - place, axis=1) / MAX_RANGE
        detections = row_format.detections(bank.rows[pose])
        seen = sorted(np.flatnonzero(detections[:, 0]), key=lambda i: -int(detections[i, 0]))
        points = _centimetres(detected_places(detections[seen], place, rules.directions()[heading]))
        sure = np.rint(detections[seen, 0] / 2.55).astype(int)
        listed = [(int(i), *point, int(c)) for i, point, c in zip(seen, points.tolist(), sure, strict=True)]
        x, z = _centimetres(place).tolist()
        views.append(View(x, z, yaw, pack(depth), listed))
    return views


def _rectangles(scene: Scene, mask: np.ndarray) -> list[Rectangle]:
    z0, x0, z1, x1 = rectangles(mask).T
    corner = np.asarray(scene.origin) + CELL * (np.stack([x0, z0], axis=-1) - 0.5)
    size = CELL * np.stack([x1 - x0, z1 - z0], axis=-1)
    return [tuple(each) for each in _centimetres(np.concatenate([corner, size], axis=-1)).tolist()]


def _centimetres(metres: np.ndarray) -> np.ndarray:
    return np.rint(100.0 * metres).astype(int)
