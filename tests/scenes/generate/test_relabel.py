"""The exchange of labels between categories of like size."""

import collections
import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.real_scenes import ITHOR, require
from support.scene_records import assert_scenes_equal
from support.scenes import SMALL, draw

from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.generate.relabel import relabel
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import ROOMS
from jaxnav.scenes.worlds import from_file

SHIFTS = st.floats(0, 1)
SEEDS = st.integers(0, 2**32)
NAMES = st.text(max_size=12)
TYPES = st.sampled_from((*ITHOR_CATEGORIES, "Stool", "Sofa", "Window"))
SIZES = st.sampled_from((0.1, 0.2, 0.4, 1.0))
SIZED_OBJECTS = st.lists(st.tuples(TYPES, st.tuples(SIZES, SIZES, SIZES)), max_size=30)


def scene_of(objects: list[tuple[str, tuple[float, float, float]]], name: str = "den") -> Scene:
    """Return a scene with objects (type, size) in a row."""
    drawn = draw(["..", ".."], *((kind, 0.5 + i, 0.8, 1.0, *size) for i, (kind, size) in enumerate(objects)))
    return dataclasses.replace(drawn, name=name)


def sized(types: Sequence[str]) -> list[tuple[str, tuple[float, float, float]]]:
    """Return objects whose volume grows along the vocabulary."""
    ids = category_ids(tuple(types), ITHOR_CATEGORIES)
    return [(kind, (0.1 + 0.01 * k, 0.1, 0.1)) for kind, k in zip(types, ids, strict=True)]


def ids_of(scene: Scene) -> list[int]:
    return list(category_ids(scene.types, ITHOR_CATEGORIES))


def becomes(scene: Scene, shift: float, seed: int = 0) -> dict[int, int]:
    """Return the category that each becomes."""
    return dict(zip(ids_of(scene), ids_of(relabel(scene, ITHOR_CATEGORIES, shift, seed)), strict=True))


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


def test_neighbours_in_size_exchange_labels():
    scene = scene_of(list(DEN.items()))
    # From the smallest: Book, Bowl | Chair, GarbageCan, Fridge.
    pair = {"Book": "Bowl", "Bowl": "Book"}
    three = {"Chair": "GarbageCan", "Stool": "GarbageCan", "GarbageCan": "Fridge", "Fridge": "Chair"}
    assert relabel(scene, ITHOR_CATEGORIES, 1, 0).types == tuple((pair | three).get(kind, kind) for kind in DEN)
    # Half of the two groups is one of them, which one the seed decides.
    halves = {relabel(scene, ITHOR_CATEGORIES, 0.5, seed).types for seed in range(20)}
    assert halves == {tuple(group.get(kind, kind) for kind in DEN) for group in (pair, three)}


