"""Importer of the offline folders `Scene_Data`.

SAVN, ORG, VTNet, HOZ and the paper's released code share them. A scene is a folder with `grid.json` (or `graph.json`)
and `visible_object_map_1.5.json` (or `visible_object_map.json`).
"""

import re
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import STRUCTURE, pivot_box, scene_name, standable, world_and_room_type
from jaxnav.scenes.files.importers.assemble import Thing, lattice_cells, scene_of_cells
from jaxnav.scenes.files.record import Record, parse_json, read_bytes
from jaxnav.scenes.scene import CELL, Scene

_GRID, _GRAPH = "grid.json", "graph.json"
_MAPS = ("visible_object_map_1.5.json", "visible_object_map.json")

_NUMBER = r"([-+]?[0-9]+\.[0-9]+)"
_STATE = re.compile(rf"{_NUMBER}\|{_NUMBER}\|[0-9]+\|-?[0-9]+")  # x|z|rotation|horizon
_OBJECT = re.compile(rf"([A-Za-z0-9]+)\|{_NUMBER}\|{_NUMBER}\|{_NUMBER}(?:\|([A-Za-z0-9]+))?")  # Type|x|y|z|PartType


def read_scene_data(path: Path, split: str) -> Iterator[Scene | InputError]:
    """Read an offline folder.

    Cells come from `grid.json`, or else from the nodes of `graph.json`; objects from the ids in the visibility map,
    except those that are visible from nowhere. The files have no sizes, so objects get typical ones. Other files are
    not opened.

    Args:
      path: the folder `Scene_Data`, or that of one scene.
      split: split of the scenes.

    Yields:
      A scene per folder in the order of the names, or why it cannot be used.

    Raises:
      InputError: `path` is no folder, or no folder of scenes.
    """
    if not path.is_dir():
        raise InputError(f"{path}: is no folder; give Scene_Data or the folder of one scene")
    folders = [path] if _is_scene(path) else sorted(folder for folder in path.iterdir() if _is_scene(folder))
    if not folders:
        raise InputError(f"{path}: holds no scene; give the folder whose folders have {_GRID} and {_MAPS[0]}")
    for folder in folders:
        yield _scene_or_error(folder, split)


def _is_scene(folder: Path) -> bool:
    return any((folder / file).is_file() for file in (_GRID, _GRAPH, *_MAPS))


def _scene_or_error(folder: Path, split: str) -> Scene | InputError:
    name = scene_name(folder.resolve().name)
    try:
        cells, floor = _cells(folder, name)
        return scene_of_cells(name, *world_and_room_type(name), split, cells, _things(folder, name, floor))
    except InputError as error:
        return error


def _load(file: Path, name: str) -> tuple[Record, Any]:
    """Return a record that names a file, and its content."""
    where = f"{file}, scene {name!r}"
    return Record(where, {}), parse_json(where, read_bytes(file))


def _cells(folder: Path, name: str) -> tuple[np.ndarray, float]:
    """Read standable lattice indices and the height of the floor.

    Returns:
      int [N, 2], (iz, ix), and metres.
    """
    grid, graph = folder / _GRID, folder / _GRAPH
    nodes = _node_cells(*_load(graph, name)) if graph.is_file() else None
    if nodes is not None and not grid.is_file():
        return nodes, 0.0
    record, points = _load(grid, name)
    cells, floor = standable(record, "grid", record.sequence("grid", points))
    if nodes is not None and (stray := set(map(tuple, nodes.tolist())) - set(map(tuple, cells.tolist()))):
        z, x = (CELL * index for index in min(stray))
        raise record.error("grid", f"lacks x {x}, z {z}, a node of {_GRAPH}; take both files from one release")
    return cells, floor


def _node_cells(record: Record, value: Any) -> np.ndarray:
    """Read the lattice indices of a graph's nodes, (iz, ix).

    It is a networkx node-link graph, whose edges are not needed.
    """
    graph = record.record("graph", value)
    points = []
    for i, node in enumerate(graph.sequence("nodes", graph.get("nodes"))):
        inner = graph.record(f"nodes[{i}]", node)
        state = inner.text("id", inner.get("id"))
        match = _STATE.fullmatch(state)
        if match is None:
            raise inner.error("id", f"is {reprlib.repr(state)}; give x|z|rotation|horizon, x and z as 0.25")
        points.append([inner.number("id", float(number)) for number in match.groups()])
    return lattice_cells(graph, "nodes", points)


def _things(folder: Path, name: str, floor: float) -> list[Thing]:
    """Read the visible objects from their ids."""
    file = next((folder / file for file in _MAPS if (folder / file).is_file()), folder / _MAPS[0])
    record, value = _load(file, name)
    things = []
    for key, states in record.record("map", value).fields.items():
        label = reprlib.repr(key)
        if not record.sequence(label, states):
            continue
        match = _OBJECT.fullmatch(key)
        if match is None:
            raise record.error(label, "is no id; give Type|x|y|z or leave the object out")
        kind = match[5] or match[1]
        if kind not in STRUCTURE:
            x, y, z = (record.number(label, float(number)) for number in match.group(2, 3, 4))
            things.append(Thing(kind, pivot_box(kind, x, y - floor, z)))
    if not things:
        raise record.error("map", "names no object that is visible from somewhere; give at least one")
    return things
