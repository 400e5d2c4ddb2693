"""Random ProcTHOR houses against the rules, checked point by point."""

import json
from typing import Any, NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.importer_inputs.procthor import build, door, item, point
from support.scene_geometry import EIGHT, FOUR, parts_of
from support.scene_records import scenes_and_errors

from jaxnav.scenes.files.importers.procthor import read_procthor


class RandomHouse(NamedTuple):
    """Describe two rooms, a door and a turned fridge."""

    width: float
    depth: float
    middle: float
    door_start: float
    shut: bool
    fridge: tuple[float, float]
    fridge_size: tuple[float, float]
    yaw: float

    @property
    def start(self) -> tuple[float, float]:
        """Return x, z of the agent.

        They are more than 0.2 m from the fridge and the walls.
        """
        return self.width // 0.25 * 0.25 - 0.25, 0.5

    def document(self) -> dict[str, Any]:
        width = self.width
        depth = self.depth
        middle = self.middle
        side = self.door_start
        openness = 0.0 if self.shut else 0.3
        return build(
            ("Kitchen", [(0, 0), (middle, 0), (middle, depth), (0, depth)]),
            ("Bedroom", [(middle, 0), (width, 0), (width, depth), (middle, depth)]),
            doors=(door(f"{middle:.2f}|0.00|{middle:.2f}|{depth:.2f}", side, side + 1.0, openness=openness),),
            objects=(item("Fridge|2|0", "Fridge_1", self.fridge[0], 0.9, self.fridge[1], self.yaw),),
            agent=self.start,
        )

    def fridge_box(self) -> tuple[float, ...]:
        """Return the box around the fridge.

        It is turned clockwise: x to -z at 90 degrees.
        """
        turn = np.deg2rad(self.yaw)
        corners = np.array([(a, b) for a in (-0.5, 0.5) for b in (-0.5, 0.5)]) * self.fridge_size
        turned = self.fridge + corners @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        return *turned.min(axis=0), *turned.max(axis=0)

    def wall_lines(self) -> list[tuple[float, ...]]:
        """Return the walls: low x, z and high x, z."""
        width = self.width
        depth = self.depth
        middle = self.middle
        side = self.door_start
        outer = [(0, 0, width, 0), (0, depth, width, depth), (0, 0, 0, depth), (width, 0, width, depth)]
        return outer + (
            [(middle, 0, middle, depth)]
            if self.shut
            else [(middle, 0, middle, side), (middle, side + 1.0, middle, depth)]
        )


@st.composite
def houses(draw: st.DrawFn) -> RandomHouse:
    def within(low: float, high: float) -> float:
        return round(draw(st.floats(low, high)), 2)

    width, depth, middle = within(5.0, 8.0), within(2.5, 4.0), within(2.0, 3.5)
    return RandomHouse(
        width=width,
        depth=depth,
        middle=middle,
        door_start=within(0.0, depth - 1.0),
        shut=draw(st.booleans()),
        fridge=(within(0.0, width - 1.5), within(0.0, depth)),
        fridge_size=(within(0.0, 1.0), within(0.0, 1.0)),
        yaw=within(0.0, 360.0),
    )


@given(houses())
def test_random_houses_equal_the_rules_point_by_point(tmp_path_factory, house):
    path = tmp_path_factory.mktemp("random") / "house.json"
    path.write_text(json.dumps(house.document()))
    assets = {"Fridge_1": {"boundingBox": point(house.fridge_size[0], 1.8, house.fridge_size[1])}}
    path.with_name("assets.json").write_text(json.dumps(assets))
    (scene,), _ = scenes_and_errors(read_procthor(path, "train", path.with_name("assets.json")))

    x, z = np.meshgrid(
        *(first + 0.25 * np.arange(n) for first, n in zip(scene.origin, scene.reach.T.shape, strict=True))
    )

    def away(box: tuple[float, ...]) -> np.ndarray:
        return np.stack([np.maximum(0, np.maximum(box[i] - v, v - box[2 + i])) for i, v in enumerate((x, z))])

    walls = house.wall_lines()
    free = (x > 0) & (x < house.width) & (z > 0) & (z < house.depth)
    for box in [house.fridge_box(), *walls]:
        free &= np.hypot(*away(box)) >= 0.2 - 1e-9
    np.testing.assert_array_equal(scene.reach, free)
    start = np.isclose(x, house.start[0]) & (z == house.start[1])
    parts = parts_of(free, EIGHT).labels
    (agents, *_), _ = scenes_and_errors(read_procthor(path, "train", path.with_name("assets.json"), agent_part=True))
    np.testing.assert_array_equal(agents.reach, parts == parts[start])
    np.testing.assert_array_equal(scene.walls, np.any([away(box).max(axis=0) <= 0.125 + 1e-9 for box in walls], axis=0))
    assert not (scene.reach & scene.walls).any()
    # Sight does not slip diagonally between wall cells, and passes an open door.
    kitchen = scene.rooms[0].cells & ~scene.walls
    seen = parts_of(~scene.walls, EIGHT if house.shut else FOUR).labels
    assert (seen[kitchen] == seen[start]).all() != house.shut
