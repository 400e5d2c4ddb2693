"""The import command: scene files from every format, splits and selections, reports and refusals."""

import gzip
import json

import pytest
from support.commands import refusal
from support.fuzz_importers import CRASHED, FORMATS, fuzz
from support.importer_inputs.ai2thor import METADATA
from support.importer_inputs.procthor import ASSETS, HOUSE, build, door, item
from support.refusals import assert_message_names

from jaxnav.__main__ import main
from jaxnav.env.make import make
from jaxnav.env.testing import check_environment
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS


def import_scenes(*arguments):
    """Run the import command, and return its exit code."""
    return main(["scenes", "import", *map(str, arguments)])


def write_lines(path, *documents):
    """Write JSON documents to a file, one a line, and return its path."""
    path.write_text("\n".join(map(json.dumps, documents)))
    return path


# Formats, splits and selections


@pytest.mark.slow
@pytest.mark.parametrize("scene_format", FORMATS)
def test_import_makes_an_environment_of_every_format(tmp_path, capsys, scene_format):
    source = scene_format.write(tmp_path, scene_format.content)
    target = tmp_path / "new" / "scenes.jsonl.gz"
    options = []
    for option in scene_format.options:
        is_map_file = option.endswith(".pbz2")
        options.append(tmp_path / option if is_map_file else option)
    categories = ("Chair", "Bed", "Fridge", "Sink", "DiningTable")
    exit_code = import_scenes(
        scene_format.name, source, target, "--split", "val", "--categories", *categories, *options
    )
    output = capsys.readouterr().err
    assert exit_code == 0, output
    assert "scenes imported, 0 refused" in output
    assert {scene.split for scene in read_scenes(target)} == {"val"}

    # The dining table of ProcTHOR's house is no goal in the world `houses`; another task makes it one.
    if scene_format.name == "procthor":
        task = Task(("DiningTable", "Bowl"), rules=WORLDS["houses"].task.rules)
        check_environment(*make("houses", "val", target, task), num_steps=8)


def test_import_divides_a_file_into_splits_by_pattern(tmp_path, capsys):
    rooms = [METADATA | {"sceneName": f"FloorPlan{number}"} for number in (1, 21, 22, 23)]
    source = write_lines(tmp_path / "rooms.jsonl", *rooms)
    first_target = tmp_path / "a.jsonl.gz"
    second_target = tmp_path / "b.jsonl.gz"
    assert import_scenes("ai2thor", source, first_target, "--val", "*21", "*23", "--test", "FloorPlan2?") == 0
    assert [scene.split for scene in read_scenes(first_target)] == ["train", "val", "test", "val"]

    # A scene file can be divided anew.
    assert import_scenes("scenes", first_target, second_target, "--test", "FloorPlan1", "--split", "train") == 0
    assert [scene.split for scene in read_scenes(second_target)] == ["test", "train", "train", "train"]

    # Without an option for splits, every scene of a scene file keeps its split, so no test scene is trained on.
    kept_target = tmp_path / "c.jsonl.gz"
    assert import_scenes("scenes", first_target, kept_target, "--largest", "99") == 0
    assert [scene.split for scene in read_scenes(kept_target)] == ["train", "val", "test", "val"]
    assert "4 scenes imported, 0 refused" in capsys.readouterr().err


def test_import_selects_homes_by_room_type_and_size(tmp_path, capsys):
    table = item("2|0", "Dining_Table_27_1", 1.5, 0.4, 1)
    kitchen = build(("Kitchen", [(0, 0), (0, 3), (3, 3), (3, 0)]), objects=(table,))
    source = write_lines(tmp_path / "houses.jsonl", HOUSE, HOUSE, kitchen)
    target = tmp_path / "scenes.jsonl.gz"
    kitchen_target = tmp_path / "kitchens.jsonl.gz"

    # A house is 6 m by 3 m: 25 lattice points from wall to wall, and a cell beyond at either end.
    assert import_scenes("procthor", source, target, "--room-types", "house", "--largest", "27") == 0
    output = capsys.readouterr().err
    assert [scene.name for scene in read_scenes(target)] == ["houses-0", "houses-1"]
    assert_message_names(output, "1 scenes are skipped", "room type", "house\n")
    assert "2 scenes imported, 0 refused" in output

    assert import_scenes("procthor", source, kitchen_target, "--room-types", "kitchen") == 0
    assert [scene.name for scene in read_scenes(kitchen_target)] == ["houses-2"]


# Reports


