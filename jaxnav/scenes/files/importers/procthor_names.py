"""Types of objects by the names of ProcTHOR's assets and of Objaverse's types."""

import functools
import re

from jaxnav.scenes.categories import GIBSON_CATEGORIES, ITHOR_CATEGORIES, ROBOTHOR_CATEGORIES, category_ids
from jaxnav.scenes.generate.sizes import typical_types

#: Names, in small letters without spaces, that are not simply the name of a type with a typical size.
_OTHER_NAMES = {
    # of AI2-THOR's and ProcTHOR's assets
    "bathtubfaucet": "Faucet", "bin": "GarbageCan", "bnydsalt": "SaltShaker", "boot": "Boots", "cart": "Cart",
    "clothesdryer": "ClothesDryer", "decorativebox": "Box", "doorframe": "Doorframe", "officechair": "Chair",
    "papertowel": "PaperTowelRoll", "photo": "Painting", "remote": "RemoteControl", "tabletopdecor": "TableTopDecor",
    "tennisracquet": "TennisRacket", "vacuumcleaner": "VacuumCleaner",
    # of Objaverse's types
    "books": "Book", "cellulartelephone": "CellPhone", "chairs": "Chair", "coffeemaker": "CoffeeMachine",
    "couch": "Sofa", "kitchentable": "DiningTable", "laptopcomputer": "Laptop", "microwaveoven": "Microwave",
    "plant": "HousePlant", "refrigerator": "Fridge", "stepstool": "Footstool", "tablelamp": "DeskLamp",
    "teakettle": "Kettle", "trashcan": "GarbageCan",
}  # fmt: skip
_OBJAVERSE = "Obja"


def asset_type(name: str) -> str | None:
    """Return the type that an asset's name tells, if any.

    It is the longest run of the name's words that is known, and of equally long runs the last: `bin_8` is a GarbageCan,
    `RoboTHOR_sofa_kramfors` a Sofa, `Towel_Statue_2` a Statue.
    """
    words = re.findall("[a-z]+", name.lower())
    runs = ((first, first + n) for n in range(len(words), 0, -1) for first in range(len(words) - n, -1, -1))
    return next(filter(None, (_names().get("".join(words[first:last])) for first, last in runs)), None)


def object_type(name: str) -> str:
    """Return the type of an object whose type the file names.

    Of Objaverse's types the last words count, since they say what it is: `ObjaBarStool` is a Stool and `ObjaTrashCan` a
    GarbageCan. Those whose ends name no category of any world stay as they are, like all other types.
    """
    words = re.findall("[A-Z][a-z]*", name.removeprefix(_OBJAVERSE)) if name.startswith(_OBJAVERSE) else []
    ends = (_names().get("".join(words[first:]).lower()) for first in range(len(words)))
    kind = next(filter(None, ends), name)
    (category,) = category_ids((kind,), (*ITHOR_CATEGORIES, *ROBOTHOR_CATEGORIES, *GIBSON_CATEGORIES))
    return kind if category >= 0 else name


@functools.cache
def _names() -> dict[str, str]:
    return {kind.lower(): kind for kind in typical_types()} | _OTHER_NAMES