@given(SIZED_OBJECTS, SHIFTS, SEEDS, NAMES)
def test_a_share_of_the_categories_exchanges_labels_by_a_derangement(objects, shift, seed, name):
    scene = scene_of(objects, name)
    shifted, new = relabel(scene, ITHOR_CATEGORIES, shift, seed), becomes(scene, shift, seed)
    before, after = ids_of(scene), ids_of(shifted)
    # All objects of one category become objects of one other; so the counts are permuted.
    assert [new[k] for k in before] == after
    assert set(new.values()) == set(new)
    assert sorted(collections.Counter(before).values()) == sorted(collections.Counter(after).values())
    # What is no category stays none, with its name; so do the names of those that are not exchanged.
    assert new.get(-1, -1) == -1
    assert all(b == a for b, a, k in zip(scene.types, shifted.types, before, strict=True) if new[k] == k)
    assert_scenes_equal(dataclasses.replace(shifted, types=scene.types), scene)  # boxes, cells, walls, name, ...
    # The nearest number of groups, but at least one; all at full shift.
    exchanged, present = sum(k != v for k, v in new.items()), len(set(before) - {-1})
    groups = present // 2
    assert exchanged == 0 if shift == 0 or groups == 0 else abs(exchanged // 2 - max(1, shift * groups)) <= 0.5
    assert present % 2 or exchanged % 2 == 0
    assert exchanged == present or shift < 1 or groups == 0


@given(SIZED_OBJECTS, SEEDS, NAMES)
def test_every_category_takes_the_label_of_a_neighbour_in_size(objects, seed, name):
    scene = scene_of(objects, name)
    volumes, ids = np.prod([size for _, size in objects], axis=-1), np.array(ids_of(scene))
    mean = {k: volumes[ids == k].mean() for k in set(ids) - {-1}}
    for k, new in becomes(scene, 1.0, seed).items():
        if k != new:  # only one category of the same group, and only of three, may lie between the two
            low, high = sorted((mean[k], mean[new]))
            assert sum(low + 1e-9 < volume < high - 1e-9 for volume in mean.values()) <= len(mean) % 2


@given(SIZED_OBJECTS, SHIFTS, SHIFTS, SEEDS, NAMES)
def test_a_greater_shift_exchanges_more_of_the_same(objects, one, other, seed, name):
    scene = scene_of(objects, name)
    less, more = (becomes(scene, shift, seed) for shift in sorted((one, other)))
    assert all(new in (k, more[k]) for k, new in less.items())


@pytest.mark.parametrize(
    ("present", "shift", "exchanged"),
    [(4, 0.01, 2), (10, 0.25, 2), (10, 0.34, 4), (10, 0.66, 6), (10, 1, 10), (3, 0.1, 3), (11, 1, 11)],
)
def test_the_share_is_rounded(present, shift, exchanged):
    scene = scene_of(sized(ITHOR_CATEGORIES[:present]))
    shifted = relabel(scene, ITHOR_CATEGORIES, shift, 0)
    assert sum(a != b for a, b in zip(scene.types, shifted.types, strict=True)) == exchanged


def test_like_volumes_keep_the_order_of_the_vocabulary():
    scene = scene_of([(kind, SMALL) for kind in ITHOR_CATEGORIES[3::-1]])
    assert becomes(scene, 1.0) == {0: 1, 1: 0, 2: 3, 3: 2}


def test_an_alias_is_its_category():
    scene = scene_of(sized(["Stool", "Book", "Chair", "Sofa"]))
    assert relabel(scene, ITHOR_CATEGORIES, 1, 0).types == ("Book", "Chair", "Book", "Sofa")  # the only derangement


@pytest.mark.parametrize(
    ("types", "shift"), [(["Book", "Chair"], 0.0), (["Stool", "Chair", "Sofa"], 1.0), (["Sofa"], 1), ([], 1.0)]
)
def test_what_cannot_change_is_the_same_scene(types, shift):
    scene = scene_of(sized(types))
    assert relabel(scene, ITHOR_CATEGORIES, shift, 0) is scene


def test_name_and_seed_alone_fix_the_exchange():
    objects = sized(ITHOR_CATEGORIES)
    first = relabel(scene_of(objects), ITHOR_CATEGORIES, 0.5, 0)
    assert relabel(scene_of(objects), ITHOR_CATEGORIES, 0.5, 0).types == first.types
    # Order and number of the objects do not count.
    again = relabel(scene_of([*objects[::-1], *sized(["Book", "Sofa"])]), ITHOR_CATEGORIES, 0.5, 0)
    assert again.types[:22] == first.types[::-1]
    assert relabel(scene_of(objects, "other"), ITHOR_CATEGORIES, 0.5, 0).types != first.types
    assert relabel(scene_of(objects), ITHOR_CATEGORIES, 0.5, 1).types != first.types
    # In the end all exchange, whatever the order.
    ends = [relabel(scene_of(objects, name), ITHOR_CATEGORIES, 1, seed) for name, seed in (("den", 0), ("other", 1))]
    assert ends[0].types == ends[1].types


@pytest.mark.parametrize(("shift", "seed"), [(-0.1, 0), (1.1, 0), (float("nan"), 0), (0.5, -1)])
def test_impossible_numbers_are_refused(shift, seed):
    with pytest.raises(InputError, match="give a seed of at least 0, a shift from 0 to 1"):
        relabel(scene_of([]), ITHOR_CATEGORIES, shift, seed)


def test_scenes_of_a_file_are_relabelled_one_by_one(tmp_path):
    scenes = [scene_of(sized(ITHOR_CATEGORIES), name) for name in ("a", "b", "c")]
    file, last = tmp_path / "all.jsonl.gz", tmp_path / "last.jsonl.gz"
    write_scenes(file, scenes)
    write_scenes(last, scenes[2:])
    shifted = from_file(file, "train", 0.5, 3)
    for i, scene in enumerate(scenes):
        assert shifted[i].types == relabel(scene, ITHOR_CATEGORIES, 0.5, 3).types
    assert from_file(last, "train", 0.5, 3)[0].types == shifted[2].types  # whatever else there is
    assert from_file(file, None, 0.0, 3)[1].types == scenes[1].types
    # What differs has different identities, and what does not the same.
    variants = [from_file(file, "train"), shifted, from_file(file, None), from_file(last, "train")]
    variants += [from_file(file, "train", 0.6, 3), from_file(file, "train", 0.5, 4)]
    variants += [from_file(file, "train", 0.5, 3, ITHOR_CATEGORIES[:9])]
    assert len({scenes.identity for scenes in variants}) == len(variants)
    assert from_file(file, "train", 0.0, 5).identity == from_file(file, "train").identity


def test_real_rooms_stay_equally_difficult():
    # Every goal is another one: the same starts and path lengths, in another column.
    unshifted, shifted = (from_file(require(ITHOR), "val", shift) for shift in (0.0, 1.0))
    moved = 0
    for i in range(0, len(unshifted), 5):
        before, after = (compile_scene(scenes[i], ROOMS).best_length for scenes in (unshifted, shifted))
        for goal, new in becomes(unshifted[i], 1.0).items():
            if goal >= 0:
                np.testing.assert_array_equal(before[:, goal], after[:, new])
                moved += goal != new
    assert moved >= 20
