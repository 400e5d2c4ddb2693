"""Objects of ProcTHOR houses, and the database of their assets."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.files.importers.assemble import Thing
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.generate.sizes import typical_box


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


def read_things(house: Record, assets: dict[str, Asset]) -> list[Thing]:
    """Read the objects, each before what it holds.

    Positions in the file are in the world, also those of children.

    Raises:
      InputError: an object is damaged, or there is none.
    """
    objects = house.sequence("objects", house.get("objects"))
    if not objects:
        raise house.error("objects", "is empty; give at least one object to look for")
    things: list[Thing] = []
    left = [(f"objects[{i}]", value, -1) for i, value in enumerate(objects)][::-1]
    while left:
        field, value, parent = left.pop()
        item = house.record(field, value)
        children = item.sequence("children", item.fields.get("children") or [])
        left += [(f"{field}.children[{i}]", child, len(things)) for i, child in enumerate(children)][::-1]
        things.append(_thing(item, assets, parent))
    return things


def _thing(item: Record, assets: dict[str, Asset], parent: int) -> Thing:
    asset = assets.get(str(item.fields.get("assetId")), Asset())
    kind = _type(item, asset)
    position = item.vector("position", item.get("position"))
    (yaw,) = item.vector("rotation", item.get("rotation"), "y")
    if asset.size is None:
        size = typical_box(kind)[:3]  # of boxes in the world, whatever the yaw
    else:
        cos, sin = abs(np.cos(np.deg2rad(yaw))), abs(np.sin(np.deg2rad(yaw)))
        sx, sy, sz = asset.size
        size = (cos * sx + sin * sz, sy, sin * sx + cos * sz)
    return Thing(kind, (*position, *size), yaw, parent)


def _type(item: Record, asset: Asset) -> str:
    if item.fields.get("objectType") is not None:
        return item.text("objectType", item.get("objectType"))
    if asset.type:
        return asset.type
    prefix, bar, _ = item.text("id", item.get("id")).partition("|")
    if bar and prefix and prefix != "small" and not prefix.isdigit():
        return prefix
    name = item.text("assetId", item.get("assetId"))
    return re.sub(r"(_\d+)+$", "", name).replace("_", "") or name  # Alarm_Clock_12 is an AlarmClock
