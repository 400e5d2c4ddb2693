"""Procedural homes: apartments with partitions, and houses with rooms.

Apartments are modelled on RoboTHOR, houses on ProcTHOR and Gibson.
"""

import dataclasses

import numpy as np

from jaxnav.scenes.categories import GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.arguments import check_scene_arguments
from jaxnav.scenes.generate.floor_plans import apartment_plan, house_plan
from jaxnav.scenes.generate.home import GoalRange, Home
from jaxnav.scenes.generate.room_rules import home_rules
from jaxnav.scenes.scene import SPLITS, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import APARTMENTS

FURNISHINGS = 5  # of each apartment
APARTMENT_CELLS = (155, 340)  # standable cells of an apartment
HOUSE_CELLS = (250, 1500)  # of a house

# One stream of random numbers each: apartments share their walls.
_PLAN, _APARTMENT, _HOUSE = 2, 3, 4

_APARTMENT_RANGE = GoalRange(ROBOTHOR_GOALS, 0.85, to_footprint=False)
_HOUSE_RANGE = GoalRange(GIBSON_GOALS, 0.6, to_footprint=True)


def generate_apartment(split: str, index: int, seed: int) -> Scene:
    """Generate one furnishing of an apartment.

    It has all twelve goals, and each of them can be reached. `index // 5` is the floor plan, shared by five scenes.

    Args:
      split: `train`, `val` or `test`.
      index: at least 0; 60 training and 15 validation scenes have twelve and three floor plans.
      seed: at least 0.

    Returns:
      The scene, named like `train-apartment-03-2`; it depends on the arguments alone.

    Raises:
      InputError: unknown split, or a negative index or seed.
    """
    check_scene_arguments("generate_apartment", split, index, seed)
    plan_index, furnishing = divmod(index, FURNISHINGS)
    key = (seed, SPLITS.index(split))
    plan = apartment_plan(np.random.default_rng((*key, plan_index, _PLAN)))
    rng = np.random.default_rng((*key, index, _APARTMENT))
    home = Home(plan, home_rules("apartments"), _APARTMENT_RANGE)
    name = f"{split}-apartment-{plan_index:02d}-{furnishing}"
    low, high = APARTMENT_CELLS
    while True:
        rooms = home.furnished(rng)
        if rooms and low <= home.reach(rooms).sum() <= high:
            scene = home.scene(name, "apartments", "apartment", split, rooms)
            if compile_scene(scene, APARTMENTS).best_length[:, APARTMENTS.is_goal()].any(axis=0).all():
                return scene


def generate_house(split: str, index: int, seed: int) -> Scene:
    """Generate a house of four to ten rooms.

    The scene's `rooms` are their types and floors.

    Args:
      split: `train`, `val` or `test`.
      index: at least 0.
      seed: at least 0.

    Returns:
      The scene, named like `train-house-00017`; it depends on the arguments alone.

    Raises:
      InputError: unknown split, or a negative index or seed.
    """
    check_scene_arguments("generate_house", split, index, seed)
    rules = home_rules("houses")
    key = (seed, SPLITS.index(split), index)
    rng = np.random.default_rng((*key, _HOUSE))
    low, high = HOUSE_CELLS
    while True:
        home = Home(house_plan(rng), rules, _HOUSE_RANGE)
        rooms = home.furnished(rng)
        if rooms and low <= home.reach(rooms).sum() <= high:
            scene = home.scene(f"{split}-house-{index:05d}", "houses", "house", split, rooms)
            return dataclasses.replace(scene, rooms=home.floors())
