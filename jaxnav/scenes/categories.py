"""What can be looked for: the ordered vocabulary of detectable object categories."""

from types import MappingProxyType

#: The 22 AI2-THOR categories of the paper, in the index order of its released code.
ITHOR_CATEGORIES: tuple[str, ...] = (
    "AlarmClock", "Book", "Bowl", "CellPhone", "Chair", "CoffeeMachine", "DeskLamp", "FloorLamp",
    "Fridge", "GarbageCan", "Kettle", "Laptop", "LightSwitch", "Microwave", "Pan", "Plate", "Pot",
    "RemoteControl", "Sink", "StoveBurner", "Television", "Toaster",
)  # fmt: skip

#: Room types of the single-room worlds, in the order of the per-type priors.
ROOM_TYPES: tuple[str, ...] = ("kitchen", "living_room", "bedroom", "bathroom")

#: Type names that other simulator versions use for a category.
ALIASES = MappingProxyType({"Stool": "Chair"})


def category_ids(types: tuple[str, ...], categories: tuple[str, ...]) -> tuple[int, ...]:
    """Index of each object type in `categories`, -1 where the type is no category."""
    index = {name: i for i, name in enumerate(categories)}
    return tuple(index.get(ALIASES.get(name, name), -1) for name in types)
