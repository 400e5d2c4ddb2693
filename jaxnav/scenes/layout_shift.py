"""Layout shift: categories exchange their places, those of similar size or by a fitted exchange.

`exchange_places` is a dial for how much of the learned layout is wrong in a scene, from 0 (none) to 1 (all categories).
"""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.context_exchange import ContextExchange
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import detection_range, object_size
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Task

#: Categories that exchange their places: objects of each go to the places of the one before it.
Cycle = Sequence[int]


def exchange_places(
    scene: Scene, task: Task, shift: float, seed: int, context_exchange: ContextExchange | None = None
) -> Scene:
    """Exchange the places of categories: of similar size, or by a fitted context exchange.

    With `context_exchange`, the first `shift` of its cycles for the scene's room type, rounded, and at least one,
    exchange. They are equal in all scenes of a room type; absent categories leave their cycle.

    Without it, the exchange is drawn for each scene. The categories present, ordered by the mean volume of their boxes,
    form pairs of neighbours: goals among goals, other categories among other categories. The three largest form one
    group if their number is odd. The groups exchange in a random order, the first `shift` of them, rounded, and at
    least one.

    Objects of each category of a group or cycle go to the places of the category before it, those of the first one to
    the places of the last. If there are more places than objects, objects are repeated; if there are fewer, the last
    objects are dropped.

    A place is a centre (x, z), the height of the underside, a yaw and a support. An object keeps its own box, turned
    with the place, and with it the range in which it is detected. Only where its box would cover a standable cell, or
    where other objects rest on a place and the range is equal, it gets the box of the place's former object. Standable
    cells, walls and the number of objects stay.

    Args:
      scene: the scene.
      task: task whose categories and goals are exchanged.
      shift: share of the groups, from 0 to 1.
      seed: seed of at least 0, which fixes the order of the groups together with the scene's name.
      context_exchange: the exchange that misleads most; see `fit_context_exchange`.

    Raises:
      InputError: there is no exchange for the room type of the scene.

    Returns:
      The shifted scene; `scene` itself if `shift` is 0 or nothing can be exchanged.
    """
    category = np.array(category_ids(scene.types, task.categories), int)
    if shift == 0:
        return scene
    if context_exchange is None:
        volumes = scene.boxes[:, 3:].prod(axis=1)
        cycles = _draw_size_cycles(category, volumes, task.is_goal(), shift, [seed, zlib.crc32(scene.name.encode())])
    else:
        if scene.room_type not in context_exchange:
            raise InputError(
                f"scene {scene.name!r}: an exchange by context is fitted to rooms of its type ({scene.room_type}), and "
                "there are none among the training scenes; use --shift-by size"
            )
        room_cycles = context_exchange[scene.room_type]
        cycles = [_present_part(cycle, category) for cycle in _first_share(room_cycles, shift)]

    # The object that moves to each place.
    new_objects = np.arange(len(category))
    for cycle in cycles:
        new_categories = [*cycle[1:], *cycle[:1]]
        for old_category, new_category in zip(cycle, new_categories, strict=True):
            old_places = np.flatnonzero(category == old_category)
            moving_objects = np.flatnonzero(category == new_category)
            new_objects[old_places] = np.resize(moving_objects, len(old_places))

    if (new_objects == np.arange(len(category))).all():
        return scene
    new_types = tuple(scene.types[i] for i in new_objects)
    return dataclasses.replace(scene, types=new_types, boxes=_boxes_at_new_places(scene, new_objects))


def _first_share(cycles: Sequence[Cycle], share: float) -> Sequence[Cycle]:
    """Return the first cycles: a share of them, rounded, and at least one."""
    return cycles[: max(1, round(share * len(cycles)))]


def _present_part(cycle: Cycle, category: np.ndarray) -> Cycle:
    """Return the categories of a cycle that a scene has; `category` is int [N]."""
    return [k for k in cycle if (category == k).any()]


def _draw_size_cycles(
    category: np.ndarray, volumes: np.ndarray, is_goal: np.ndarray, shift: float, seed: Sequence[int]
) -> Sequence[Cycle]:
    """Draw the groups of similar size that exchange in a scene; see `_group_by_size`.

    The order of the groups depends on the seed alone, so a larger shift exchanges a superset of categories.
    """
    size_groups = _group_by_size(category, volumes, is_goal)
    group_order = np.random.default_rng(seed).permutation(len(size_groups))
    return _first_share([size_groups[group_index] for group_index in group_order], shift)


def _group_by_size(category: np.ndarray, volumes: np.ndarray, is_goal: np.ndarray) -> list[list[int]]:
    """Group the categories present by size, two or three in a group.

    Args:
      category: int [N], category of each object, -1 for none.
      volumes: float [N], of the objects' boxes.
      is_goal: bool [K]; goals and other categories are in different groups.
    """
    # The categories present from the smallest to the largest mean volume; ties in the order of the vocabulary.
    present_categories = sorted(set(category.tolist()) - {-1})
    by_size = sorted(present_categories, key=lambda k: volumes[category == k].mean())

    # Neighbours in size form pairs; the last one of an odd number joins the last pair.
    size_groups: list[list[int]] = []
    for among_goals in (True, False):
        candidates = [k for k in by_size if is_goal[k] == among_goals]
        size_pairs = [candidates[i : i + 2] for i in range(0, len(candidates) - 1, 2)]
        if size_pairs and len(candidates) % 2:
            size_pairs[-1].append(candidates[-1])
        size_groups += size_pairs
    return size_groups


def _boxes_at_new_places(scene: Scene, new_objects: np.ndarray) -> np.ndarray:
    """Return the boxes after the exchange, float64 [N, 6].

    Args:
      scene: the places, and the objects.
      new_objects: int [N], the object that moves to each place.
    """
    old_boxes = scene.boxes
    new_boxes = old_boxes.copy()

    # Objects keep their size, with width and depth swapped where the place is turned by a quarter.
    new_boxes[:, 3:] = old_boxes[new_objects, 3:]
    is_quarter_turned = np.rint((scene.yaws - scene.yaws[new_objects]) / 90.0) % 2 == 1
    new_boxes[is_quarter_turned, 3:] = new_boxes[is_quarter_turned][:, [5, 4, 3]]
    new_boxes[:, 1] += (new_boxes[:, 4] - old_boxes[:, 4]) / 2  # the underside stays

    # The old box stays where the new one would cover a standable cell.
    cells = cell_centres(scene, standable_cells(scene.reach))
    is_within = np.abs(cells[:, None] - new_boxes[:, [0, 2]]) < new_boxes[:, [3, 5]] / 2  # [C, N, 2]
    covers_cell = is_within.all(axis=-1).any(axis=0)

    # It also stays under objects that rest on it, if the range of detection is equal.
    is_support = np.isin(np.arange(len(old_boxes)), scene.parents)
    same_range = detection_range(object_size(new_boxes)) == detection_range(object_size(old_boxes))
    keep_old_box = covers_cell | (is_support & same_range)
    return np.where(keep_old_box[:, None], old_boxes, new_boxes)
