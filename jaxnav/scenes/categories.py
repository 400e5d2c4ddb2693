"""Ordered vocabularies of the object categories.

`category_ids` maps object types, which differ between simulators, to a vocabulary; `ALIASES` lists their other names.
"""

from collections import Counter
from collections.abc import Iterable
from types import MappingProxyType

from jaxnav.scenes.scene import Scene

#: The 22 AI2-THOR categories of the paper, in the index order of its released code.
ITHOR_CATEGORIES: tuple[str, ...] = (
    "AlarmClock", "Book", "Bowl", "CellPhone", "Chair", "CoffeeMachine", "DeskLamp", "FloorLamp",
    "Fridge", "GarbageCan", "Kettle", "Laptop", "LightSwitch", "Microwave", "Pan", "Plate", "Pot",
    "RemoteControl", "Sink", "StoveBurner", "Television", "Toaster",
)  # fmt: skip

#: The goals of the RoboTHOR challenge, and furniture that stands near them.
ROBOTHOR_GOALS: tuple[str, ...] = (
    "AlarmClock", "Apple", "BaseballBat", "BasketBall", "Bowl", "GarbageCan", "HousePlant", "Laptop", "Mug",
    "SprayBottle", "Television", "Vase",
)  # fmt: skip
ROBOTHOR_CATEGORIES: tuple[str, ...] = (
    *ROBOTHOR_GOALS, "ArmChair", "Bed", "Book", "Chair", "Desk", "DiningTable", "Dresser", "ShelvingUnit", "Sofa",
    "TVStand",
)  # fmt: skip

#: The 15 classes of the Gibson setting (SemExp), of which the first six are goals.
GIBSON_CATEGORIES: tuple[str, ...] = (
    "Chair", "Sofa", "HousePlant", "Bed", "Toilet", "Television", "DiningTable", "Oven", "Sink", "Fridge", "Book",
    "Clock", "Vase", "Cup", "Bottle",
)  # fmt: skip
GIBSON_GOALS: tuple[str, ...] = GIBSON_CATEGORIES[:6]

#: Room types of the single-room worlds, in the order of the per-type priors.
ROOM_TYPES: tuple[str, ...] = ("kitchen", "living_room", "bedroom", "bathroom")

#: Type names of other simulator versions and datasets, with the name used here.
ALIASES = MappingProxyType({
    "Stool": "Chair", "chair": "Chair", "stool": "Chair", "couch": "Sofa", "sofa": "Sofa", "bed": "Bed",
    "potted plant": "HousePlant", "plant": "HousePlant", "toilet": "Toilet", "tv": "Television",
    "tv_monitor": "Television", "television": "Television", "dining-table": "DiningTable",
    "dining table": "DiningTable", "table": "DiningTable", "oven": "Oven", "sink": "Sink", "refrigerator": "Fridge",
    "fridge": "Fridge", "book": "Book", "clock": "Clock", "vase": "Vase", "cup": "Cup", "bottle": "Bottle",
    "Glassbottle": "Bottle",
})  # fmt: skip


def category_ids(types: tuple[str, ...], categories: tuple[str, ...]) -> tuple[int, ...]:
    """Return the index of each object type in `categories`, or -1.

    A type is matched by its name or else by its alias.
    """
    index_by_name = {name: index for index, name in enumerate(categories)}

    def find_index(name: str) -> int:
        alias = ALIASES.get(name, name)
        return index_by_name.get(name, index_by_name.get(alias, -1))

    return tuple(find_index(name) for name in types)


def format_most_common(counts: Counter[str], number: int = 5) -> str:
    """Return a text with the most frequent entries and the number of further entries."""
    entry_texts: list[str] = []
    for name, count in counts.most_common(number):
        entry_texts.append(f"{name} x {count}")
    joined_entries = ", ".join(entry_texts)
    if len(counts) > number:
        joined_entries += f" and {len(counts) - number} more"
    return joined_entries


def count_unknown_types(scenes: Iterable[Scene], categories: tuple[str, ...]) -> Counter[str]:
    """Count the objects of types outside of `categories`, which only occlude other objects."""
    type_counts: Counter[str] = Counter()
    for scene in scenes:
        type_counts.update(scene.types)

    unknown_counts: Counter[str] = Counter()
    for name, category in zip(type_counts, category_ids(tuple(type_counts), categories), strict=True):
        if category < 0:
            unknown_counts[name] = type_counts[name]
    return unknown_counts
