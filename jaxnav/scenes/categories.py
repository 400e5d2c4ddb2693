"""Ordered vocabularies of the object categories."""

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

#: Type names of other simulator versions and datasets, and the name that is used here.
ALIASES = MappingProxyType({
    "Stool": "Chair", "chair": "Chair", "stool": "Chair", "couch": "Sofa", "sofa": "Sofa", "bed": "Bed",
    "potted plant": "HousePlant", "plant": "HousePlant", "toilet": "Toilet", "tv": "Television",
    "tv_monitor": "Television", "television": "Television", "dining-table": "DiningTable",
    "dining table": "DiningTable", "table": "DiningTable", "oven": "Oven", "sink": "Sink", "refrigerator": "Fridge",
    "fridge": "Fridge", "book": "Book", "clock": "Clock", "vase": "Vase", "cup": "Cup", "bottle": "Bottle",
    "Glassbottle": "Bottle",
})  # fmt: skip


def category_ids(types: tuple[str, ...], categories: tuple[str, ...]) -> tuple[int, ...]:
    """Return the index of each object type in `categories`.

    A type is found by its name or else by its alias; -1 where it is no category.
    """
    index = {name: i for i, name in enumerate(categories)}
    return tuple(index.get(name, index.get(ALIASES.get(name, name), -1)) for name in types)


def most_common(counts: Counter[str], number: int = 5) -> str:
    """Name the most frequent entries and the number of others."""
    shown = ", ".join(f"{name} x {count}" for name, count in counts.most_common(number))
    return shown + (f" and {len(counts) - number} more" if len(counts) > number else "")


def unknown_types(scenes: Iterable[Scene], categories: tuple[str, ...]) -> Counter[str]:
    """Count the objects of types that are no category.

    Such objects only block the sight.
    """
    types = Counter(name for scene in scenes for name in scene.types)
    known = category_ids(tuple(types), categories)
    return Counter({name: types[name] for name, category in zip(types, known, strict=True) if category < 0})
