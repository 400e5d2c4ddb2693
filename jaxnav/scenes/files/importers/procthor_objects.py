"""Objects of ProcTHOR houses, and the database of their assets."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.files.importers.assemble import Thing
from jaxnav.scenes.files.importers.procthor_names import asset_type, object_type
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.generate.sizes import typical_box

_COUNTER = re.compile(r"Countertop_([LCI]|Island)_(\d+)x(\d+)")  # form, width and depth in feet
_FOOT, _COUNTER_HEIGHT, _STRIP = 0.305, 0.94, 0.61  # metres; the last is the depth of a counter along a wall


class Asset(NamedTuple):
    """Hold what the asset database says of an asset.

    Attributes:
      type: name of its type.
      size: width, height and depth at yaw 0, metres.
    """

    type: str | None = None
    size: list[float] | None = None


def read_assets(path: Path) -> dict[str, Asset]:
    """Read the asset database, by asset id.

    The file is `{asset id: asset}` or `{type: [asset, ...]}`.

    Raises:
      InputError: the file is missing or damaged.
    """
    database = Record(str(path), {}).record("asset database", parse_json(str(path), read_bytes(path)))
    assets = {}
    for key, value in database.fields.items():
        for entry in value if isinstance(value, list) else [value]:
            asset = database.record(key, entry)
            asset_id = asset.get("assetId") if isinstance(value, list) else key
            kind, box = asset.fields.get("objectType"), asset.fields.get("boundingBox")
            kind = None if kind is None else asset.text("objectType", kind)
            size = None if box is None else asset.vector("boundingBox", box)
            if size and min(size) < 0:
                raise asset.error("boundingBox", f"is {size}; a size is at least 0")
            assets[asset.text("assetId", asset_id)] = Asset(kind, size)
    return assets


class Objects(NamedTuple):
    """Hold the objects of a house, and how many of them are guessed.

    Attributes:
      things: each before what it holds.
      types: number of objects whose type is guessed from the name of their asset.
      sizes: number of objects whose size is the typical one of their type.
    """

    things: list[Thing]
    types: int
    sizes: int


def read_objects(house: Record, assets: dict[str, Asset]) -> Objects:
    """Read the objects of a house.

    Positions in the file are in the world, also those of children.

    Raises:
      InputError: an object is damaged, or there is none.
    """
    objects = house.sequence("objects", house.get("objects"))
    if not objects:
        raise house.error("objects", "is empty; give at least one object to look for")
    things: list[Thing] = []
    types = sizes = 0
    left = [(f"objects[{i}]", value, -1) for i, value in enumerate(objects)][::-1]
    while left:
        field, value, parent = left.pop()
        item = house.record(field, value)
        children = item.sequence("children", item.fields.get("children") or [])
        left += [(f"{field}.children[{i}]", child, len(things)) for i, child in enumerate(children)][::-1]
        asset = assets.get(str(item.fields.get("assetId")), Asset())
        kind = _told_type(item, asset)
        size = asset.size or _named_size(str(item.fields.get("assetId")))
        things += _strips(item, kind or _guessed_type(item), size, parent, len(things))
        types += kind is None
        sizes += size is None
    return Objects(things, types, sizes)


def _strips(item: Record, kind: str, size: list[float] | None, parent: int, index: int) -> list[Thing]:
    """Return an object, a counter around a corner as its strips.

    Further strips rest on the first, whose index is `index`.
    """
    position = item.vector("position", item.get("position"))
    (yaw,) = item.vector("rotation", item.get("rotation"), "y")
    if size is None:
        return [Thing(kind, (*position, *typical_box(kind)[:3]), yaw, parent)]  # of boxes in the world, at any yaw
    cos, sin = np.cos(np.deg2rad(yaw)), np.sin(np.deg2rad(yaw))
    turn = np.array([[cos, sin], [-sin, cos]])  # of (x, z), clockwise from above
    things = []
    for low, high in _footprints(str(item.fields.get("assetId")), size[0], size[2]):
        x, z = position[::2] + turn @ (low + high) / 2
        sx, sz = np.abs(turn) @ (high - low)
        things.append(Thing(kind, (x, position[1], z, sx, size[1], sz), yaw, index if things else parent))
    return things


def _named_size(asset_id: str) -> list[float] | None:
    """Return the size that a counter's name tells."""
    match = _COUNTER.match(asset_id)
    return [_FOOT * int(match[2]), _COUNTER_HEIGHT, _FOOT * int(match[3])] if match else None


def _footprints(asset_id: str, width: float, depth: float) -> list[np.ndarray]:
    """Return the rectangles that an asset covers.

    They are float64 [2, 2], low and high corner (x, z) at yaw 0, metres from its centre. `Countertop_L_*` lies along
    its low z and its high x, `Countertop_C_*` also along its low x.
    """
    x, z = width / 2, depth / 2
    match = _COUNTER.match(asset_id)
    if match is None or match[1] not in "LC" or min(width, depth) <= _STRIP:
        return [np.array([(-x, -z), (x, z)])]
    strips = [[(-x, -z), (x, _STRIP - z)], [(x - _STRIP, _STRIP - z), (x, z)], [(-x, _STRIP - z), (_STRIP - x, z)]]
    return [np.array(strip) for strip in strips[: 2 if match[1] == "L" else 3]]


def _told_type(item: Record, asset: Asset) -> str | None:
    """Return the type that the file or the database names."""
    if item.fields.get("objectType") is not None:
        return object_type(item.text("objectType", item.get("objectType")))
    if asset.type:
        return asset.type
    prefix, bar, _ = item.text("id", item.get("id")).partition("|")
    return prefix if bar and prefix and prefix != "small" and not prefix.isdigit() else None


def _guessed_type(item: Record) -> str:
    name = item.text("assetId", item.get("assetId"))
    return asset_type(name) or re.sub(r"(_\d+)+$", "", name).replace("_", "") or name
