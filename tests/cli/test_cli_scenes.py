"""The import command: every format to a scene file that trains, splits by pattern, and what it refuses."""

import gzip
import json

import pytest
from support.commands import refusal
from support.fuzz_importers import CRASHED, FORMATS, fuzz
from support.importer_inputs.ai2thor import METADATA
from support.importer_inputs.procthor import ASSETS, HOUSE, build, door, item

from jaxnav.__main__ import main
from jaxnav.env.make import make
from jaxnav.env.testing import check_environment
from jaxnav.scenes.files.scene_file import read_scenes


def run(*arguments):
    return main(["scenes", "import", *map(str, arguments)])


@pytest.mark.parametrize(("form", "world"), [(form, "rooms" if "a" in form.name[:2] else "houses") for form in FORMATS])
def test_import_makes_an_environment_of_every_format(tmp_path, capsys, form, world):
    source, target = form.write(tmp_path, form.content), tmp_path / "new" / "scenes.jsonl.gz"
    options = [tmp_path / option if option.endswith(".pbz2") else option for option in form.options]
    code = run(form.name, source, target, "--split", "val", "--categories", "Chair", "Bed", "Fridge", "Sink",
               "DiningTable", *options)  # fmt: skip
    output = capsys.readouterr().err
    assert code == 0, output
    assert "scenes imported, 0 refused" in output
    scenes = read_scenes(target)
    assert {scene.split for scene in scenes} == {"val"}
    if form.name == "procthor":  # its table is no goal of the houses, but can be looked for
        from jaxnav.scenes.task import Task
        from jaxnav.scenes.worlds import WORLDS

        rules = WORLDS["houses"].task.rules
        check_environment(*make("houses", "val", target, Task(("DiningTable", "Bowl"), rules=rules)), num_steps=8)


def test_import_divides_a_file_into_splits_by_pattern(tmp_path, capsys):
    rooms = [METADATA | {"sceneName": f"FloorPlan{number}"} for number in (1, 21, 22, 23)]
    source = tmp_path / "rooms.jsonl"
    source.write_text("\n".join(map(json.dumps, rooms)))
    first, second = tmp_path / "a.jsonl.gz", tmp_path / "b.jsonl.gz"
    assert run("ai2thor", source, first, "--val", "*21", "*23", "--test", "FloorPlan2?") == 0
    assert [scene.split for scene in read_scenes(first)] == ["train", "val", "test", "val"]
    assert run("scenes", first, second, "--test", "FloorPlan1") == 0  # a scene file can be divided anew
    assert [scene.split for scene in read_scenes(second)] == ["test", "train", "train", "train"]
    assert "4 scenes imported, 0 refused" in capsys.readouterr().err


def test_import_counts_refused_scenes_and_keeps_the_rest(tmp_path, capsys):
    nowhere = HOUSE | {"doors": [door("wall|9|0.00|0.00|1.00|0.00", 1.0, 2.0)]}
    source, target = tmp_path / "houses.jsonl.gz", tmp_path / "scenes.jsonl.gz"
    source.write_bytes(gzip.compress("\n".join(json.dumps(house) for house in (HOUSE, nowhere)).encode()))
    assert run("procthor", source, target) == 0
    output = capsys.readouterr().err
    assert f"refused: {source}" in output
    assert "doors[0]: wall0" in output
    assert "objects of unknown types, which only block the sight: 1, of them Bowl x 1\n" in output
    # Without the database, types and sizes of table and bowl come from their names.
    assert "2 types of objects are guessed from the names of their assets; --assets tells them, procthor/data" in output
    assert "2 sizes of objects are the typical ones of their types; --assets" in output
    assert "1 scenes imported, 1 refused" in output
    assert len(read_scenes(target)) == 1


def test_import_counts_unconnected_cells(tmp_path, capsys):
    shut = HOUSE | {"doors": []}
    source, target = tmp_path / "houses.jsonl", tmp_path / "scenes.jsonl.gz"
    source.write_text("\n".join(json.dumps(house) for house in (HOUSE, shut)))
    (tmp_path / "assets.json").write_text(json.dumps(ASSETS))
    assert run("procthor", source, target, "--assets", tmp_path / "assets.json") == 0
    output = capsys.readouterr().err
    # 230 cells with the door, 227 without it: 121 in the larger room and 106 in the other.
    assert (
        "106 of 457 cells in 1 scenes are not connected with the largest part and not used; most in houses-1" in output
    )
    assert "houses-1, 106 of 227" in output
    assert "guessed" not in output
    assert run("procthor", source, target, "--assets", tmp_path / "assets.json", "--agent-part") == 0
    output = capsys.readouterr().err
    assert "121 cells are not connected with the agent and left out" in output  # it stands in the smaller room
    assert "largest" not in output


