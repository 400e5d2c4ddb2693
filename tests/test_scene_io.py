"""Scene files: round trip, derived walls by hand, every refusal with its place, and mutated files."""

import collections
import copy
import dataclasses
import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.errors import InputError
from jaxnav.scenes.io import derive_walls, read_scenes, write_scenes
from jaxnav.scenes.scene import Scene

REAL_FILE = Path(__file__).parents[2] / "shared" / "scenes" / "ithor_train_val.jsonl.gz"

RECORD = {
    "name": "den",
    "world": "test",
    "room_type": "bedroom",
    "split": "val",
    "cell": 0.25,
    "origin": [-1.0, 0.5],
    "shape": [2, 3],
    "reach": ["..#", "#.#"],
    "columns": ["type", "x", "y", "z", "sx", "sy", "sz", "yaw", "parent", "id"],
    "objects": [["Bed", 0.1, 0.3, 0.2, 1.5, 0.6, 2, 90, -1, "a"], ["Book", 0.1, 0.65, 0.2, 0.2, 0, 0.3, 0, 0, "b"]],
}


@pytest.fixture
def read(tmp_path):
    def read_records(*records: dict) -> list[Scene]:
        return read_scenes(write_records(tmp_path / "scenes.jsonl.gz", *records))

    return read_records


def write_records(path: Path, *records: object) -> Path:
    path.write_bytes(gzip.compress("".join(json.dumps(r) + "\n" for r in records).encode()))
    return path


def assert_equal(a: Scene, b: Scene) -> None:
    for field in dataclasses.fields(Scene):
        left, right = getattr(a, field.name), getattr(b, field.name)
        assert type(left) is type(right), field.name
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype, field.name
            np.testing.assert_array_equal(left, right, field.name)
        else:
            assert left == right, field.name


def test_fields_are_read_as_documented(read):
    (scene,) = read(RECORD)
    assert (scene.name, scene.world, scene.room_type, scene.split) == ("den", "test", "bedroom", "val")
    assert scene.origin == (-1.0, 0.5)
    np.testing.assert_array_equal(scene.reach, [[True, True, False], [False, True, False]])
    assert scene.types == ("Bed", "Book")
    np.testing.assert_array_equal(scene.boxes, [[0.1, 0.3, 0.2, 1.5, 0.6, 2.0], [0.1, 0.65, 0.2, 0.2, 0.0, 0.3]])
    np.testing.assert_array_equal(scene.yaws, [90.0, 0.0])
    np.testing.assert_array_equal(scene.parents, [-1, 0])
    assert not scene.walls.any()  # no cell is three away from a standable one


def test_optional_columns_and_masks(read):
    bare = RECORD | {
        "columns": ["sz", "sy", "sx", "z", "y", "x", "type"],  # the order is that of the file
        "objects": [[6, 5, 4, 3, 2, 1, "Desk"]],
        "walls": ["..#", "..."],
        "episode_starts": ["#..", "###"],
        "unknown": {"kept": False},
    }
    (scene,) = read(bare)
    np.testing.assert_array_equal(scene.boxes, [[1, 2, 3, 4, 5, 6]])
    assert (scene.yaws.tolist(), scene.parents.tolist()) == ([0.0], [-1])
    np.testing.assert_array_equal(scene.walls, [[False, False, True], [False, False, False]])
    np.testing.assert_array_equal(scene.reach, [[True, True, True], [False, True, False]])


def test_an_origin_slightly_off_the_lattice_is_snapped(read):
    (scene,) = read(RECORD | {"origin": [-1.018, 0.517]})
    assert scene.origin == (-1.0, 0.5)


def test_objects_without_a_position_are_left_out(read):
    ghost = ["Ghost", None, None, None, None, None, None, None, None, "g"]
    on_ghost = ["Cup", 1, 1, 1, 0, 0, 0, 0, 0, "c"]
    on_bed = ["Book", 1, 1, 1, 0, 0, 0, 0, 2, "d"]
    (scene,) = read(RECORD | {"objects": [ghost, on_ghost, RECORD["objects"][0], on_bed]})
    assert scene.types == ("Cup", "Bed", "Book")
    assert scene.parents.tolist() == [-1, -1, 1]  # the cup's parent is gone; the bed moved from 2 to 1