def test_import_counts_refused_scenes_and_keeps_the_rest(tmp_path, capsys):
    house_without_wall = HOUSE | {"doors": [door("wall|9|0.00|0.00|1.00|0.00", 1.0, 2.0)]}
    house_lines = "\n".join(json.dumps(house) for house in (HOUSE, house_without_wall))
    source = tmp_path / "houses.jsonl.gz"
    source.write_bytes(gzip.compress(house_lines.encode()))
    target = tmp_path / "scenes.jsonl.gz"
    assert import_scenes("procthor", source, target) == 0

    output = capsys.readouterr().err
    assert_message_names(output, f"refused: {source}", "doors[0]: wall0")
    assert_message_names(output, "objects of unknown types", "1, of them Bowl x 1\n")
    # Without the database, types and sizes of table and bowl come from their names.
    assert_message_names(output, "2 types of objects are guessed", "--assets")
    assert_message_names(output, "2 sizes of objects are the typical ones", "--assets")
    assert "1 scenes imported, 1 refused" in output
    assert len(read_scenes(target)) == 1

    # The summary counts two houses of two objects each.
    assert "scenes: 2 read, 1 kept, 1 skipped (1 refused)" in output
    assert "objects: 4 read, 2 kept, 2 skipped (2 in refused scenes)" in output


def test_import_prints_the_first_ten_refusals(tmp_path, capsys):
    house_without_wall = HOUSE | {"doors": [door("wall|9|0.00|0.00|1.00|0.00", 1.0, 2.0)]}
    source = write_lines(tmp_path / "houses.jsonl", HOUSE, *[house_without_wall] * 12)
    assert import_scenes("procthor", source, tmp_path / "scenes.jsonl.gz") == 0

    output = capsys.readouterr().err
    assert output.count(f"refused: {source}") == 10
    assert output.count("refused: further scenes") == 1
    assert "1 scenes imported, 12 refused" in output


def test_import_counts_unconnected_cells(tmp_path, capsys):
    house_without_doors = HOUSE | {"doors": []}
    source = write_lines(tmp_path / "houses.jsonl", HOUSE, house_without_doors)
    assets_file = write_lines(tmp_path / "assets.json", ASSETS)
    target = tmp_path / "scenes.jsonl.gz"
    assert import_scenes("procthor", source, target, "--assets", assets_file) == 0

    # 230 cells with the door, 227 without it: 121 in the larger room and 106 in the other.
    output = capsys.readouterr().err
    assert_message_names(output, "106 of 457 cells in 1 scenes", "not connected", "houses-1, 106 of 227")
    assert "guessed" not in output

    # The agent stands in the smaller room.
    assert import_scenes("procthor", source, tmp_path / "part.jsonl.gz", "--assets", assets_file, "--agent-part") == 0
    output = capsys.readouterr().err
    assert_message_names(output, "121 cells are skipped")
    assert "largest" not in output


def test_import_summarises_unknown_types_in_one_line(tmp_path, capsys):
    # Nine unknown types, two of them twice, in addition to the table and the drawer of the room.
    drawer = METADATA["objects"][1]
    unknown_objects = [drawer | {"objectId": f"T{index}", "objectType": f"T{index}"} for index in range(9)]
    objects = METADATA["objects"] + unknown_objects + unknown_objects[:2]
    source = write_lines(tmp_path / "room.json", METADATA | {"objects": objects})
    assert import_scenes("ai2thor", source, tmp_path / "scenes.jsonl.gz") == 0
    output = capsys.readouterr().err
    (type_line,) = [line for line in output.splitlines() if "unknown types" in line]
    assert type_line.endswith(": 13, of them T0 x 2, T1 x 2, DiningTable x 1, Drawer x 1, T2 x 1 and 6 more")


def test_import_refuses_a_repeated_scene_name(tmp_path, capsys):
    source = write_lines(tmp_path / "rooms.jsonl", METADATA, METADATA)
    target = tmp_path / "scenes.jsonl.gz"
    assert import_scenes("ai2thor", source, target) == 0
    assert "name is that of an earlier scene" in capsys.readouterr().err
    assert len(read_scenes(target)) == 1


def test_import_skips_bad_lines_of_a_scene_file(tmp_path, capsys):
    room_file = write_lines(tmp_path / "room.json", METADATA)
    good_file = tmp_path / "good.jsonl.gz"
    mixed_file = tmp_path / "mixed.jsonl.gz"
    assert import_scenes("ai2thor", room_file, good_file) == 0
    _, good_line = gzip.decompress(good_file.read_bytes()).splitlines(keepends=True)  # after the header

    # An unknown split, a line that is not JSON, and a repeated scene.
    bad_split_line = good_line.replace(b'"train"', b'"trial"')
    mixed_file.write_bytes(good_line + bad_split_line + b"{]\n" + good_line)
    assert import_scenes("scenes", mixed_file, tmp_path / "o.jsonl.gz") == 0
    output = capsys.readouterr().err
    assert "1 scenes imported, 3 refused" in output
    assert_message_names(output, "line 2", "line 3: not JSON", "name is also that of line 1")


