"""Tests of import accounts: every value that an importer reads is kept, or skipped for a named reason."""

import codecs
import copy
import gzip
import json
import random
from pathlib import Path
from typing import Any

import pytest
from support.fuzz_importers import FORMATS, Format, randomly_mutated
from support.importer_inputs.ai2thor import METADATA, TABLE
from support.importer_inputs.habitat import EPISODES, STARTS, episode, goal, write_json
from support.importer_inputs.procthor import HOUSE, build, item
from support.importer_inputs.scene_data import FILES, write_folder
from support.importer_inputs.semantic_maps import bedroom, l_shaped_floor, write_maps
from support.mutations import changed
from support.real_scenes import ITHOR, ITHOR_SHUFFLES, PROCTHOR, ROBOTHOR, require
from support.scene_records import RECORD, write_records

from jaxnav.errors import InputError
from jaxnav.scenes.files.importing import ImportSummary, filter_scenes, import_scenes, read_source
from jaxnav.scenes.files.scene_file import read_scenes, write_scenes
from jaxnav.scenes.worlds import load_scenes

CATEGORIES = ("Chair", "Bed", "Fridge", "Sink", "DiningTable", "Book", "Bowl")


def import_source(
    target: Path, scene_format: Any, source: Path, *, selection: tuple[Any, ...] = (), **options: Any
) -> ImportSummary:
    """Import a source, and check that its account adds up and is stored in the scene file."""
    scenes = filter_scenes(read_source(scene_format, str(source), **options), *selection)
    summary = import_scenes(scenes, str(source), target, categories=CATEGORIES, report=lambda error: None)

    # Per unit, the numbers read and added equal the numbers kept and skipped.
    for count in summary.account.values():
        assert count.is_balanced, str(count)
        assert min(count.num_read, count.num_added, count.num_kept, *count.skipped.values()) >= 0, str(count)

    # The file holds the scenes and objects that are kept.
    written_scenes = read_scenes(target)
    assert summary.account["scenes"].num_kept == len(written_scenes)
    assert summary.account["objects"].num_kept == sum(len(scene.types) for scene in written_scenes)

    # The header of the file is the account.
    header, *_ = gzip.decompress(target.read_bytes()).splitlines()
    assert json.loads(header) == {"account": {unit: count.to_json() for unit, count in summary.account.items()}}
    return summary


def numbers(summary: ImportSummary, unit: str) -> tuple[int, int, int, dict[str, int]]:
    """Numbers read, added and kept of a unit, and the numbers skipped by reason."""
    count = summary.account[unit]
    return count.num_read, count.num_added, count.num_kept, count.num_by_reason


# Inputs with worked counts


def test_account_of_metadata(tmp_path):
    # Five objects, of which one is the floor; a record of only two tables without positions; a repeated name; and a
    # damaged record.
    no_positions = changed(METADATA, "objects", [TABLE, TABLE]) | {"actionReturn": [], "sceneName": "FloorPlan5"}
    source = tmp_path / "rooms.jsonl"
    source.write_text("\n".join(map(json.dumps, (METADATA, no_positions, METADATA))) + "\n{")
    summary = import_source(tmp_path / "o.jsonl.gz", "ai2thor", source)
    assert numbers(summary, "scenes") == (4, 0, 1, {"refused": 3})
    assert numbers(summary, "objects") == (12, 0, 4, {"floors, walls and ceilings": 2, "in refused scenes": 6})
    assert str(summary.account["scenes"]) == "scenes: 4 read, 1 kept, 3 skipped (3 refused)"


def test_account_of_offline_folders(tmp_path):
    write_folder(tmp_path / "data" / "FloorPlan401", FILES)
    summary = import_source(tmp_path / "o.jsonl.gz", "scene-data", tmp_path / "data")
    skip_reasons = {"visible from nowhere": 1, "floors, walls and ceilings": 1}
    assert numbers(summary, "objects") == (len(FILES["visible_object_map_1.5.json"]), 0, 3, skip_reasons)


