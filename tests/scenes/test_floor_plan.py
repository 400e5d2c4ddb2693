"""Floor plans named by scenes."""

import collections

import numpy as np
import pytest
from support.real_scenes import INPUTS, require

from jaxnav.evaluation.statistics import SharedDesign
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.scene import floor_plan_name
from jaxnav.scenes.worlds import make_generated_scenes


@pytest.mark.parametrize(
    ("scene_name", "plan_name"),
    [
        # RoboTHOR's apartments, furnished five times each.
        ("FloorPlan_Train3_1", "FloorPlan_Train3"),
        ("FloorPlan_Train3_5", "FloorPlan_Train3"),
        ("FloorPlan_Train12_5", "FloorPlan_Train12"),
        ("FloorPlan_Val1_2", "FloorPlan_Val1"),
        ("FloorPlan_test-dev1_1", "FloorPlan_test-dev1"),
        ("FloorPlan_test_dev12_5", "FloorPlan_test_dev12"),
        ("FloorPlan_test-dev1_1-replaced-3", "FloorPlan_test-dev1"),
        # Generated apartments.
        ("val-apartment-02-0", "val-apartment-02"),
        ("val-apartment-02-4", "val-apartment-02"),
        ("train-apartment-14-3", "train-apartment-14"),
        ("test-apartment-00-0", "test-apartment-00"),
        # Rooms with their objects moved.
        ("FloorPlan7-replaced-2", "FloorPlan7"),
        ("val-kitchen-003-replaced-10", "val-kitchen-003"),
        # Any other name is that of its own floor plan.
        ("FloorPlan7", "FloorPlan7"),
        ("FloorPlan71", "FloorPlan71"),
        ("FloorPlan201_physics", "FloorPlan201_physics"),
        ("val-kitchen-003", "val-kitchen-003"),
        ("val-house-0003", "val-house-0003"),
        ("val-apartment-02", "val-apartment-02"),
        ("my-apartment-02-4", "my-apartment-02-4"),
        ("FloorPlan7-replaced-", "FloorPlan7-replaced-"),
        ("FloorPlan_Train3_1b", "FloorPlan_Train3_1b"),
        ("FloorPlan_3_1", "FloorPlan_3_1"),
        ("", ""),
    ],
)
def test_floor_plan_name_follows_from_the_scene_name(scene_name, plan_name):
    assert floor_plan_name(scene_name) == plan_name


@pytest.mark.parametrize("world", ["rooms", "houses"])
def test_generated_rooms_and_houses_have_their_own_floor_plans(world):
    scene_names = [make_generated_scenes(world, "val", 4)[i].name for i in range(4)]
    assert [floor_plan_name(scene_name) for scene_name in scene_names] == scene_names


@pytest.mark.slow
def test_generated_apartments_of_one_floor_plan_share_walls():
    scenes = [make_generated_scenes("apartments", "val", 10)[i] for i in range(10)]
    wall_masks = collections.defaultdict(set)
    for scene in scenes:
        wall_masks[floor_plan_name(scene.name)].add((scene.walls.shape, scene.walls.tobytes()))
    assert [len(masks_of_plan) for masks_of_plan in wall_masks.values()] == [1, 1]
    assert len(set.union(*wall_masks.values())) == 2


def success_interval(scene_names):
    """Return the interval of a success rate that differs from scene to scene."""
    design = SharedDesign.from_conditions([(scene_names, ["apartment"] * len(scene_names))], num_seeds=1)
    successes = np.arange(len(scene_names), dtype=float)[None]
    return design.interval(design.jackknife_means(successes, np.ones(len(scene_names)), scene_names, trained=False))


@pytest.mark.parametrize("set_name", ["Val", "test-dev"])
def test_furnishings_of_one_floor_plan_give_no_interval(set_name):
    one_plan = success_interval([f"FloorPlan_{set_name}1_{i}" for i in range(1, 6)])
    assert one_plan.mean == 2.0
    assert not one_plan.has_bounds

    five_plans = success_interval([f"FloorPlan_{set_name}{i}_1" for i in range(1, 6)])
    assert five_plans.has_bounds


@pytest.mark.parametrize("set_name", ["Val1", "test-dev1"])
def test_scene_files_of_one_floor_plan_give_no_interval(set_name):
    scenes = read_scenes(require(INPUTS / f"plans_FloorPlan_{set_name}.jsonl"))
    assert {floor_plan_name(scene.name) for scene in scenes} == {f"FloorPlan_{set_name}"}
    assert not success_interval([scene.name for scene in scenes]).has_bounds