# Refusals


def test_import_repeats_itself_and_replaces_no_other_scenes(tmp_path, capsys):
    source = write_lines(tmp_path / "rooms.jsonl", METADATA, METADATA | {"sceneName": "FloorPlan2"})
    target = tmp_path / "scenes.jsonl.gz"
    assert import_scenes("ai2thor", source, target) == 0
    content = target.read_bytes()

    # An import may be repeated, even if another program has compressed its file in the meantime.
    target.write_bytes(gzip.compress(gzip.decompress(content), compresslevel=1))
    assert import_scenes("ai2thor", source, target) == 0
    assert target.read_bytes() == content

    # Other splits, a header with another account, no header, a file of another kind, and a damaged file.
    lines = gzip.decompress(content).splitlines(keepends=True)
    options_and_files = (
        (("--split", "val"), content),
        ((), gzip.compress(b"".join(lines).replace(b"objects", b"goals", 1))),
        ((), gzip.compress(b"".join(lines[1:]))),
        ((), b"a file of my own"),
        ((), content[:-9]),
    )
    capsys.readouterr()
    for options, earlier_content in options_and_files:
        target.write_bytes(earlier_content)
        assert import_scenes("ai2thor", source, target, *options) == 2
        assert str(target) in refusal(capsys)
        assert target.read_bytes() == earlier_content


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--room-types", "house", "--largest", "26"], "--largest 26: no scene is small enough; 27 cells long"),
        (["--room-types", "bedroom"], "--room-types bedroom: no scene has these types; house\n"),
    ],
)
def test_import_refuses_a_selection_without_scenes(tmp_path, capsys, options, problem):
    source = write_lines(tmp_path / "houses.jsonl", HOUSE)
    target = tmp_path / "scenes.jsonl.gz"
    assert import_scenes("procthor", source, target, *options) == 2
    assert_message_names(capsys.readouterr().err, *problem.split("; "))
    assert not target.exists()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["room.json", "out.jsonl.gz", "--categories", "Unicorn", "Dragon"], "no object has a known type"),
        (["room.json", "out.json"], "out.json: give a name that ends in .jsonl.gz"),
        (["gone.json", "out.jsonl.gz"], "gone.json"),
        (["cut.json.gz", "out.jsonl.gz"], "is cut short or damaged"),
        (["room.json", "room.json/out.jsonl.gz"], "cannot be written"),
    ],
)
def test_failed_import_writes_nothing(tmp_path, monkeypatch, capsys, arguments, problem):
    monkeypatch.chdir(tmp_path)
    room_text = json.dumps(METADATA)
    (tmp_path / "room.json").write_text(room_text)
    (tmp_path / "cut.json.gz").write_bytes(gzip.compress(room_text.encode())[:-9])
    paths_before = sorted(tmp_path.rglob("*"))
    assert import_scenes("ai2thor", *arguments) == 2
    output = capsys.readouterr().err
    assert problem in output
    assert output.splitlines()[-1].startswith("error: ")
    assert sorted(tmp_path.rglob("*")) == paths_before


def test_import_names_the_missing_simulator(tmp_path, capsys):
    assert import_scenes("ai2thor", "FloorPlan1", tmp_path / "o.jsonl.gz", "--from-controller") == 2
    assert "pip install ai2thor" in refusal(capsys)


@pytest.mark.parametrize(
    ("format_name", "options", "problem"),
    [
        ("procthor", ["--from-controller"], "--from-controller; ai2thor; procthor"),
        ("ai2thor", ["--maps", "a.pbz2"], "--maps; habitat; ai2thor"),
        ("ai2thor", ["--agent-part"], "--agent-part; procthor; ai2thor"),
        ("habitat", ["--assets", "a.json"], "--assets; procthor; habitat"),
        ("ai2thor", ["--base", "a.jsonl.gz"], "--base; replacements; ai2thor"),
        ("replacements", [], "--base; missing; scene file"),
        ("ai2thor", ["--val", "FloorPlan9?"], "'FloorPlan9?'; no scene"),
    ],
)
def test_import_refuses_options_of_other_formats(tmp_path, capsys, format_name, options, problem):
    source = write_lines(tmp_path / "room.json", METADATA)
    assert import_scenes(format_name, source, tmp_path / "o.jsonl.gz", *options) == 2
    assert_message_names(refusal(capsys), *problem.split("; "))


@pytest.mark.slow
@pytest.mark.parametrize("scene_format", FORMATS)
def test_import_of_mutated_files_neither_crashes_nor_leaves_partial_files(scene_format, capsys):
    exit_codes, _ = fuzz(scene_format, 40)
    assert exit_codes[CRASHED] == 0
    assert min(exit_codes[0], exit_codes[2]) >= 2
    capsys.readouterr()
