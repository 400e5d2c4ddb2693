"""Import of random ProcTHOR houses, checked point by point against the rules."""

import itertools
import json
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.procthor import build, door, item, point
from support.scene_geometry import EIGHT, FOUR, parts_of
from support.scene_records import scenes_and_errors

from jaxnav.scenes.files.importers.procthor import read_procthor


class RandomHouse(NamedTuple):
    """Two rooms, a door between them and a turned fridge.

    Attributes:
      width: metres along x.
      depth: metres along z.
      middle: x of the wall between the rooms.
      door_start: z where the door begins, 1 m wide.
      is_shut: whether the door is shut.
      fridge: x and z of the fridge's centre.
      fridge_size: metres along x and z at yaw 0.
      yaw: clockwise degrees of the fridge.
    """

    width: float
    depth: float
    middle: float
    door_start: float
    is_shut: bool
    fridge: tuple[float, float]
    fridge_size: tuple[float, float]
    yaw: float

    @property
    def start(self) -> tuple[float, float]:
        """Return x, z of the agent, more than 0.2 m from the fridge and the walls."""
        return self.width // 0.25 * 0.25 - 0.25, 0.5

    def document(self) -> dict[str, Any]:
        """Return the ProcTHOR record of the house."""
        width = self.width
        depth = self.depth
        middle = self.middle
        wall_name = f"{middle:.2f}|0.00|{middle:.2f}|{depth:.2f}"
        openness = 0.0 if self.is_shut else 0.3
        return build(
            ("Kitchen", [(0, 0), (middle, 0), (middle, depth), (0, depth)]),
            ("Bedroom", [(middle, 0), (width, 0), (width, depth), (middle, depth)]),
            doors=(door(wall_name, self.door_start, self.door_start + 1.0, openness=openness),),
            objects=(item("Fridge|2|0", "Fridge_1", self.fridge[0], 0.9, self.fridge[1], self.yaw),),
            agent=self.start,
        )

    def fridge_box(self) -> tuple[float, ...]:
        """Return low x, z and high x, z of the fridge, turned clockwise: x to -z at 90 degrees."""
        angle = np.deg2rad(self.yaw)
        corners = np.array(list(itertools.product((-0.5, 0.5), repeat=2))) * self.fridge_size
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned_corners = self.fridge + corners @ rotation
        return *turned_corners.min(axis=0), *turned_corners.max(axis=0)

    def wall_lines(self) -> list[tuple[float, ...]]:
        """Return low x, z and high x, z of every wall."""
        width = self.width
        depth = self.depth
        middle = self.middle
        outer_walls = [(0, 0, width, 0), (0, depth, width, depth), (0, 0, 0, depth), (width, 0, width, depth)]
        if self.is_shut:
            return [*outer_walls, (middle, 0, middle, depth)]
        before_door = (middle, 0, middle, self.door_start)
        after_door = (middle, self.door_start + 1.0, middle, depth)
        return [*outer_walls, before_door, after_door]


@st.composite
def random_houses(draw: st.DrawFn) -> RandomHouse:
    """Draw a house whose lengths are whole centimetres."""

    def within(low: float, high: float) -> float:
        return round(draw(st.floats(low, high)), 2)

    width = within(5.0, 8.0)
    depth = within(2.5, 4.0)
    middle = within(2.0, 3.5)
    return RandomHouse(
        width=width,
        depth=depth,
        middle=middle,
        door_start=within(0.0, depth - 1.0),
        is_shut=draw(st.booleans()),
        fridge=(within(0.0, width - 1.5), within(0.0, depth)),
        fridge_size=(within(0.0, 1.0), within(0.0, 1.0)),
        yaw=within(0.0, 360.0),
    )


def offsets_from_box(points: np.ndarray, box: tuple[float, ...]) -> np.ndarray:
    """Return the distances along x and z [2, Z, X] of points [2, Z, X] from a box (low x, z and high x, z)."""
    low_corner = np.array(box[:2])[:, None, None]
    high_corner = np.array(box[2:])[:, None, None]
    return np.maximum(0, np.maximum(low_corner - points, points - high_corner))


@pytest.mark.slow
@given(random_houses())
def test_read_procthor_imports_random_houses_by_the_rules(tmp_path_factory, house):
    house_file = tmp_path_factory.mktemp("random") / "house.json"
    house_file.write_text(json.dumps(house.document()))
    assets = {"Fridge_1": {"boundingBox": point(house.fridge_size[0], 1.8, house.fridge_size[1])}}
    asset_file = house_file.with_name("assets.json")
    asset_file.write_text(json.dumps(assets))
    (scene,), _ = scenes_and_errors(read_procthor(house_file, "train", asset_file))

    # The centres of all cells, [2, Z, X].
    num_z, num_x = scene.reach.shape
    x = scene.origin[0] + 0.25 * np.arange(num_x)
    z = scene.origin[1] + 0.25 * np.arange(num_z)
    points = np.stack(np.meshgrid(x, z))

    # Standable cells are inside, and 0.2 m from the fridge and all walls.
    wall_lines = house.wall_lines()
    is_free = (points[0] > 0) & (points[0] < house.width) & (points[1] > 0) & (points[1] < house.depth)
    for box in [house.fridge_box(), *wall_lines]:
        is_free &= np.hypot(*offsets_from_box(points, box)) >= 0.2 - 1e-9
    np.testing.assert_array_equal(scene.reach, is_free)

    # On request they are those connected with the agent.
    is_start = np.isclose(points[0], house.start[0]) & (points[1] == house.start[1])
    part_labels = parts_of(is_free, EIGHT).labels
    results = read_procthor(house_file, "train", asset_file, agent_part=True)
    (agent_scene, *_), _ = scenes_and_errors(results)
    np.testing.assert_array_equal(agent_scene.reach, part_labels == part_labels[is_start])

    # Walls take the cells within half a cell of their lines.
    is_wall = np.zeros_like(scene.walls)
    for box in wall_lines:
        is_wall |= offsets_from_box(points, box).max(axis=0) <= 0.125 + 1e-9
    np.testing.assert_array_equal(scene.walls, is_wall)
    assert not (scene.reach & scene.walls).any()

    # Sight does not slip diagonally between wall cells, and passes an open door.
    kitchen_floor = scene.rooms[0].cells & ~scene.walls
    sight_labels = parts_of(~scene.walls, EIGHT if house.is_shut else FOUR).labels
    assert (sight_labels[kitchen_floor] == sight_labels[is_start]).all() != house.is_shut