def test_import_selects_homes_by_room_type_and_size(tmp_path, capsys):
    room = build(
        ("Kitchen", [(0, 0), (0, 3), (3, 3), (3, 0)]), objects=(item("2|0", "Dining_Table_27_1", 1.5, 0.4, 1),)
    )
    source, target = tmp_path / "houses.jsonl", tmp_path / "scenes.jsonl.gz"
    source.write_text("\n".join(json.dumps(house) for house in (HOUSE, HOUSE, room)))
    # A house is 6 m by 3 m: 25 lattice points from wall to wall, and a cell beyond at either end.
    assert run("procthor", source, target, "--room-types", "house", "--largest", "27") == 0
    output = capsys.readouterr().err
    assert [scene.name for scene in read_scenes(target)] == ["houses-0", "houses-1"]
    assert "1 scenes are left out, for their room type is not house\n" in output
    assert "2 scenes imported, 0 refused" in output
    assert run("procthor", source, target, "--room-types", "kitchen") == 0
    assert [scene.name for scene in read_scenes(target)] == ["houses-2"]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--room-types", "house", "--largest", "26"], "--largest 26: leaves no scene; the smallest is 27 cells long"),
        (["--room-types", "bedroom"], "--room-types bedroom: leaves no scene; there are house\n"),
    ],
)
def test_import_refuses_a_selection_without_scenes(tmp_path, capsys, options, problem):
    source, target = tmp_path / "houses.jsonl", tmp_path / "scenes.jsonl.gz"
    source.write_text(json.dumps(HOUSE))
    assert run("procthor", source, target, *options) == 2
    assert problem in capsys.readouterr().err
    assert not target.exists()


def test_import_summarises_unknown_types_in_one_line(tmp_path, capsys):
    things = [METADATA["objects"][1] | {"objectId": f"T{i}", "objectType": f"T{i}"} for i in range(9)]
    source = tmp_path / "room.json"
    source.write_text(json.dumps(METADATA | {"objects": METADATA["objects"] + things + things[:2]}))
    assert run("ai2thor", source, tmp_path / "scenes.jsonl.gz") == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "unknown types" in line]
    # Nine types, two of them twice, and of the room's objects table and drawer.
    assert line.endswith(": 13, of them T0 x 2, T1 x 2, DiningTable x 1, Drawer x 1, T2 x 1 and 6 more")


def test_import_refuses_a_repeated_scene_name(tmp_path, capsys):
    source, target = tmp_path / "rooms.jsonl", tmp_path / "scenes.jsonl.gz"
    source.write_text(f"{json.dumps(METADATA)}\n{json.dumps(METADATA)}")
    assert run("ai2thor", source, target) == 0
    assert "name is that of an earlier scene" in capsys.readouterr().err
    assert len(read_scenes(target)) == 1


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["room.json", "out.jsonl.gz", "--categories", "Unicorn", "Dragon"], "objects are of no known type"),
        (["room.json", "out.json"], "out.json: give a name that ends in .jsonl.gz"),
        (["gone.json", "out.jsonl.gz"], "gone.json"),
        (["cut.json.gz", "out.jsonl.gz"], "is cut short or damaged"),
        (["room.json", "room.json/out.jsonl.gz"], "cannot be written"),
    ],
)
def test_failed_import_writes_nothing(tmp_path, monkeypatch, capsys, arguments, problem):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.json").write_text(json.dumps(METADATA))
    (tmp_path / "cut.json.gz").write_bytes(gzip.compress(json.dumps(METADATA).encode())[:-9])
    before = sorted(path.name for path in tmp_path.iterdir())
    assert run("ai2thor", *arguments) == 2
    output = capsys.readouterr().err
    assert problem in output
    assert output.splitlines()[-1].startswith("error: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_import_names_the_missing_simulator(tmp_path, capsys):
    assert run("ai2thor", "FloorPlan1", tmp_path / "o.jsonl.gz", "--from-controller") == 2
    assert "pip install ai2thor" in refusal(capsys)


@pytest.mark.parametrize(
    ("form", "option", "problem"),
    [
        ("procthor", ["--from-controller"], "--from-controller: is for the format ai2thor, not for procthor"),
        ("ai2thor", ["--maps", "a.pbz2"], "--maps: is for the format habitat, not for ai2thor"),
        ("ai2thor", ["--agent-part"], "--agent-part: is for the format procthor, not for ai2thor"),
        ("habitat", ["--assets", "a.json"], "--assets: is for the format procthor, not for habitat"),
        ("ai2thor", ["--base", "a.jsonl.gz"], "--base: is for the format replacements, not for ai2thor"),
        ("replacements", [], "--base: is missing; replacements need the scene file"),
        ("ai2thor", ["--val", "FloorPlan9?"], "pattern 'FloorPlan9?': fits no scene"),
    ],
)
def test_import_refuses_options_of_other_formats(tmp_path, capsys, form, option, problem):
    (tmp_path / "room.json").write_text(json.dumps(METADATA))
    assert run(form, tmp_path / "room.json", tmp_path / "o.jsonl.gz", *option) == 2
    assert problem in refusal(capsys)


def test_import_skips_bad_lines_of_a_scene_file(tmp_path, capsys):
    (tmp_path / "room.json").write_text(json.dumps(METADATA))
    good, mixed = tmp_path / "good.jsonl.gz", tmp_path / "mixed.jsonl.gz"
    assert run("ai2thor", tmp_path / "room.json", good) == 0
    line = gzip.decompress(good.read_bytes())
    mixed.write_bytes(line + line.replace(b'"train"', b'"trial"') + b"{]\n" + line)
    assert run("scenes", mixed, tmp_path / "o.jsonl.gz") == 0
    output = capsys.readouterr().err
    assert "1 scenes imported, 3 refused" in output
    assert "line 2" in output
    assert "line 3: not JSON" in output
    assert "name is that of line 1 too" in output


@pytest.mark.parametrize("form", FORMATS)
def test_import_of_mutated_files_neither_crashes_nor_leaves_partial_files(form, capsys):
    codes, _ = fuzz(form, 40)
    assert codes[CRASHED] == 0
    assert min(codes[0], codes[2]) >= 2
    capsys.readouterr()