def test_a_scene_without_objects(read):
    (scene,) = read(RECORD | {"objects": []})
    assert (scene.boxes.shape, scene.yaws.shape, scene.parents.shape) == ((0, 6), (0,), (0,))


def test_walls_are_three_cells_from_the_floor_in_either_axis():
    # One standable cell in the corner of 5 x 5: the square of cells less than three away in both axes is no wall.
    reach = np.zeros((5, 5), bool)
    reach[0, 0] = True
    expected = np.ones((5, 5), bool)
    expected[:3, :3] = False
    np.testing.assert_array_equal(derive_walls(reach, (0.0, 0.0), np.zeros((0, 6))), expected)


def test_walls_keep_a_quarter_metre_from_boxes():
    # A row of cells at z = 0 and x = 0, 0.25, ..., 2.25; the first is standable, so without objects 3..9 are walls.
    reach = np.arange(10)[None] == 0
    # A box 0.5 wide at x = 1.75 covers 1.5..2.0 = cells 6..8; cells 5 and 9 are exactly 0.25 away: near as well.
    wide = [1.75, 9.0, 0.0, 0.5, 0.1, 0.1]  # its height does not matter
    walls = derive_walls(reach, (0.0, 0.0), np.array([wide]))
    assert np.flatnonzero(walls[0]).tolist() == [3, 4]
    # The point (1.4, 0.2) is hypot(0.1, 0.2) = 0.224 from cell 6 and hypot(0.15, 0.2) = 0.25 from cell 5 at x = 1.25.
    walls = derive_walls(reach, (0.0, 0.0), np.array([[1.4, 0.0, 0.2, 0.0, 0.0, 0.0]]))
    assert np.flatnonzero(walls[0]).tolist() == [3, 4, 7, 8, 9]
    # At z = 0.21 cell 5 is hypot(0.15, 0.21) = 0.258 away, a wall again; cell 6 at hypot(0.1, 0.21) = 0.233 is not.
    walls = derive_walls(reach, (0.0, 0.0), np.array([[1.4, 0.0, 0.21, 0.0, 0.0, 0.0]]))
    assert np.flatnonzero(walls[0]).tolist() == [3, 4, 5, 7, 8, 9]


@given(st.integers(0, 2**32 - 1))
def test_walls_equal_the_rule_cell_by_cell(seed):
    rng = np.random.default_rng(seed)
    reach = rng.random((9, 8)) < 0.04
    reach[rng.integers(9), rng.integers(8)] = True
    boxes = np.concatenate([rng.uniform(-1, 3, (4, 3)), rng.uniform(0, 1, (4, 3))], axis=1)
    walls = derive_walls(reach, (0.5, -0.25), boxes)
    floor = np.argwhere(reach)
    for iz, ix in np.ndindex(reach.shape):
        far = all(max(abs(iz - fz), abs(ix - fx)) >= 3 for fz, fx in floor)
        x, z = 0.5 + 0.25 * ix, -0.25 + 0.25 * iz
        gaps = [
            math.dist(
                (x, z), (np.clip(x, b[0] - b[3] / 2, b[0] + b[3] / 2), np.clip(z, b[2] - b[5] / 2, b[2] + b[5] / 2))
            )
            for b in boxes
        ]
        assert walls[iz, ix] == (far and min(gaps) > 0.25)


