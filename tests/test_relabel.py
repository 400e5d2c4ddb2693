"""The dial on scene files: labels are exchanged by a derangement, and nothing else changes."""

import collections
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from drawn import SMALL, draw
from hypothesis import given
from hypothesis import strategies as st
from test_scene_io import assert_equal

from jaxnav.errors import InputError
from jaxnav.scenes.categories import ITHOR_CATEGORIES, category_ids
from jaxnav.scenes.compile import compile_scene
from jaxnav.scenes.io import write_scenes
from jaxnav.scenes.relabel import relabel
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import ROOMS
from jaxnav.scenes.worlds import from_file

REAL_FILE = Path(__file__).parents[2] / "shared" / "scenes" / "ithor_train_val.jsonl.gz"
SHIFTS = st.floats(0, 1)
SEEDS = st.integers(0, 2**32)
NAMES = st.text(max_size=12)


def scene_of(types: list[str], name: str = "den") -> Scene:
    """Objects of different sizes in a row."""
    drawn = draw(["..", ".."], *((kind, 0.5 + i, 0.8, 1.0, *SMALL) for i, kind in enumerate(types)))
    return dataclasses.replace(drawn, name=name)


def ids_of(scene: Scene) -> list[int]:
    return list(category_ids(scene.types, ITHOR_CATEGORIES))


@given(st.lists(st.sampled_from((*ITHOR_CATEGORIES, "Stool", "Sofa", "Window")), max_size=30), SHIFTS, SEEDS, NAMES)
def test_a_share_of_the_categories_exchanges_labels_by_a_derangement(types, shift, seed, name):
    scene = scene_of(types, name)
    shifted = relabel(scene, ITHOR_CATEGORIES, shift, seed)
    before, after = ids_of(scene), ids_of(shifted)
    becomes = dict(zip(before, after, strict=True))
    # All objects of one category become objects of one other; so the counts are permuted.
    assert [becomes[k] for k in before] == after
    assert set(becomes.values()) == set(becomes)
    assert sorted(collections.Counter(before).values()) == sorted(collections.Counter(after).values())
    # What is no category stays none, with its name; so do the names of those that are not exchanged.
    assert becomes.get(-1, -1) == -1
    assert all(b == a for b, a, k in zip(scene.types, shifted.types, before, strict=True) if becomes[k] == k)
    exchanged, present = sum(k != v for k, v in becomes.items()), len(set(before) - {-1})
    # The nearest number of categories, but a single one has nobody to exchange with.
    assert exchanged == 0 if shift == 0 or present < 2 else abs(exchanged - max(2, shift * present)) <= 0.5
    assert exchanged != 1
    assert_equal(dataclasses.replace(shifted, types=scene.types), scene)  # boxes, cells, walls, name, ...


@pytest.mark.parametrize(
    ("present", "shift", "exchanged"), [(4, 0.01, 2), (10, 0.25, 2), (10, 0.34, 3), (10, 0.66, 7), (10, 1, 10)]
)
def test_the_share_is_rounded(present, shift, exchanged):
    scene = scene_of(list(ITHOR_CATEGORIES[:present]))
    shifted = relabel(scene, ITHOR_CATEGORIES, shift, 0)
    assert sum(a != b for a, b in zip(scene.types, shifted.types, strict=True)) == exchanged


def test_an_alias_is_its_category():
    scene = scene_of(["Stool", "Book", "Chair", "Sofa"])
    assert relabel(scene, ITHOR_CATEGORIES, 1, 0).types == ("Book", "Chair", "Book", "Sofa")  # the only derangement


@pytest.mark.parametrize(
    ("types", "shift"), [(["Book", "Chair"], 0.0), (["Stool", "Chair", "Sofa"], 1.0), (["Sofa"], 1), ([], 1.0)]
)
def test_what_cannot_change_is_the_same_scene(types, shift):
    scene = scene_of(types)
    assert relabel(scene, ITHOR_CATEGORIES, shift, 0) is scene


def test_name_and_seed_alone_fix_the_exchange():
    types = list(ITHOR_CATEGORIES)
    first = relabel(scene_of(types), ITHOR_CATEGORIES, 1, 0)
    assert relabel(scene_of(types), ITHOR_CATEGORIES, 1, 0).types == first.types
    # Order and number of the objects do not count.
    again = relabel(scene_of([*types[::-1], "Book", "Sofa"]), ITHOR_CATEGORIES, 1, 0)
    assert again.types[:22] == first.types[::-1]
    assert relabel(scene_of(types, "other"), ITHOR_CATEGORIES, 1, 0).types != first.types
    assert relabel(scene_of(types), ITHOR_CATEGORIES, 1, 1).types != first.types


@pytest.mark.parametrize(("shift", "seed"), [(-0.1, 0), (1.1, 0), (float("nan"), 0), (0.5, -1)])
def test_impossible_numbers_are_refused(shift, seed):
    with pytest.raises(InputError, match="give a seed of at least 0, a shift from 0 to 1"):
        relabel(scene_of([]), ITHOR_CATEGORIES, shift, seed)


def test_scenes_of_a_file_are_relabelled_one_by_one(tmp_path):
    scenes = [scene_of(list(ITHOR_CATEGORIES), name) for name in ("a", "b", "c")]
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


@pytest.mark.skipif(not REAL_FILE.exists(), reason="the real rooms are not here")
def test_real_rooms_stay_equally_difficult():
    """Every goal is another one: the same starts and path lengths, in another column."""
    own, shifted = from_file(REAL_FILE, "val"), from_file(REAL_FILE, "val", 1.0)
    moved = 0
    for i in range(0, len(own), 5):
        before, after = (compile_scene(scenes[i], ROOMS).best_length for scenes in (own, shifted))
        becomes = dict(zip(ids_of(own[i]), ids_of(shifted[i]), strict=True))
        for goal, new in becomes.items():
            if goal >= 0:
                np.testing.assert_array_equal(before[:, goal], after[:, new])
                moved += goal != new
    assert moved >= 20
