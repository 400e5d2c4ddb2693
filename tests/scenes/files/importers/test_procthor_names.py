"""Object types from ProcTHOR names, in real houses with and without the asset database."""

from pathlib import Path

import numpy as np
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
    ("asset_name", "expected_type"),
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
def test_type_from_asset_name_of_typical_names(asset_name, expected_type):
    assert type_from_asset_name(asset_name) == expected_type


@pytest.mark.parametrize(
    ("object_type", "expected_type"),
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
def test_normalize_object_type_renames_objaverse_types_of_categories(object_type, expected_type):
    assert normalize_object_type(object_type) == expected_type


def test_type_from_asset_name_of_every_asset_of_the_database():
    assets = read_assets(require(PROCTHOR / "asset-database.json"))
    assert len(assets) == 1653
    asset_types = {asset_name: asset.type for asset_name, asset in assets.items()}
    assert {asset_name: type_from_asset_name(asset_name) for asset_name in assets} == asset_types


def types_and_guesses(house_file: Path, asset_file: Path | None) -> tuple[list[tuple[str, ...]], int]:
    """Return the types of the objects of every house in a file, and how many of them were guessed."""
    types = []
    num_guesses = 0
    for result in read_procthor(house_file, "train", asset_file):
        if isinstance(result, Scene):
            types.append(result.types)
        elif isinstance(result, ImportNote) and result.text.startswith("types of objects are guessed"):
            num_guesses += result.number
    return types, num_guesses


@pytest.mark.parametrize(
    ("house_set", "num_houses", "num_guessed"), [("100k", 30, 2821), ("ai2", 20, 1431), ("objaverse", 100, 0)]
)
def test_read_procthor_guesses_types_of_real_houses_without_the_database(house_set, num_houses, num_guessed):
    house_file = require(PROCTHOR / f"houses_{house_set}.jsonl.gz")
    types, num_guesses = types_and_guesses(house_file, PROCTHOR / "asset-database.json")
    guessed_types, num_guesses_without = types_and_guesses(house_file, None)
    assert len(types) == num_houses
    assert guessed_types == types
    assert (num_guesses, num_guesses_without) == (0, num_guessed)

    # Most objects have a category.
    num_known = 0
    for house_types in guessed_types:
        num_known += np.count_nonzero(np.array(category_ids(house_types, HOUSES.categories)) >= 0)
    assert num_known > 17 * num_houses