def test_account_of_houses_counts_children_and_boxes_of_corner_counters(tmp_path):
    # A house with a corner counter, the pot on it and a bowl; a house without walls; a house of another room type.
    pot = item("Pot|2|1", "Pot_1", 1.5, 1, 1)
    counter = item("CounterTop|2|0", "Countertop_C_8x6", 1.5, 0.45, 1.5, children=[pot])
    bowl = item("Bowl|2|2", "Bowl_1", 5.5, 1.9, 2.5)
    house = build(("Kitchen", [(0, 0), (0, 3), (6, 3), (6, 0)]), objects=(counter, bowl))
    source = tmp_path / "houses.jsonl"
    source.write_text("\n".join(map(json.dumps, (house, HOUSE | {"walls": None}, HOUSE))))

    summary = import_source(tmp_path / "o.jsonl.gz", "procthor", source, selection=(("kitchen",),))
    assert numbers(summary, "scenes") == (3, 0, 1, {"of other room types": 1, "refused": 1})

    # The house has three objects, one of which becomes three boxes; each of the skipped houses has two objects.
    skipped = {"in refused scenes": 2, "in scenes of other room types": 2}
    assert numbers(summary, "objects") == (7, 2, 5, skipped)


def test_account_of_episodes_counts_goals_and_starts(tmp_path):
    # 27 starts, one of them on the stairs; four goals, a bed twice and a sofa of a scene without episodes.
    source = write_json(tmp_path / "Home.json.gz", EPISODES)
    summary = import_source(tmp_path / "o.jsonl.gz", "habitat", source)
    assert numbers(summary, "episodes") == (27, 0, 26, {"on no floor": 1})
    assert numbers(summary, "goals") == (4, 0, 2, {"listed again": 1, "of scenes without an episode": 1})
    assert numbers(summary, "objects") == (2, 0, 2, {})

    # Without a goal upstairs, the upper floor is refused with its eight starts. A lamp hangs above all floors.
    chair_goals = EPISODES["goals_by_category"]["Home.glb_chair"]
    lamp_goal = goal("lamp", 8, [0, 9.0, 0], [])
    content = EPISODES | {"goals_by_category": {"Home.glb_chair": [*chair_goals, lamp_goal]}}
    source = write_json(tmp_path / "Home.json.gz", content)
    summary = import_source(tmp_path / "p.jsonl.gz", "habitat", source)
    assert numbers(summary, "episodes") == (27, 0, 18, {"in refused scenes": 8, "on no floor": 1})
    assert numbers(summary, "goals") == (2, 0, 2, {})
    assert numbers(summary, "objects") == (2, 0, 1, {"on no floor": 1})


def test_account_of_semantic_maps(tmp_path):
    # Maps of two floors; besides their episodes, one of an unknown floor and one of a scene without maps.
    maps = write_maps(tmp_path / "val_info.pbz2", {"Home": {0: l_shaped_floor(), 1: bedroom()}})
    unknown_floor_episode = episode(0.0, 0.0, 0.0, floor_id=7)
    unknown_scene_episode = episode(0, 0, 0, goals=[goal("bed", 1, [0, 0, 0], [])]) | {"scene_id": "Other.glb"}
    source = write_json(tmp_path / "e.json.gz", {"episodes": [*STARTS, unknown_floor_episode, unknown_scene_episode]})

    summary = import_source(tmp_path / "o.jsonl.gz", "habitat", source, maps=maps)
    skipped = {"on no floor": 1, "in refused scenes": 1}
    assert numbers(summary, "episodes") == (len(STARTS) + 2, 0, len(STARTS), skipped)
    assert numbers(summary, "goals") == (1, 0, 0, {"replaced by the objects of the maps": 1})
    assert numbers(summary, "scenes") == (3, 0, 2, {"refused": 1})
    assert summary.account["objects"].num_kept == 2


def test_account_of_replacements(tmp_path):
    # A room with one book gets three sets: one book, two books, which are refused, and none.
    base = write_records(tmp_path / "base.jsonl.gz", RECORD)
    rows = [["Book", 0.0, 1.0, 0.0]]
    record = {"name": "den", "columns": ["type", "x", "y", "z"], "sets": [rows, rows * 2, []]}
    source = write_records(tmp_path / "sets.jsonl.gz", record)
    summary = import_source(tmp_path / "o.jsonl.gz", "replacements", source, base=base)
    assert numbers(summary, "rows") == (3, 0, 1, {"in refused scenes": 2})
    assert numbers(summary, "objects") == (6, 0, 4, {"in refused scenes": 2})


