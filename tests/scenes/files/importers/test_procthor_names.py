"""Types by names, and real houses with and without the database."""

import pytest
from support.real_scenes import PROCTHOR, require

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.importers.procthor import (
    normalize_object_type,
    read_assets,
    read_procthor,
    type_from_asset_name,
)
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.task import HOUSES


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("bin_8", "GarbageCan"),
        ("Houseplant_29", "HousePlant"),
        ("Side_Table_228_2_1", "SideTable"),
        ("RoboTHOR_sofa_kramfors", "Sofa"),
        ("Toilet_Paper_Used_Up", "ToiletPaper"),  # the longest name, not the first
        ("Towel_Statue_2", "Statue"),  # the last of equally long names
        ("Paper_Towel_1", "PaperTowelRoll"),
        ("Bookend_3", None),  # whole words count
        ("0123abc", None),
        ("", None),
    ],
)
def test_names_of_assets_tell_types(name, kind):
    assert type_from_asset_name(name) == kind


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("ObjaTrashCan", "GarbageCan"),
        ("ObjaBarStool", "Stool"),
        ("ObjaStepStool", "ObjaStepStool"),  # a Footstool, which is no category, and no Stool
        ("ObjaPottedPlant", "HousePlant"),
        ("ObjaBottleCap", "ObjaBottleCap"),  # a cap
        ("ObjaBathtub", "ObjaBathtub"),  # no category
        ("Obja", "Obja"),
        ("TrashCan", "TrashCan"),  # not one of Objaverse's
        ("Chair", "Chair"),
    ],
)
def test_types_of_objaverse_that_are_categories_are_renamed(name, kind):
    assert normalize_object_type(name) == kind


def test_names_tell_the_type_of_every_asset_of_the_database():
    assets = read_assets(require(PROCTHOR / "asset-database.json"))
    assert len(assets) == 1653
    assert {name: asset.type for name, asset in assets.items() if type_from_asset_name(name) != asset.type} == {}


@pytest.mark.parametrize(("file", "houses", "guessed"), [("100k", 30, 2821), ("ai2", 20, 1431), ("objaverse", 100, 0)])
def test_real_houses_lose_no_goal_without_the_database(file, houses, guessed):
    path = require(PROCTHOR / f"houses_{file}.jsonl.gz")
    types, numbers = [], []
    for database in (PROCTHOR / "asset-database.json", None):
        results = list(read_procthor(path, "train", database))
        types.append([result.types for result in results if isinstance(result, Scene)])
        notes = [note for note in results if isinstance(note, ImportNote)]
        numbers.append(sum(note.number for note in notes if note.text.startswith("types of objects are guessed")))
    assert len(types[0]) == houses
    assert types[0] == types[1]
    assert numbers == [0, guessed]
    num_known = sum(category >= 0 for house in types[1] for category in category_ids(house, HOUSES.categories))
    assert num_known > 17 * houses
