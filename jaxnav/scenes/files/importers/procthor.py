"""Importer of ProcTHOR houses (schema 1.0.0).

A house has rooms, walls with doors and a tree of objects, but no reachable positions.
"""

import dataclasses
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers import polygons
from jaxnav.scenes.files.importers.assemble import Note, Thing, lattice_cells, scene
from jaxnav.scenes.files.importers.procthor_objects import read_assets, read_objects
from jaxnav.scenes.files.importers.procthor_walls import read_rooms, read_walls
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.generate.rooms import AGENT_RADIUS, OBSTACLE_HEIGHTS
from jaxnav.scenes.scene import CELL, MAX_SIDE, Room, Scene

_FARTHEST = 2  # cells that an agent's place may be from free floor

# Where the types and sizes of ProcTHOR's assets are.
_DATABASE = "procthor/databases/asset-database.json of github.com/allenai/procthor"


def read_procthor(
    path: Path, split: str, assets: Path | None = None, agent_part: bool = False
) -> Iterator[Scene | InputError | Note]:
    """Read ProcTHOR houses.

    The agent can stand on the lattice points of the rooms that are at least 0.2 m from walls and from objects whose
    boxes reach into 0.1-1.7 m above the floor. Walls that are marked empty and inner doors that are not shut let it,
    and its sight, through. A house of one room has the type of that room.

    Args:
      path: one house per line (`*.jsonl`), or a house or a list of houses (`*.json`); both also with gzip.
      split: `train`, `val` or `test`.
      assets: asset database (JSON), by asset id or as lists by type. Objects that it does not hold have the type that
        their names say, and typical sizes.
      agent_part: only the cells that are connected with the agent's place in the file (`metadata.agent`); it is moved
        to the nearest free cell, at most 0.5 m away.

    Yields:
      A scene `<file>-<index>` for each house and notes of what was guessed or moved, or the error that says why there
      is no scene.

    Raises:
      InputError: a file is missing or damaged, or holds no house.
    """
    known = read_assets(assets) if assets else {}
    mend = "" if assets else f"; --assets tells them, {_DATABASE}"
    stem = re.sub(r"\.jsonl?(\.gz)?$", "", path.name)
    index = -1
    for index, (where, value) in enumerate(_houses(path)):
        name = f"{stem}-{index}"
        try:
            if isinstance(value, InputError):
                raise value
            house = Record(where, {}).record(f"house {name!r}", value)
            objects = read_objects(house, known)
            whole = _scene(house, name, split, objects.things)
            reach, moved = _agent_part(house, whole) if agent_part else (whole.reach, False)
        except InputError as error:
            yield error
        else:
            yield dataclasses.replace(whole, reach=reach)
            counts = {
                f"types of objects are guessed from the names of their assets{mend}": objects.types,
                f"sizes of objects are the typical ones of their types{mend}": objects.sizes,
                "agents are moved to the nearest free cell": int(moved),
                "cells are not connected with the agent and left out": int((whole.reach & ~reach).sum()),
            }
            yield from (Note(text, count) for text, count in counts.items() if count)
    if index < 0:
        raise InputError(f"{path}: holds no house; write one JSON object per line")


def _houses(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the place of each house and its JSON.

    For a line that is not JSON it yields the error.
    """
    content = read_bytes(path)
    by_line = _by_line(path, content)
    for number, text in enumerate(io.BytesIO(content) if by_line else [content], start=1):
        where = f"{path}, line {number}" if by_line else str(path)
        if text.strip() or not by_line:
            try:
                value = parse_json(where, text)
            except InputError as error:
                if not by_line:
                    raise
                value = error
            yield from ((where, house) for house in (value if isinstance(value, list) else [value]))


def _by_line(path: Path, content: bytes) -> bool:
    """Return whether each line is JSON by itself.

    For damaged files the name decides.
    """
    try:
        parse_json(str(path), next((line for line in io.BytesIO(content) if line.strip()), b""))
    except InputError:
        return ".jsonl" in path.name
    return True


def _scene(house: Record, name: str, split: str, things: Sequence[Thing]) -> Scene:
    floors = read_rooms(house)
    corners = np.concatenate([floor.corners for floor in floors])
    # One more cell all around holds the outer walls.
    low, high = np.floor(corners.min(axis=0) / CELL) - 1, np.ceil(corners.max(axis=0) / CELL) + 1
    if (high - low > MAX_SIDE).any():
        raise house.error("rooms", f"span more than {MAX_SIDE * CELL:g} m; give one house at a time")
    x, z = (CELL * np.arange(first, last + 1) for first, last in zip(low, high, strict=True))

    rooms = tuple(Room(floor.type, polygons.inside(floor.corners, x, z)) for floor in floors)
    walls = read_walls(house, {floor.id for floor in floors})
    centre, size = np.split(np.array([thing.box for thing in things]), 2, axis=1)
    boxes = np.stack([centre - size / 2, centre + size / 2], axis=1)  # [N, 2, 3]
    in_way = boxes[(boxes[:, 0, 1] < OBSTACLE_HEIGHTS[1]) & (boxes[:, 1, 1] > OBSTACLE_HEIGHTS[0])][:, :, [0, 2]]
    indoors = np.any([room.cells for room in rooms], axis=0)
    free = indoors & ~polygons.nearer(np.concatenate([walls, in_way]), x, z, AGENT_RADIUS)
    if not free.any():
        raise house.error("rooms", f"have no floor {AGENT_RADIUS} m from walls and objects; leave the house out")
    return scene(
        *(name, "procthor", rooms[0].type if len(rooms) == 1 else "house", split),
        origin=(float(x[0]), float(z[0])),
        reach=free,
        # A wall on the border of two cells takes both. Where walls meet they share a cell, so that no sight slips
        # through; the square of a standable cell, at most 0.18 m from its centre, touches none.
        walls=polygons.touched(walls, x, z),
        things=things,
        rooms=rooms,
    )


def _agent_part(house: Record, whole: Scene) -> tuple[np.ndarray, bool]:
    """Return the cells connected with the agent, bool [nz, nx].

    Also whether its place had to be moved.
    """
    metadata = house.record("metadata", house.get("metadata"))
    agent = metadata.record("agent", metadata.get("agent"))
    place = agent.vector("position", agent.get("position"), "xz")
    cell = lattice_cells(agent, "position", [place])[0] - np.rint(np.divide(whole.origin[::-1], CELL)).astype(int)
    free = np.argwhere(whole.reach)
    distances = np.linalg.norm(free - cell, axis=1)
    nearest = int(distances.argmin())
    if distances[nearest] > _FARTHEST:
        raise agent.error("position", f"is {place} (x, z), where the agent cannot stand; put it on free floor")
    return polygons.connected_part(whole.reach, free[nearest]), distances[nearest] > 0
