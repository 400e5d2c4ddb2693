"""The layout shift of homes.

With some probability an object is placed by the rule of another type. Types of similar size and support exchange their
rules by a fixed derangement: each takes the rule of the next of its group, the last that of the first. A scene is first
furnished without a shift; then the same objects are placed again. So a shift changes neither the objects nor their
sizes, but only what stands near what.
"""

import copy
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.generate.furnish import put
from jaxnav.scenes.generate.furnished_room import FurnishedRoom, Placed
from jaxnav.scenes.generate.room_rules import Item, Rule
from jaxnav.scenes.scene import SPLITS

ATTEMPTS = 20  # to place the objects of a room


def check_scene_arguments(function: str, split: str, index: int, seed: int, shift: float) -> None:
    """Check the arguments of a generator.

    Raises:
      InputError: unknown split, negative index or seed, or a shift that is not in [0, 1].
    """
    if split not in SPLITS:
        raise InputError(f"{function}: split is {split!r}; choose one of {', '.join(SPLITS)}")
    for name, number in {"index": index, "seed": seed}.items():
        if number < 0:
            raise InputError(f"{function}: {name} is {number}; give a number of at least 0")
    if not 0.0 <= shift <= 1.0:  # NaN is refused, too
        raise InputError(f"{function}: shift is {shift}; give a number from 0 to 1")


def derangement(groups: Iterable[Sequence[str]]) -> dict[str, str]:
    """Return the type whose rule each type takes.

    It is the next of its group, cyclically.

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
    """Describe an object to be placed again.

    Attributes:
      object: what it is, with the rule that it was placed by.
      owner: the type whose rule it takes.
      room: index of the room to place it in.
    """

    object: Placed
    owner: str
    room: int


def shift_objects(
    bare: Sequence[FurnishedRoom],
    rules: Sequence[Mapping[str, Item]],
    before: Sequence[FurnishedRoom],
    partners: Mapping[str, str],
    shift: float,
    rng: np.random.Generator,
) -> list[FurnishedRoom] | None:
    """Place the objects of a furnished home again.

    Each is placed by the rule of its type or, with probability `shift`, by that of its partner. The rule of a type
    includes its room. Where a rule has no place in the room, because its support is elsewhere, the object goes to
    another support, a wall or the middle of the room, and failing that to another room.

    Args:
      bare: the rooms without furniture.
      rules: per room, the types and rules of its room type, in the order in which they are put.
      before: the same rooms, furnished.
      partners: the `derangement`.
      shift: probability in [0, 1].
      rng: source of randomness.

    Returns:
      The rooms with the same objects of the same sizes, or None if one of them has no place.
    """
    rooms = [copy.deepcopy(room) for room in bare]
    moves = [Move(placed, placed.name, k) for k, room in enumerate(before) for placed in room.placed]
    exchanged = rng.random(len(moves)) < shift
    moves = [
        _draw_room(move, partners[move.object.name], rules, rng) if swaps and move.object.name in partners else move
        for move, swaps in zip(moves, exchanged, strict=True)
    ]
    rank = [{name: i for i, name in enumerate(items)} for items in rules]
    # What others are put on or near comes early, whichever rule it is put by.
    moves.sort(key=lambda move: min(rank[move.room].get(name, np.inf) for name in (move.owner, move.object.name)))
    return rooms if all(_place(rooms, rules, move, rng) for move in moves) else None


def settle(
    bare: Sequence[FurnishedRoom],
    rooms: Sequence[FurnishedRoom],
    usable: Callable[[int, FurnishedRoom], bool],
    rng: np.random.Generator,
) -> list[FurnishedRoom] | None:
    """Place the objects of unusable rooms again.

    Args:
      bare: the rooms without furniture.
      rooms: the same rooms, furnished.
      usable: whether a room (its index, the room) can stay as it is.
      rng: source of randomness.

    Returns:
      The rooms, or None if one of them does not become usable.
    """
    settled = []
    for k, room in enumerate(rooms):
        tries = (_place_again(bare[k], room.placed, rng) for _ in range(ATTEMPTS))
        good = room if usable(k, room) else next((again for again in tries if again and usable(k, again)), None)
        if good is None:
            return None
        settled.append(good)
    return settled


def _place_again(bare: FurnishedRoom, placed: Sequence[Placed], rng: np.random.Generator) -> FurnishedRoom | None:
    """Place the objects of a room by the same rules.

    Returns:
      The room, or None if one of them has no place.
    """
    room = copy.deepcopy(bare)
    return room if all(put(room, name, item, size, rng) for name, item, size in placed) else None


def _draw_room(move: Move, owner: str, rules: Sequence[Mapping[str, Item]], rng: np.random.Generator) -> Move:
    """Draw the room for an object that takes another rule.

    Rooms with more objects of the type `owner` are likelier.
    """
    usual = np.array([_expected(items[owner]) if owner in items else 0.0 for items in rules])
    if not usual.any():  # no room of such a type: any will do
        usual += 1.0
    return Move(move.object, owner, int(rng.choice(len(rules), p=usual / usual.sum())))


def _expected(item: Item) -> float:
    return item.has * float(np.mean(item.count))


def _place(
    rooms: Sequence[FurnishedRoom], rules: Sequence[Mapping[str, Item]], move: Move, rng: np.random.Generator
) -> bool:
    """Put an object into its room, or else into another.

    Of the other rooms those with the rule of `owner` come first, and then those that do not have the object's type.

    Returns:
      Whether there is a place for it.
    """
    (name, item, size), owner = move.object, move.owner
    order = [int(k) for k in rng.permutation(len(rooms))]
    order.sort(key=lambda k: (k != move.room, owner not in rules[k], name in rules[k]))
    for k in order:
        usual = [rules[k][owner].rule] if owner in rules[k] else []
        for rule in (*usual, _elsewhere(rooms[k], rules, item.rule)):
            if put(rooms[k], name, dataclasses.replace(item, rule=rule), size, rng):
                return True
    return False


def _elsewhere(room: FurnishedRoom, rules: Sequence[Mapping[str, Item]], usual: Rule) -> Rule:
    """Return a rule for unusual places.

    They are the supports that the usual rule does not name, or the floor for objects that stand on it.
    """
    if not any(place.startswith("on ") for place in usual.at):
        return Rule({"wall": 1.0, "middle": 0.2}, bottom=usual.bottom)
    named = {place for items in rules for item in items.values() for place in item.rule.at if place.startswith("on ")}
    supports = [place for place in sorted(named - set(usual.at)) if place[3:] in room.types]
    return Rule(dict.fromkeys(supports, 1.0), bottom=usual.bottom)
