"""The layout shift: categories exchange their places."""

import dataclasses
import zlib

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.detector import detection_range, object_size
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Task


def exchange_places(scene: Scene, task: Task, shift: float, seed: int) -> Scene:
    """Exchange the places of categories of similar size.

    The categories present, ordered by the mean volume of their boxes, form pairs of neighbours: goals among goals,
    others among others. The three largest form one group if their number is odd. In a random order of the groups, the
    first `shift` of them, rounded, and at least one, exchange: the objects of each category go to the places of the
    next smaller one, those of the smallest to the places of the largest. Where there are more places than objects,
    objects are repeated; where there are fewer, the last are left out.

    A place is a centre (x, z), the height of the underside, a yaw and a support. An object keeps its own box, turned
    with the place, and with it the range in which it is detected. Only where it would cover a standable cell, or where
    others rest on a place and the range is the same, it takes the box that was there. Standable cells, walls and the
    number of objects stay.

    Args:
      scene: the scene.
      task: its categories and goals.
      shift: share of the groups, from 0 to 1.
      seed: at least 0; with the scene's name it fixes the order of the groups.

    Returns:
      The shifted scene; `scene` itself where `shift` is 0 or nothing can be exchanged.
    """
    ids = np.array(category_ids(scene.types, task.categories), int)
    groups = _like_sized(ids, scene.boxes[:, 3:].prod(axis=1), task.is_goal())
    if shift == 0 or not groups:
        return scene
    order = np.random.default_rng([seed, zlib.crc32(scene.name.encode())]).permutation(len(groups))
    comes = np.arange(len(ids))  # the object that comes to each place
    for group in (groups[g] for g in order[: max(1, round(shift * len(groups)))]):
        for old, new in zip(group, group[1:] + group[:1], strict=True):
            places, objects = np.flatnonzero(ids == old), np.flatnonzero(ids == new)
            comes[places] = np.resize(objects, len(places))
    return dataclasses.replace(scene, types=tuple(scene.types[i] for i in comes), boxes=_placed(scene, comes))


def check_shift(shift: float, seed: int) -> None:
    """Check the numbers of a layout shift.

    Raises:
      InputError: `shift` or `seed` is out of range.
    """
    if seed < 0 or not 0.0 <= shift <= 1.0:  # NaN is refused, too
        raise InputError(f"layout shift: seed {seed}, shift {shift}; give a seed of at least 0, a shift from 0 to 1")


def _like_sized(ids: np.ndarray, volumes: np.ndarray, is_goal: np.ndarray) -> list[list[int]]:
    """Group the categories present by size.

    Args:
      ids: int [N], category of each object, -1 for none.
      volumes: float [N], of the objects' boxes.
      is_goal: bool [K]; goals and others are in different groups.
    """
    present = sorted(set(ids.tolist()) - {-1})
    ordered = sorted(present, key=lambda k: volumes[ids == k].mean())  # ties in the order of the vocabulary
    groups = []
    for kind in (True, False):
        alike = [k for k in ordered if is_goal[k] == kind]
        pairs = [alike[i : i + 2] for i in range(0, len(alike) - 1, 2)]
        if pairs and len(alike) % 2:
            pairs[-1].append(alike[-1])
        groups += pairs
    return groups


def _placed(scene: Scene, comes: np.ndarray) -> np.ndarray:
    """Return the boxes after the exchange, float64 [N, 6].

    Args:
      scene: the places, and the objects.
      comes: int [N], the object that comes to each place.
    """
    old, new = scene.boxes, scene.boxes.copy()
    new[:, 3:] = old[comes, 3:]
    turned = np.rint((scene.yaws - scene.yaws[comes]) / 90.0) % 2 == 1
    new[turned, 3:] = new[turned][:, [5, 4, 3]]
    new[:, 1] += (new[:, 4] - old[:, 4]) / 2  # the underside stays
    cells = cell_centres(scene, standable_cells(scene.reach))
    inside = np.abs(cells[:, None] - new[:, [0, 2]]) < new[:, [3, 5]] / 2  # [C, N, 2]
    covers = inside.all(axis=-1).any(axis=0)
    supports = np.isin(np.arange(len(old)), scene.parents)
    alike = detection_range(object_size(new)) == detection_range(object_size(old))
    stays = covers | (supports & alike)
    return np.where(stays[:, None], old, new)
