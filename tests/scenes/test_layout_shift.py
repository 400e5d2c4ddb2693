"""Layout shift: categories of similar size exchange places."""

import collections
import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.real_scenes import ITHOR, require
from support.scene_records import assert_scenes_equal
from support.scenes import draw

from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.layout_shift import exchange_places
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import object_size
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import load_scenes, make_generated_scenes, shift_scenes

TASK = Task()
GOALS = Task(goals=("AlarmClock", "Book", "Bowl", "CellPhone"))
SHIFTS = st.floats(0, 1)
SEEDS = st.integers(0, 2**32)
NAMES = st.text(max_size=12)
TYPES = st.sampled_from((*ITHOR_CATEGORIES, "Stool", "Sofa", "Window"))
SIZES = st.sampled_from((0.1, 0.2, 0.4, 1.0))
SIZED_OBJECTS = st.lists(st.tuples(TYPES, st.tuples(SIZES, SIZES, SIZES)), max_size=30)


def shelf_scene(sized_objects, name: str = "den") -> Scene:
    """Return a scene with objects (type, size) in a row, 1 m apart, on a shelf at 0.6 m, far from the cells."""
    objects = []
    for i, (kind, size) in enumerate(sized_objects):
        objects.append((kind, 9.0 + i, 0.6 + size[1] / 2, 9.0, *size))
    return dataclasses.replace(draw(["..", ".."], *objects), name=name)


def grow_along_vocabulary(types) -> list[tuple[str, tuple[float, float, float]]]:
    """Return objects (type, size) whose volume grows along the vocabulary."""
    ids = category_ids(tuple(types), ITHOR_CATEGORIES)
    return [(kind, (0.1 + 0.01 * category, 0.1, 0.1)) for kind, category in zip(types, ids, strict=True)]


def ids_of(scene: Scene) -> list[int]:
    return list(category_ids(scene.types, ITHOR_CATEGORIES))


def category_at_places(scene: Scene, shift: float, seed: int = 0, task: Task = TASK) -> dict[int, int]:
    """Map each category to the category at its places after the exchange."""
    return dict(zip(ids_of(scene), ids_of(exchange_places(scene, task, shift, seed)), strict=True))


#: Chairs measure (0.250 + 0.150) / 2 = 0.200 in the mean, less than the bin, though the larger one measures more.
DEN = {
    "Fridge": (1.0, 2.0, 1.0),  # 2.000
    "Stool": (0.5, 0.6, 0.5),  # 0.150
    "Book": (0.2, 0.1, 0.2),  # 0.004
    "Sofa": (2.0, 0.5, 1.0),  # 1.000, no category
    "Chair": (0.5, 1.0, 0.5),  # 0.250
    "Bowl": (0.2, 0.1, 0.3),  # 0.006
    "GarbageCan": (0.4, 1.375, 0.4),  # 0.220
}


def rename_types(new_types: dict[str, str]) -> tuple[str, ...]:
    """Return the types of the den with some of them renamed."""
    return tuple(new_types.get(kind, kind) for kind in DEN)


def test_exchange_places_swaps_neighbours_in_size():
    scene = shelf_scene(list(DEN.items()))
    # From the smallest: Book, Bowl | Chair, GarbageCan, Fridge. The first chair, a stool, comes to the only place.
    pair_exchange = {"Book": "Bowl", "Bowl": "Book"}
    triple_exchange = {"Chair": "GarbageCan", "Stool": "GarbageCan", "GarbageCan": "Fridge", "Fridge": "Stool"}
    assert exchange_places(scene, TASK, 1, 0).types == rename_types(pair_exchange | triple_exchange)

    # Half of the two groups is one of them; the seed decides which one.
    half_shifts = {exchange_places(scene, TASK, 0.5, seed).types for seed in range(20)}
    assert half_shifts == {rename_types(pair_exchange), rename_types(triple_exchange)}


def test_exchange_places_keeps_box_sizes_and_undersides():
    scene = shelf_scene([("Bowl", (0.2, 0.1, 0.3)), ("Pan", (0.5, 0.3, 0.4)), ("Bowl", (0.1, 0.2, 0.1))])
    turned_scene = dataclasses.replace(scene, yaws=np.array([0.0, 90.0, 180.0]))
    shifted_scene = exchange_places(turned_scene, TASK, 1, 0)
    assert shifted_scene.types == ("Pan", "Bowl", "Pan")  # a pan is repeated, the second bowl is left out

    # Undersides are at 0.6 m; the bowl and the first pan are turned by a quarter with their places.
    expected = [[9, 0.75, 9, 0.4, 0.3, 0.5], [10, 0.65, 9, 0.3, 0.1, 0.2], [11, 0.75, 9, 0.4, 0.3, 0.5]]
    np.testing.assert_allclose(shifted_scene.boxes, expected)
    np.testing.assert_array_equal(shifted_scene.yaws, turned_scene.yaws)


