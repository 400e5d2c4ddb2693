"""The layout shift: categories of like size exchange their places."""

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


def scene_of(objects, name: str = "den") -> Scene:
    """Return a scene with objects (type, size) in a row, 1 m apart, on a shelf at 0.6 m, far from the cells."""
    drawn = draw(["..", ".."], *((kind, 9.0 + i, 0.6 + s[1] / 2, 9.0, *s) for i, (kind, s) in enumerate(objects)))
    return dataclasses.replace(drawn, name=name)


def sized(types) -> list[tuple[str, tuple[float, float, float]]]:
    """Return objects whose volume grows along the vocabulary."""
    ids = category_ids(tuple(types), ITHOR_CATEGORIES)
    return [(kind, (0.1 + 0.01 * k, 0.1, 0.1)) for kind, k in zip(types, ids, strict=True)]


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


def test_neighbours_in_size_exchange_places():
    scene = scene_of(list(DEN.items()))
    # From the smallest: Book, Bowl | Chair, GarbageCan, Fridge. The first chair, a stool, comes to the only place.
    pair = {"Book": "Bowl", "Bowl": "Book"}
    three = {"Chair": "GarbageCan", "Stool": "GarbageCan", "GarbageCan": "Fridge", "Fridge": "Stool"}
    assert exchange_places(scene, TASK, 1, 0).types == tuple((pair | three).get(kind, kind) for kind in DEN)
    # Half of the two groups is one of them, which one the seed decides.
    halves = {exchange_places(scene, TASK, 0.5, seed).types for seed in range(20)}
    assert halves == {tuple(group.get(kind, kind) for kind in DEN) for group in (pair, three)}


def test_objects_keep_their_boxes_and_places_their_undersides():
    small, large = ("Bowl", (0.2, 0.1, 0.3)), ("Pan", (0.5, 0.3, 0.4))
    scene = scene_of([small, large, ("Bowl", (0.1, 0.2, 0.1))])
    turned = dataclasses.replace(scene, yaws=np.array([0.0, 90.0, 180.0]))
    shifted = exchange_places(turned, TASK, 1, 0)
    assert shifted.types == ("Pan", "Bowl", "Pan")  # a pan is repeated, the second bowl is left out
    # Undersides are at 0.6 m; the bowl and the first pan are turned by a quarter with their places.
    expected = [[9, 0.75, 9, 0.4, 0.3, 0.5], [10, 0.65, 9, 0.3, 0.1, 0.2], [11, 0.75, 9, 0.4, 0.3, 0.5]]
    np.testing.assert_allclose(shifted.boxes, expected)
    np.testing.assert_array_equal(shifted.yaws, turned.yaws)


def test_a_place_keeps_its_box_where_others_rest_or_cells_would_be_covered():
    chair, can = ("Chair", 2.0, 0.5, 0.0, 0.5, 1.0, 0.5), ("GarbageCan", 4.0, 0.25, 0.0, 0.4, 0.5, 0.4)
    free = draw(["......"], chair, can)
    np.testing.assert_allclose(exchange_places(free, TASK, 1, 0).boxes[:, 3:], free.boxes[[1, 0], 3:])
    # A cell 0.22 m from the centre of the can is covered by a chair, but not by a can.
    near = dataclasses.replace(free, boxes=free.boxes + np.array([[0] * 6, [1.25 + 0.22 - 4, 0, 0, 0, 0, 0]]))
    shifted = exchange_places(near, TASK, 1, 0)
    assert shifted.types == ("GarbageCan", "Chair")
    np.testing.assert_allclose(shifted.boxes[:, 3], [0.4, 0.4])
    # What rests on the chair stays in its place, and so does what carries it, if it is detected from as far: both of
    # 0.6 m and more from 5 m, but a can of 0.45 m from 3.7 m.
    for other, width in ((can, 0.4), (("GarbageCan", 4.0, 0.4, 0.0, 0.6, 0.8, 0.6), 0.5)):
        carrying = draw(["......"], chair, other, ("Towel", 2.0, 1.05, 0.0, 0.3, 0.1, 0.3))
        carrying = dataclasses.replace(carrying, parents=np.array([-1, -1, 0]))
        np.testing.assert_allclose(exchange_places(carrying, TASK, 1, 0).boxes[:, 3], [width, 0.5, 0.3])


