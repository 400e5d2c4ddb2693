"""Habitat ObjectNav episodes, with and without maps, to scenes."""

from pathlib import Path

import numpy as np
import pytest
from support.importer_inputs.habitat import EPISODES, STARTS, episode, goal, write_json
from support.importer_inputs.semantic_maps import bedroom, l_shaped_floor, write_maps
from support.scene_records import scenes_and_errors

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    return write_maps(tmp_path / "val_info.pbz2", {"Home": {0: l_shaped_floor(), 1: bedroom()}})


def test_floors_of_a_mapped_house(tmp_path, maps):
    write_json(tmp_path / "val" / "content" / "Home_episodes.json.gz", {"episodes": STARTS})
    scenes, errors = scenes_and_errors(read_habitat(tmp_path / "val", "val", maps))
    assert not errors
    assert [(scene.name, scene.world, scene.split, scene.types) for scene in scenes] == [
        ("Home_floor0", "gibson", "val", ("Chair",)),
        ("Home_floor1", "gibson", "val", ("Bed",)),
    ]
    # The bed: pixels 38-51 and 2-15, x 3.90 to 4.60 m, Habitat's z -0.90 to -0.20 m; typical height 0.91, centre 0.46.
    np.testing.assert_allclose(scenes[1].boxes, [[4.25, 0.46, 0.55, 0.7, 0.91, 0.7]], atol=1e-12)
    write_scenes(tmp_path / "scenes.jsonl.gz", scenes)
    for scene, again in zip(scenes, read_scenes(tmp_path / "scenes.jsonl.gz"), strict=True):
        np.testing.assert_array_equal(again.reach, scene.reach)
        np.testing.assert_array_equal(again.walls, scene.walls)
        np.testing.assert_array_equal(again.boxes, scene.boxes)
        assert (again.origin, again.types) == (scene.origin, scene.types)


def test_every_way_to_name_a_split(tmp_path, maps):
    folder = tmp_path / "val"
    file = write_json(folder / "content" / "Home_episodes.json.gz", {"episodes": STARTS})
    for dummy in ("Home.json.gz", "Home.glb.json.gz"):  # Habitat's, not SemExp's
        write_json(folder / "content" / dummy, {"episodes": [episode(99.0, 0.0, 99.0)]})
    whole = write_json(folder / "val.json.gz", {"episodes": []})
    for path in (folder, folder / "content", whole, file):
        assert [scene.name for scene in scenes_and_errors(read_habitat(path, "val", maps))[0]] == [
            "Home_floor0",
            "Home_floor1",
        ]
    alone = write_json(tmp_path / "train" / "train.json.gz", {"episodes": []})
    for path in (alone, alone.parent):  # no episode: all that the map has
        assert len(scenes_and_errors(read_habitat(path, "train", maps))[0]) == 2
        with pytest.raises(InputError, match="holds no episode; give the folder of a split, or a semantic floor map"):
            list(read_habitat(path, "train"))


def shifted(dx: float, count: int) -> list[dict]:
    """Return STARTS with `count` of those upstairs moved along x."""
    return [episode(x + dx * (72 <= i < 72 + count), y, z) for i, (x, y, z) in enumerate(positions())]


def positions() -> list[list[float]]:
    return [start["start_position"] for start in STARTS]


@pytest.mark.parametrize(
    ("dx", "count", "fits"),
    [
        (-0.3, 72, True),  # beside the map
        (-3.0, 14, True),  # 58 of 72 are 80.6 %
        (-3.0, 15, False),
    ],
)
def test_a_map_must_fit_the_starts(tmp_path, maps, dx, count, fits):
    path = write_json(tmp_path / "e.json.gz", {"episodes": shifted(dx, count)})
    scenes, errors = scenes_and_errors(read_habitat(path, "val", maps))
    assert len(scenes) == 1 + fits
    assert fits or "val_info.pbz2, scene 'Home': floor 1: sem_map has 57 of 72 starts" in errors[0]


def test_floor_id_tells_the_floor_of_a_start(tmp_path, maps):
    episodes = [start | {"floor_id": 0} for start in shifted(-3.0, 72)[72:]]  # by height they are upstairs
    scenes, errors = scenes_and_errors(
        read_habitat(write_json(tmp_path / "e.json.gz", {"episodes": episodes}), "val", maps)
    )
    assert [scene.name for scene in scenes] == ["Home_floor1"]
    assert "floor 0: sem_map has 0 of 72 starts" in errors[0]


def test_floors_from_episodes_alone(tmp_path):
    (ground, upstairs), errors = scenes_and_errors(
        read_habitat(write_json(tmp_path / "Home.json.gz", EPISODES), "train")
    )
    assert not errors
    assert (ground.name, ground.world, ground.room_type) == ("Home_floor0", "habitat", "house")
    # z is negated. Starts at x = 0.03 .. 2.03 m go to 0 .. 2 m; the view points add (2, 1.25) and (2, 1.5).
    cells = {(0.25 * i, 1.0) for i in range(9)} | {(2.0, 1.25), (2.0, 1.5)}
    x, z = ground.origin
    assert {(x + 0.25 * ix, z + 0.25 * iz) for iz, ix in np.argwhere(ground.reach).tolist()} == cells
    # The chair's centre is at 0.6 - 0.1 m above the floor; a typical chair is 0.56 x 0.95 x 0.56 m.
    np.testing.assert_allclose(ground.boxes, [[2.5, 0.5, 1.5, 0.56, 0.95, 0.56]], atol=1e-12)
    # The bed is in the file twice under one id, centre 3.5 - 3.1 m high and at z = -1.
    assert (ground.types, upstairs.types) == (("chair",), ("bed",))
    np.testing.assert_allclose(upstairs.boxes, [[1.0, 0.4, -1.0, 1.84, 0.91, 1.84]], atol=1e-12)
    assert len(standable_cells(upstairs.reach)) == upstairs.reach.sum() == 9


def test_goals_of_episodes_and_shortest_paths(tmp_path):
    chair = goal("chair", 7, [0.5, 0.4, 1.0], [[0.5, 0.0, 0.5]])
    walk = [{"position": [0.25, 0.0, 0.25], "action": 1}, {"position": None, "action": 0}, 1, None]
    episodes = [episode(0, 0, 0, goals=[chair], shortest_paths=[walk]), episode(0, 0, 0, goals=[chair])]
    (scene,) = read_habitat(write_json(tmp_path / "e.json.gz", {"episodes": episodes}), "val")
    assert isinstance(scene, Scene)
    assert scene.types == ("chair",)
    assert len(standable_cells(scene.reach)) == 3  # (0, 0), (0.25, 0.25), (0.5, 0.5): a diagonal