def test_exchange_places_keeps_a_box_under_objects_or_beside_cells():
    chair = ("Chair", 2.0, 0.5, 0.0, 0.5, 1.0, 0.5)
    garbage_can = ("GarbageCan", 4.0, 0.25, 0.0, 0.4, 0.5, 0.4)
    free_scene = draw(["......"], chair, garbage_can)
    shifted_scene = exchange_places(free_scene, TASK, 1, 0)
    np.testing.assert_allclose(shifted_scene.boxes[:, 3:], free_scene.boxes[[1, 0], 3:])

    # A cell 0.22 m from the centre of the can is covered by a chair, but not by a can.
    offsets = np.array([[0] * 6, [1.25 + 0.22 - 4, 0, 0, 0, 0, 0]])
    near_scene = dataclasses.replace(free_scene, boxes=free_scene.boxes + offsets)
    shifted_scene = exchange_places(near_scene, TASK, 1, 0)
    assert shifted_scene.types == ("GarbageCan", "Chair")
    np.testing.assert_allclose(shifted_scene.boxes[:, 3], [0.4, 0.4])

    # An object on the chair stays in its place, and so does the box below it, if it is detected from as far: both of
    # 0.6 m and more from 5 m, but a can of 0.45 m from 3.7 m.
    large_can = ("GarbageCan", 4.0, 0.4, 0.0, 0.6, 0.8, 0.6)
    for can, chair_width in ((garbage_can, 0.4), (large_can, 0.5)):
        scene = draw(["......"], chair, can, ("Towel", 2.0, 1.05, 0.0, 0.3, 0.1, 0.3))
        scene = dataclasses.replace(scene, parents=np.array([-1, -1, 0]))
        np.testing.assert_allclose(exchange_places(scene, TASK, 1, 0).boxes[:, 3], [chair_width, 0.5, 0.3])


