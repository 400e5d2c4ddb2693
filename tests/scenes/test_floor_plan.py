"""Floor plans named by scenes."""

import collections

import pytest

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
        ("", ""),
    ],
)
def test_floor_plan_name_follows_from_the_scene_name(scene_name, plan_name):
    assert floor_plan_name(scene_name) == plan_name


@pytest.mark.parametrize("world", ["rooms", "houses"])
def test_generated_rooms_and_houses_have_their_own_floor_plans(world):
    scene_names = [make_generated_scenes(world, "val", 4)[i].name for i in range(4)]
    assert [floor_plan_name(scene_name) for scene_name in scene_names] == scene_names


def test_generated_apartments_of_one_floor_plan_share_walls():
    scenes = [make_generated_scenes("apartments", "val", 10)[i] for i in range(10)]
    wall_masks = collections.defaultdict(set)
    for scene in scenes:
        wall_masks[floor_plan_name(scene.name)].add((scene.walls.shape, scene.walls.tobytes()))
    assert [len(masks_of_plan) for masks_of_plan in wall_masks.values()] == [1, 1]
    assert len(set.union(*wall_masks.values())) == 2