@given(st.integers(0, 2**32 - 1))
def test_written_scenes_read_back_equal(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    scenes = []
    for i in range(3):
        reach = rng.random((4, 6)) < 0.5
        reach[0, 0] = True
        scenes.append(
            Scene(
                name=f"küche {i}\n",
                world="wörld",
                room_type="kitchen",
                split="test",
                origin=(0.25 * int(rng.integers(-99, 99)), 0.25 * int(rng.integers(-99, 99))),
                reach=reach,
                walls=rng.random((4, 6)) < 0.5,
                types=("Bed", "Cup", "Cup")[:i],
                boxes=rng.uniform(0, 10, (i, 6)),
                yaws=rng.uniform(-180, 180, i),
                parents=np.arange(i) - 1,
            )
        )
    path = tmp_path_factory.getbasetemp() / "new folder" / "scenes.jsonl.gz"
    write_scenes(path, scenes)
    first = path.read_bytes()
    for written, back in zip(scenes, read_scenes(path), strict=True):
        assert_equal(written, back)
    write_scenes(path, scenes)
    assert path.read_bytes() == first  # no time stamp inside
    assert [p.name for p in path.parent.iterdir()] == ["scenes.jsonl.gz"]  # no temporary file left


def test_a_failed_write_leaves_the_old_file(read, tmp_path):
    (scene,) = read(RECORD)
    path = tmp_path / "scenes.jsonl.gz"
    before = path.read_bytes()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_scenes(path, [dataclasses.replace(scene, yaws=np.array([np.nan, 0.0]))])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def changed(*keys_and_value: object) -> dict:
    """RECORD with the value at a path of keys replaced."""
    record = copy.deepcopy(RECORD)
    *keys, last, value = keys_and_value
    node = record
    for key in keys:
        node = node[key]
    node[last] = value
    return record


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        *[({k: v for k, v in RECORD.items() if k != field}, f"{field} is missing") for field in RECORD],
        (changed("name", ""), "name is ''"),
        (changed("room_type", 3), "room_type is 3"),
        (changed("split", "training"), "split is 'training'; give one of train, val, test"),
        (changed("cell", 0.5), "cell is 0.5; only 0.25"),
        (changed("origin", [0.1, 0]), "origin is [0.1, 0.0]; both must be multiples of 0.25"),
        (changed("origin", [0.0, 0.271]), "origin is [0.0, 0.271]; both"),
        (changed("origin", [0.0]), "origin is [0.0]; give a list of 2"),
        (changed("origin", [None, 0]), "origin is null"),
        (changed("shape", [0, 3]), "shape is [0, 3]; give two positive"),
        (changed("shape", [2.0, 3]), "shape is [2.0, 3]; give two positive"),
        (changed("reach", ["..#"]), "reach is ['..#']; give a list of 2"),
        (changed("reach", 1, "#.##"), "reach[1] is '#.##'; give 3 characters"),
        (changed("reach", 0, "..x"), "reach[0] is '..x'; give 3 characters '.' or '#'"),
        (changed("reach", ["###", "###"]), "reach has no standable cell"),
        (changed("walls", ["...", "??."]), "walls[1] is '??.'"),
        (changed("walls", None), "walls is None"),
        (changed("episode_starts", [".."] * 2), "episode_starts[0] is '..'"),
        (changed("columns", ["type", "x"]), "columns lacks y, z, sx, sy, sz"),
        (changed("columns", ["type"] * 10), "columns is ['type',"),
        (changed("columns", [["type"]]), "columns is [['type']]"),
        (changed("objects", 1, ["Cup"]), "objects[1] is ['Cup']; give a list of 10"),
        (changed("objects", 1, 0, None), "objects[1].type is None"),
        (changed("objects", 1, 1, float("nan")), "objects[1].x is nan; give a finite number"),
        (changed("objects", 1, 2, float("-inf")), "objects[1].y is -inf; give a finite number"),
        (changed("objects", 1, 3, 10**400), "objects[1].z is 1"),
        (changed("objects", 1, 1, True), "objects[1].x is True"),
        (changed("objects", 0, 5, None), "objects[0].sy is null; give the number"),
        (changed("objects", 0, 2, None), "objects[0].y is null"),  # x and z are there, so the object is not left out
        (changed("objects", 0, 4, -0.1), "objects[0].sx is -0.1; a size is at least 0"),
        (changed("objects", 0, 7, "north"), "objects[0].yaw is 'north'"),
        (changed("objects", 1, 8, 2), "objects[1].parent is 2; give the index of another object or -1"),
        (changed("objects", 1, 8, 1), "objects[1].parent is 1"),
        (changed("objects", 1, 8, 0.0), "objects[1].parent is 0.0"),
        (changed("objects", 1, 8, None), "objects[1].parent is None"),
    ],
)
def test_bad_fields_are_refused_with_their_place(read, record, problem):
    with pytest.raises(InputError) as error:
        read(RECORD | {"name": "first"}, record)
    scene = "'den'" if record.get("name") == "den" else ""
    assert f"scenes.jsonl.gz, line 2, scene {scene}" in str(error.value)
    assert problem in str(error.value)


