"""The dial of homes: with some probability an object is placed by the rule of another type.

Types of like size and footing exchange their rules by a fixed derangement: each takes the rule of the next of its
group, the last that of the first. A scene is first furnished by the types' own rules; then the very same objects are
placed anew, so that a shift changes neither what there is nor how large it is, but only what stands near what.
"""

import copy
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.generate.furnish import Furnishing, Placed, put
from jaxnav.scenes.generate.room_rules import Item, Rule
from jaxnav.scenes.scene import SPLITS

ATTEMPTS = 20  # at a room with the objects that it was given


def check_scene_arguments(function: str, split: str, index: int, seed: int, shift: float) -> None:
    """Refuses what no scene can be generated from with an `InputError`."""
    if split not in SPLITS:
        raise InputError(f"{function}: split is {split!r}; choose one of {', '.join(SPLITS)}")
    for name, number in {"index": index, "seed": seed}.items():
        if number < 0:
            raise InputError(f"{function}: {name} is {number}; give a number of at least 0")
    if not 0.0 <= shift <= 1.0:  # NaN is refused, too
        raise InputError(f"{function}: shift is {shift}; give a number from 0 to 1")


def derangement(groups: Iterable[Sequence[str]]) -> dict[str, str]:
    """The type whose rule each type takes: the next of its group, cyclically.

    Raises:
      InputError: a group has fewer than two types, or a type is listed twice.
    """
    partners: dict[str, str] = {}
    for group in groups:
        if len(group) < 2:
            raise InputError(f"exchange: the group {list(group)} has nobody to exchange with; name at least two types")
        for name, partner in zip(group, [*group[1:], group[0]], strict=True):
            if name in partners:
                raise InputError(f"exchange: {name} is listed twice; a type can take one rule only")
            partners[name] = partner
    return partners


class Move(NamedTuple):
    """An object that is to be placed anew.

    Attributes:
      object: what it is, with the rule that it was placed by.
      owner: the type whose rule it takes.
      room: the room that it was in, then the one that it is meant for.
    """

    object: Placed
    owner: str
    room: int


def place_anew(
    bare: Sequence[Furnishing],
    rules: Sequence[Mapping[str, Item]],
    before: Sequence[Furnishing],
    partners: Mapping[str, str],
    shift: float,
    rng: np.random.Generator,
) -> list[Furnishing] | None:
    """Places the objects of a furnished home anew, each by its own rule or with probability `shift` by its partner's.

    The rule of a type includes its room. Where a rule has no place in the room, for its support is elsewhere, the
    object goes to another support, a wall or the middle of the room, and failing that to another room.

    Args:
      bare: the rooms without furniture.
      rules: per room, the types and rules of its room type, in the order in which they are put.
      before: the same rooms, furnished.
      partners: the `derangement`.
      shift: probability in [0, 1].
      rng: source of randomness.

    Returns:
      The rooms with the same objects of the same sizes; None if one of them found no place.
    """
    rooms = [copy.deepcopy(room) for room in bare]
    moves = [Move(placed, placed.name, k) for k, room in enumerate(before) for placed in room.placed]
    exchanged = rng.random(len(moves)) < shift
    moves = [
        _meant_for(move, partners[move.object.name], rules, rng) if swaps and move.object.name in partners else move
        for move, swaps in zip(moves, exchanged, strict=True)
    ]
    rank = [{name: i for i, name in enumerate(items)} for items in rules]
    # What others are put on or near comes early, by whatever rule it is put itself.
    moves.sort(key=lambda move: min(rank[move.room].get(name, np.inf) for name in (move.owner, move.object.name)))
    return rooms if all(_place(rooms, rules, move, rng) for move in moves) else None


def place_again(bare: Furnishing, placed: Sequence[Placed], rng: np.random.Generator) -> Furnishing | None:
    """Places objects of one room anew by the rules that they were placed by; None if one of them finds no place."""
    room = copy.deepcopy(bare)
    return room if all(put(room, name, item, size, rng) for name, item, size in placed) else None


def settle(
    bare: Sequence[Furnishing],
    rooms: Sequence[Furnishing],
    sound: Callable[[int, Furnishing], bool],
    rng: np.random.Generator,
) -> list[Furnishing] | None:
    """Places the objects of each room again until it is `sound` (its index, the room); None if one room never is."""
    settled = []
    for k, room in enumerate(rooms):
        tries = (place_again(bare[k], room.placed, rng) for _ in range(ATTEMPTS))
        good = room if sound(k, room) else next((again for again in tries if again and sound(k, again)), None)
        if good is None:
            return None
        settled.append(good)
    return settled


def _meant_for(move: Move, owner: str, rules: Sequence[Mapping[str, Item]], rng: np.random.Generator) -> Move:
    """The move into a room that has the rule of `owner`, likelier where there are more of its objects."""
    usual = np.array([_expected(items[owner]) if owner in items else 0.0 for items in rules])
    if not usual.any():  # no room of such a type: any will do
        usual += 1.0
    return Move(move.object, owner, int(rng.choice(len(rules), p=usual / usual.sum())))


def _expected(item: Item) -> float:
    return item.has * float(np.mean(item.count))


def _place(
    rooms: Sequence[Furnishing], rules: Sequence[Mapping[str, Item]], move: Move, rng: np.random.Generator
) -> bool:
    """Puts the object of one move into the room that it is meant for, or else into another, where it is strange."""
    (name, item, size), owner = move.object, move.owner
    order = [int(k) for k in rng.permutation(len(rooms))]
    order.sort(key=lambda k: (k != move.room, owner not in rules[k], name in rules[k]))
    for k in order:
        at_home = [rules[k][owner].rule] if owner in rules[k] else []
        for rule in (*at_home, _elsewhere(rooms[k], rules, item.rule)):
            if put(rooms[k], name, dataclasses.replace(item, rule=rule), size, rng):
                return True
    return False


def _elsewhere(room: Furnishing, rules: Sequence[Mapping[str, Item]], own: Rule) -> Rule:
    """Any support that the own rule does not name, if there is one, or the floor for what stands on it."""
    if not any(place.startswith("on ") for place in own.at):
        return Rule({"wall": 1.0, "middle": 0.2}, bottom=own.bottom)
    named = {place for items in rules for item in items.values() for place in item.rule.at if place.startswith("on ")}
    supports = [place for place in sorted(named - set(own.at)) if place[3:] in room.types]
    return Rule(dict.fromkeys(supports, 1.0), bottom=own.bottom)