@given(SIZED_OBJECTS, SHIFTS, SEEDS, NAMES)
def test_exchange_places_deranges_a_share_of_the_categories(objects, shift, seed, name):
    scene = shelf_scene(objects, name)
    shifted_scene = exchange_places(scene, TASK, shift, seed)
    new_category = category_at_places(scene, shift, seed)
    ids_before = ids_of(scene)
    ids_after = ids_of(shifted_scene)

    # One category comes to all places of another; so the numbers of objects are permuted.
    assert [new_category[category] for category in ids_before] == ids_after
    assert set(new_category.values()) == set(new_category)
    assert sorted(collections.Counter(ids_before).values()) == sorted(collections.Counter(ids_after).values())

    # Objects of no category or of one that is not exchanged stay; so do centres, undersides, cells, walls, name, ...
    is_same = np.array(ids_before, int) == np.array(ids_after, int)
    assert new_category.get(-1, -1) == -1
    np.testing.assert_array_equal(np.array(shifted_scene.types)[is_same], np.array(scene.types)[is_same])
    np.testing.assert_array_equal(shifted_scene.boxes[is_same], scene.boxes[is_same])
    np.testing.assert_array_equal(shifted_scene.boxes[:, [0, 2]], scene.boxes[:, [0, 2]])
    np.testing.assert_allclose(shifted_scene.boxes[:, 1] - shifted_scene.boxes[:, 4] / 2, np.full(len(objects), 0.6))
    assert_scenes_equal(dataclasses.replace(shifted_scene, types=scene.types, boxes=scene.boxes), scene)

    # Every object has the size of one of its category.
    known_sizes = set(zip(ids_before, object_size(scene.boxes).round(9), strict=True))
    assert set(zip(ids_after, object_size(shifted_scene.boxes).round(9), strict=True)) <= known_sizes

    # The number of groups is the nearest one to the share, but at least one; all at full shift.
    num_exchanged = sum(old != new for old, new in new_category.items())
    num_present = len(set(ids_before) - {-1})
    num_groups = num_present // 2
    if shift == 0 or num_groups == 0:
        assert num_exchanged == 0
    else:
        assert abs(num_exchanged // 2 - max(1, shift * num_groups)) <= 0.5
    assert num_present % 2 or num_exchanged % 2 == 0
    assert num_exchanged == num_present or shift < 1 or num_groups == 0


@given(SIZED_OBJECTS, SEEDS, NAMES)
def test_exchange_places_pairs_every_category_with_a_neighbour_in_size(objects, seed, name):
    scene = shelf_scene(objects, name)
    volumes = np.prod([size for _, size in objects], axis=-1)
    ids = np.array(ids_of(scene))
    mean_volume = {category: volumes[ids == category].mean() for category in set(ids) - {-1}}

    # Only one category of the same group, and only of three, may lie between the two that exchange.
    for old, new in category_at_places(scene, 1.0, seed).items():
        if old != new:
            low, high = sorted((mean_volume[old], mean_volume[new]))
            num_between = sum(low + 1e-9 < volume < high - 1e-9 for volume in mean_volume.values())
            assert num_between <= len(mean_volume) % 2


@given(SIZED_OBJECTS, SHIFTS, SEEDS)
def test_exchange_places_swaps_goals_with_goals(objects, shift, seed):
    is_goal = GOALS.is_goal()
    for old, new in category_at_places(shelf_scene(objects), shift, seed, GOALS).items():
        assert old == new or is_goal[old] == is_goal[new]


@given(SIZED_OBJECTS, SHIFTS, SHIFTS, SEEDS, NAMES)
def test_exchange_places_at_a_larger_shift_extends_the_smaller_one(objects, first_shift, second_shift, seed, name):
    scene = shelf_scene(objects, name)
    at_small_shift = category_at_places(scene, min(first_shift, second_shift), seed)
    at_large_shift = category_at_places(scene, max(first_shift, second_shift), seed)
    for old, new in at_small_shift.items():
        assert new in (old, at_large_shift[old])


@pytest.mark.parametrize(
    ("num_present", "shift", "num_exchanged"),
    [(4, 0.01, 2), (10, 0.25, 2), (10, 0.34, 4), (10, 0.66, 6), (10, 1, 10), (3, 0.1, 3), (11, 1, 11)],
)
def test_exchange_places_rounds_the_share(num_present, shift, num_exchanged):
    scene = shelf_scene(grow_along_vocabulary(ITHOR_CATEGORIES[:num_present]))
    shifted_scene = exchange_places(scene, TASK, shift, 0)
    assert (np.array(scene.types) != np.array(shifted_scene.types)).sum() == num_exchanged


def test_exchange_places_orders_equal_volumes_by_vocabulary():
    scene = shelf_scene([(kind, (0.6, 0.6, 0.05)) for kind in ITHOR_CATEGORIES[3::-1]])
    assert category_at_places(scene, 1.0) == {0: 1, 1: 0, 2: 3, 3: 2}


def test_exchange_places_treats_an_alias_as_its_category():
    scene = shelf_scene(grow_along_vocabulary(["Stool", "Book", "Chair", "Sofa"]))
    assert exchange_places(scene, TASK, 1, 0).types == ("Book", "Stool", "Book", "Sofa")


@pytest.mark.parametrize(
    ("types", "shift"), [(["Book", "Chair"], 0.0), (["Stool", "Chair", "Sofa"], 1.0), (["Sofa"], 1), ([], 1.0)]
)
def test_exchange_places_returns_the_scene_without_a_possible_exchange(types, shift):
    scene = shelf_scene(grow_along_vocabulary(types))
    assert exchange_places(scene, TASK, shift, 0) is scene


def test_exchange_places_depends_on_scene_name_and_seed_alone():
    objects = grow_along_vocabulary(ITHOR_CATEGORIES)
    first_exchange = exchange_places(shelf_scene(objects), TASK, 0.5, 0)
    assert exchange_places(shelf_scene(objects), TASK, 0.5, 0).types == first_exchange.types

    # Order and number of the objects do not count.
    reordered = exchange_places(shelf_scene([*objects[::-1], *grow_along_vocabulary(["Book", "Sofa"])]), TASK, 0.5, 0)
    assert reordered.types[:22] == first_exchange.types[::-1]

    # Name and seed do.
    assert exchange_places(shelf_scene(objects, "other"), TASK, 0.5, 0).types != first_exchange.types
    assert exchange_places(shelf_scene(objects), TASK, 0.5, 1).types != first_exchange.types

    # At full shift all exchange, for any name and seed.
    full_shift = exchange_places(shelf_scene(objects), TASK, 1, 0)
    assert exchange_places(shelf_scene(objects, "other"), TASK, 1, 1).types == full_shift.types


@pytest.mark.parametrize(("shift", "seed"), [(-0.1, 0), (1.1, 0), (float("nan"), 0), (0.5, -1)])
def test_shift_scenes_refuses_impossible_shifts_and_seeds(shift, seed):
    with pytest.raises(InputError, match="seed of at least 0 and a shift from 0 to 1"):
        shift_scenes(make_generated_scenes("rooms", "val"), TASK, shift, seed)


def test_exchange_places_keeps_sizes_in_real_scenes():
    scenes = load_scenes(require(ITHOR), "val")
    num_kept = 0
    num_moved = 0
    for i in range(len(scenes)):
        before = scenes[i]
        after = exchange_places(before, TASK, 1, 0)

        # The sizes of each type in the original scene.
        sizes_by_type = collections.defaultdict(set)
        for kind, size in zip(before.types, object_size(before.boxes).round(6), strict=True):
            sizes_by_type[kind].add(size)

        # Count the exchanged objects, and those with a size of their new type.
        new_sizes = object_size(after.boxes).round(6)
        for old_type, new_type, size in zip(before.types, after.types, new_sizes, strict=True):
            if old_type != new_type:
                num_moved += 1
                num_kept += size in sizes_by_type[new_type]
    assert num_moved > 150
    # The remaining objects are in the box of a place by the cells, or on which something rests.
    assert num_kept > 0.9 * num_moved