@given(SIZED_OBJECTS, SHIFTS, SEEDS, NAMES)
def test_a_share_of_the_categories_exchanges_places_by_a_derangement(objects, shift, seed, name):
    scene = scene_of(objects, name)
    shifted, new = exchange_places(scene, TASK, shift, seed), category_at_places(scene, shift, seed)
    before, after = ids_of(scene), ids_of(shifted)
    # One category comes to all places of another; so the numbers of objects are permuted.
    assert [new[k] for k in before] == after
    assert set(new.values()) == set(new)
    assert sorted(collections.Counter(before).values()) == sorted(collections.Counter(after).values())
    # What is no category and what is not exchanged stays; so do centres, undersides, cells, walls, name, ...
    same = [new[k] == k for k in before]
    assert new.get(-1, -1) == -1
    assert all(b == a for b, a, stays in zip(scene.types, shifted.types, same, strict=True) if stays)
    np.testing.assert_array_equal(shifted.boxes[same], scene.boxes[same])
    np.testing.assert_array_equal(shifted.boxes[:, [0, 2]], scene.boxes[:, [0, 2]])
    np.testing.assert_allclose(shifted.boxes[:, 1] - shifted.boxes[:, 4] / 2, np.full(len(objects), 0.6))
    assert_scenes_equal(dataclasses.replace(shifted, types=scene.types, boxes=scene.boxes), scene)
    # Every object is one of its category, with its size.
    known_sizes = {(k, size) for k, size in zip(before, object_size(scene.boxes).round(9), strict=True)}
    assert {(k, size) for k, size in zip(after, object_size(shifted.boxes).round(9), strict=True)} <= known_sizes
    # The nearest number of groups, but at least one; all at full shift.
    exchanged, present = sum(k != v for k, v in new.items()), len(set(before) - {-1})
    groups = present // 2
    assert exchanged == 0 if shift == 0 or groups == 0 else abs(exchanged // 2 - max(1, shift * groups)) <= 0.5
    assert present % 2 or exchanged % 2 == 0
    assert exchanged == present or shift < 1 or groups == 0


@given(SIZED_OBJECTS, SEEDS, NAMES)
def test_every_category_exchanges_with_a_neighbour_in_size(objects, seed, name):
    scene = scene_of(objects, name)
    volumes, ids = np.prod([size for _, size in objects], axis=-1), np.array(ids_of(scene))
    mean = {k: volumes[ids == k].mean() for k in set(ids) - {-1}}
    for k, new in category_at_places(scene, 1.0, seed).items():
        if k != new:  # only one category of the same group, and only of three, may lie between the two
            low, high = sorted((mean[k], mean[new]))
            assert sum(low + 1e-9 < volume < high - 1e-9 for volume in mean.values()) <= len(mean) % 2


@given(SIZED_OBJECTS, SHIFTS, SEEDS)
def test_goals_exchange_with_goals(objects, shift, seed):
    is_goal = GOALS.is_goal()
    for k, new in category_at_places(scene_of(objects), shift, seed, GOALS).items():
        assert k == new or is_goal[k] == is_goal[new]


@given(SIZED_OBJECTS, SHIFTS, SHIFTS, SEEDS, NAMES)
def test_a_greater_shift_exchanges_more_of_the_same(objects, one, other, seed, name):
    scene = scene_of(objects, name)
    less, more = (category_at_places(scene, shift, seed) for shift in sorted((one, other)))
    assert all(new in (k, more[k]) for k, new in less.items())


@pytest.mark.parametrize(
    ("present", "shift", "exchanged"),
    [(4, 0.01, 2), (10, 0.25, 2), (10, 0.34, 4), (10, 0.66, 6), (10, 1, 10), (3, 0.1, 3), (11, 1, 11)],
)
def test_the_share_is_rounded(present, shift, exchanged):
    scene = scene_of(sized(ITHOR_CATEGORIES[:present]))
    shifted = exchange_places(scene, TASK, shift, 0)
    assert sum(a != b for a, b in zip(scene.types, shifted.types, strict=True)) == exchanged


def test_like_volumes_keep_the_order_of_the_vocabulary():
    scene = scene_of([(kind, (0.6, 0.6, 0.05)) for kind in ITHOR_CATEGORIES[3::-1]])
    assert category_at_places(scene, 1.0) == {0: 1, 1: 0, 2: 3, 3: 2}


def test_an_alias_is_its_category():
    scene = scene_of(sized(["Stool", "Book", "Chair", "Sofa"]))
    assert exchange_places(scene, TASK, 1, 0).types == ("Book", "Stool", "Book", "Sofa")


@pytest.mark.parametrize(
    ("types", "shift"), [(["Book", "Chair"], 0.0), (["Stool", "Chair", "Sofa"], 1.0), (["Sofa"], 1), ([], 1.0)]
)
def test_what_cannot_change_is_the_same_scene(types, shift):
    scene = scene_of(sized(types))
    assert exchange_places(scene, TASK, shift, 0) is scene


def test_name_and_seed_alone_fix_the_exchange():
    objects = sized(ITHOR_CATEGORIES)
    first = exchange_places(scene_of(objects), TASK, 0.5, 0)
    assert exchange_places(scene_of(objects), TASK, 0.5, 0).types == first.types
    # Order and number of the objects do not count.
    again = exchange_places(scene_of([*objects[::-1], *sized(["Book", "Sofa"])]), TASK, 0.5, 0)
    assert again.types[:22] == first.types[::-1]
    assert exchange_places(scene_of(objects, "other"), TASK, 0.5, 0).types != first.types
    assert exchange_places(scene_of(objects), TASK, 0.5, 1).types != first.types
    # In the end all exchange, whatever the order.
    ends = [exchange_places(scene_of(objects, name), TASK, 1, seed) for name, seed in (("den", 0), ("other", 1))]
    assert ends[0].types == ends[1].types


@pytest.mark.parametrize(("shift", "seed"), [(-0.1, 0), (1.1, 0), (float("nan"), 0), (0.5, -1)])
def test_impossible_numbers_are_refused(shift, seed):
    with pytest.raises(InputError, match="give a seed of at least 0, a shift from 0 to 1"):
        shift_scenes(make_generated_scenes("rooms", "val"), TASK, shift, seed)


def test_real_objects_keep_their_size_and_leave_the_cells_free():
    scenes = load_scenes(require(ITHOR), "val")
    num_kept = num_moved = 0
    for i in range(len(scenes)):
        before = scenes[i]
        after = exchange_places(before, TASK, 1, 0)
        sizes_by_type = collections.defaultdict(set)
        for kind, size in zip(before.types, object_size(before.boxes).round(6), strict=True):
            sizes_by_type[kind].add(size)
        new_sizes = object_size(after.boxes).round(6)
        for old_type, new_type, size in zip(before.types, after.types, new_sizes, strict=True):
            if old_type != new_type:
                num_moved += 1
                num_kept += size in sizes_by_type[new_type]
    assert num_moved > 150
    # The remaining objects are in the box of a place by the cells, or on which something rests.
    assert num_kept > 0.9 * num_moved