def test_account_of_scene_files_counts_objects_without_a_place(tmp_path):
    # A third object has neither x nor z; the second scene is refused, because its cells are not 0.25 m wide.
    placeless_object = [*RECORD["objects"][0]]
    placeless_object[1] = None
    placeless_object[3] = None
    record = RECORD | {"objects": [*RECORD["objects"], placeless_object]}
    source = write_records(tmp_path / "s.jsonl.gz", record, RECORD | {"name": "b", "cell": 1})
    imported_file = tmp_path / "a.jsonl.gz"
    summary = import_source(imported_file, "scenes", source)
    assert numbers(summary, "objects") == (5, 0, 2, {"without a place": 1, "in refused scenes": 2})

    # Files with headers can be joined, read and imported again.
    joined_file = tmp_path / "joined.jsonl.gz"
    other_file = write_records(tmp_path / "other.jsonl.gz", RECORD | {"name": "other"})
    joined_file.write_bytes(other_file.read_bytes() + imported_file.read_bytes())
    assert [scene.name for scene in read_scenes(joined_file)] == ["other", "den"]
    summary = import_source(tmp_path / "b.jsonl.gz", "scenes", joined_file)
    assert numbers(summary, "objects") == (4, 0, 4, {})


@pytest.mark.parametrize("prefix", [codecs.BOM_UTF8, b"  "])
def test_a_header_may_begin_like_any_line(tmp_path, prefix):
    source = write_records(tmp_path / "source.jsonl.gz", RECORD)
    import_source(tmp_path / "with.jsonl.gz", "scenes", source)
    content = gzip.decompress((tmp_path / "with.jsonl.gz").read_bytes())
    (tmp_path / "edited.jsonl").write_bytes(prefix + content)

    original_scenes = load_scenes(tmp_path / "with.jsonl.gz", None)
    edited_scenes = load_scenes(tmp_path / "edited.jsonl", None)
    assert [scene.name for scene in edited_scenes.scenes] == ["den"]
    assert edited_scenes.identity == original_scenes.identity


def test_identity_of_scenes_does_not_depend_on_the_header(tmp_path):
    source = write_records(tmp_path / "source.jsonl.gz", RECORD)
    summary = import_source(tmp_path / "with.jsonl.gz", "scenes", source, split="val")
    assert summary.account
    write_scenes(tmp_path / "without.jsonl.gz", read_scenes(tmp_path / "with.jsonl.gz"))

    scenes = load_scenes(tmp_path / "with.jsonl.gz", "val")
    headerless_scenes = load_scenes(tmp_path / "without.jsonl.gz", "val")
    assert headerless_scenes.identity == scenes.identity


# Random and real inputs


@pytest.mark.slow
@pytest.mark.parametrize("scene_format", FORMATS, ids=lambda form: " ".join((form.name, *form.options[:1])))
def test_account_of_mutated_inputs_adds_up(tmp_path, scene_format: Format):
    rng = random.Random(0)
    num_imported = 0
    for index in range(60):
        folder = tmp_path / str(index)
        folder.mkdir()
        source = scene_format.write(folder, randomly_mutated(copy.deepcopy(scene_format.content), rng))
        options = {"maps": folder / "maps.pbz2"} if scene_format.options else {}
        try:
            import_source(folder / "o.jsonl.gz", scene_format.name, source, **options)
        except InputError:
            continue
        num_imported += 1
    assert num_imported >= 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene_format", "source", "options"),
    [
        ("procthor", PROCTHOR / "houses_100k.jsonl.gz", {"assets": PROCTHOR / "asset-database.json"}),
        ("procthor", PROCTHOR / "houses_ai2.jsonl.gz", {"agent_part": True}),
        ("procthor", PROCTHOR / "houses_objaverse.jsonl.gz", {}),
        ("scenes", ROBOTHOR, {}),
        ("replacements", ITHOR_SHUFFLES, {"base": ITHOR}),
    ],
)
def test_account_of_real_files_adds_up(tmp_path, scene_format, source, options):
    summary = import_source(tmp_path / "o.jsonl.gz", scene_format, require(source), selection=((), 60), **options)
    assert summary.account["objects"].num_read > 500
