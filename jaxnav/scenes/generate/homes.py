"""Procedural homes: apartments with partitions, and houses with rooms.

Apartments are modelled on RoboTHOR, houses on ProcTHOR and Gibson.
"""

import dataclasses

import numpy as np

from jaxnav.scenes.categories import GIBSON_GOALS, ROBOTHOR_GOALS
from jaxnav.scenes.generate.floor_plans import apartment_plan, house_plan
from jaxnav.scenes.generate.furnished_room import FurnishedRoom
from jaxnav.scenes.generate.home import GoalRange, Home
from jaxnav.scenes.generate.room_rules import home_statistics
from jaxnav.scenes.generate.shift import check_scene_arguments
from jaxnav.scenes.scene import SPLITS, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.task import APARTMENTS

FURNISHINGS = 5  # of each apartment
APARTMENT_CELLS = (155, 340)  # standable cells of an apartment
HOUSE_CELLS = (250, 1500)  # of a house
SHIFT_ATTEMPTS = 10  # to shift an apartment so that every goal can be seen

# One stream of random numbers each: apartments share their walls, and a shifted scene has the objects of the scene
# without a shift.
_PLAN, _APARTMENT, _HOUSE, _SHIFT = 2, 3, 4, 5

_APARTMENT_RANGE = GoalRange(ROBOTHOR_GOALS, 0.85, to_footprint=False)
_HOUSE_RANGE = GoalRange(GIBSON_GOALS, 0.6, to_footprint=True)


def generate_apartment(split: str, index: int, seed: int, shift: float = 0.0) -> Scene:
    """Generate one furnishing of an apartment.

    It has all twelve goals, and each of them can be reached. `index // 5` is the floor plan, shared by five scenes.

    Args:
      split: `train`, `val` or `test`.
      index: at least 0; 60 training and 15 validation scenes have twelve and three floor plans.
      seed: at least 0.
      shift: probability in [0, 1] that an object is placed by the rule of another type.

    Returns:
      The scene, named like `train-apartment-03-2`; it depends on the arguments alone.

    Raises:
      InputError: unknown split, negative index or seed, or a shift that is not in [0, 1].
    """
    check_scene_arguments("generate_apartment", split, index, seed, shift)
    plan_index, furnishing = divmod(index, FURNISHINGS)
    key = (seed, SPLITS.index(split))
    plan = apartment_plan(np.random.default_rng((*key, plan_index, _PLAN)))
    rng, shift_rng = (np.random.default_rng((*key, index, stream)) for stream in (_APARTMENT, _APARTMENT + _SHIFT))
    home = Home(plan, home_statistics("apartments"), _APARTMENT_RANGE)
    name = f"{split}-apartment-{plan_index:02d}-{furnishing}"
    low, high = APARTMENT_CELLS
    while True:
        rooms = home.furnished(rng)
        if not rooms or not low <= home.reach(rooms).sum() <= high:
            continue
        scene = _apartment(home, name, split, rooms)
        if scene and not shift:
            return scene
        for _ in range(SHIFT_ATTEMPTS if scene else 0):
            if scene := _apartment(home, name, split, home.shifted(rooms, shift, shift_rng)):
                return scene


def generate_house(split: str, index: int, seed: int, shift: float = 0.0) -> Scene:
    """Generate a house of four to ten rooms.

    The scene's `rooms` are their types and floors.

    Args:
      split: `train`, `val` or `test`.
      index: at least 0.
      seed: at least 0.
      shift: probability in [0, 1] that an object is placed by the rule of another type, in a room for that type.

    Returns:
      The scene, named like `train-house-00017`; it depends on the arguments alone.

    Raises:
      InputError: unknown split, negative index or seed, or a shift that is not in [0, 1].
    """
    check_scene_arguments("generate_house", split, index, seed, shift)
    statistics = home_statistics("houses")
    key = (seed, SPLITS.index(split), index)
    rng, shift_rng = (np.random.default_rng((*key, stream)) for stream in (_HOUSE, _HOUSE + _SHIFT))
    low, high = HOUSE_CELLS
    while True:
        home = Home(house_plan(rng), statistics, _HOUSE_RANGE)
        rooms = home.furnished(rng)
        if rooms and low <= home.reach(rooms).sum() <= high:
            rooms = home.shifted(rooms, shift, shift_rng) if shift else rooms
            if rooms:
                scene = home.scene(f"{split}-house-{index:05d}", "houses", "house", split, rooms)
                return dataclasses.replace(scene, rooms=home.floors())


def _apartment(home: Home, name: str, split: str, rooms: list[FurnishedRoom] | None) -> Scene | None:
    """Return the scene if every goal can be reached."""
    if not rooms:
        return None
    scene = home.scene(name, "apartments", "apartment", split, rooms)
    lengths = compile_scene(scene, APARTMENTS).best_length[:, APARTMENTS.is_goal()]
    return scene if lengths.max(axis=0).all() else None