def test_a_name_used_twice_is_refused(read):
    with pytest.raises(InputError, match="line 3, scene 'den': name is that of line 1 too"):
        read(RECORD, RECORD | {"name": "other"}, RECORD)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "holds no scene"),
        (gzip.compress(b""), "holds no scene"),
        (b"{}\n", "is not gzip-compressed"),
        (gzip.compress(json.dumps(RECORD).encode())[:-12], "is cut short or damaged"),
        (gzip.compress(json.dumps(RECORD).encode() + b"\n{"), "line 2: not JSON"),
        (gzip.compress(b"\xff\xfe"), "line 1: not JSON"),
        (gzip.compress(b"[" * 100_000), "line 1: not JSON"),
        (gzip.compress(b"[1]"), "line 1: [1] is no scene"),
    ],
)
def test_broken_files_are_refused(tmp_path, data, problem):
    path = tmp_path / "broken.jsonl.gz"
    path.write_bytes(data)
    with pytest.raises(InputError) as error:
        read_scenes(path)
    assert str(error.value).startswith(str(path))
    assert problem in str(error.value)


def test_missing_file_and_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.jsonl.gz", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_scenes(path)


def assert_read_or_refused(path: Path) -> None:
    try:
        assert all(isinstance(scene, Scene) for scene in read_scenes(path))
    except InputError as error:
        assert str(error).startswith(str(path))  # noqa: PT017  (reading may also succeed)


COMPRESSED = gzip.compress(json.dumps(RECORD).encode(), mtime=0)


@given(st.integers(0, len(COMPRESSED) - 1), st.integers(0, 255), st.integers(0, len(COMPRESSED)), st.binary(max_size=4))
def test_mutated_bytes_never_raise_another_error(tmp_path_factory, at, byte, end, tail):
    path = tmp_path_factory.getbasetemp() / "bytes.jsonl.gz"
    path.write_bytes(COMPRESSED[:at] + bytes([byte]) + COMPRESSED[at + 1 : end] + tail)
    assert_read_or_refused(path)


@given(st.data())
def test_mutated_text_never_raises_another_error(tmp_path_factory, data):
    text = json.dumps(RECORD)
    at = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(at, min(at + 20, len(text))))
    inserted = data.draw(st.text('[]{}",.:-#0123456789eNn\\u\n ', max_size=6))
    path = tmp_path_factory.getbasetemp() / "text.jsonl.gz"
    path.write_bytes(gzip.compress((text[:at] + inserted + text[end:]).encode()))
    assert_read_or_refused(path)


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.sampled_from([1e308, 10**400]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=2), inner, max_size=2),
    max_leaves=6,
)


@given(st.data(), JSON_VALUES)
def test_mutated_fields_never_raise_another_error(tmp_path_factory, data, value):
    record = copy.deepcopy(RECORD | {"walls": ["...", "#.#"], "episode_starts": ["#..", "###"]})
    node: dict | list = record
    while True:
        key = data.draw(st.sampled_from(sorted(node) if isinstance(node, dict) else range(len(node))))
        if not isinstance(node[key], list) or not node[key] or data.draw(st.booleans()):
            break
        node = node[key]
    node[key] = value
    path = tmp_path_factory.getbasetemp() / "fields.jsonl.gz"
    write_records(path, record)
    assert_read_or_refused(path)


@pytest.mark.skipif(not REAL_FILE.exists(), reason="the file with real scenes is not there")
def test_the_real_rooms(tmp_path):
    scenes = read_scenes(REAL_FILE)
    assert collections.Counter(s.split for s in scenes) == {"train": 80, "val": 20}
    assert collections.Counter(s.room_type for s in scenes) == dict.fromkeys(
        ("kitchen", "living_room", "bedroom", "bathroom"), 25
    )
    assert sum(len(s.types) for s in scenes) == 4586
    assert all(not (s.walls & s.reach).any() for s in scenes)
    with gzip.open(REAL_FILE) as file:
        raw = [json.loads(line) for line in file]
    for scene, record in zip(scenes, raw, strict=True):
        standable = {
            (iz, ix)
            for field in ("reach", "episode_starts")
            for iz, row in enumerate(record.get(field, []))
            for ix, character in enumerate(row)
            if character == "."
        }
        assert set(zip(*map(np.ndarray.tolist, np.nonzero(scene.reach)), strict=True)) == standable
    write_scenes(tmp_path / "copy.jsonl.gz", scenes)
    for scene, back in zip(scenes, read_scenes(tmp_path / "copy.jsonl.gz"), strict=True):
        assert_equal(scene, back)
