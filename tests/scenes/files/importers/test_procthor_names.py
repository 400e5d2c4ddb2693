"""Object types from ProcTHOR names, in real houses with and without the asset database."""

import uuid
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.importer_inputs.procthor import BOWL, HOUSE, TABLE
from support.mutations import changed
from support.real_scenes import INPUTS, PROCTHOR, require

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
        ("Laptop2", "Laptop"),
        ("Bed_6f3e0bed41c94a1f", "Bed"),
        # Hashes and other ids are no words, however they are cut.
        ("6f3e0bed41c94a1f8a2077c5a9e4a813", None),
        ("6f3e07d141c94a1f8d2077c5d9e4a813", None),
        ("6F3E0BED41C94A1F8A2077C5A9E4A813", None),
        ("bed00000", None),
        ("cd123456", None),
        ("0bed", None),
        ("4cd9_0bed", None),
        ("6f3e0bed-41c9-4bed-8a20-77c5a9e4abed", None),
        ("deadbeef-cdcd-abed-cafe-bedbedbedbed", None),
        ("x9Q_3cd_bed7f", None),
        ("\u00e9bed", None),
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


@given(st.binary(min_size=2, max_size=20).map(bytes.hex), st.sampled_from(["", "_", "-", "|"]), st.randoms())
def test_type_from_asset_name_finds_no_word_in_a_hash(hash_text, separator, draw):
    # A hash that is letters alone can be a word, such as `bed`.
    assume(any(character.isdecimal() for character in hash_text[:2]))
    hash_text = draw.choice([str.lower, str.upper])(hash_text)
    assert type_from_asset_name(f"{separator}{hash_text}") is None
    assert type_from_asset_name(str(uuid.UUID(int=draw.getrandbits(128)))) is None
    assert type_from_asset_name(f"Sofa_{uuid.UUID(int=draw.getrandbits(128))}") == "Sofa"


@pytest.mark.parametrize(
    ("object_fields", "expected_type"),
    [
        ({"id": "0|1", "assetId": "6f3e0bed41c94a1f8a2077c5a9e4a813"}, "6f3e0bed41c94a1f8a2077c5a9e4a813"),
        ({"id": "6f3e0bed|1", "assetId": "Bed_3"}, "Bed"),
        ({"id": "4cd|1", "assetId": "Bed_3"}, "Bed"),
        # Holodeck's houses.
        (
            {"id": "television-0 (living room)", "object_name": "television-0", "assetId": "6f3e07d141c94a1f8d2077c5"},
            "Television",
        ),
    ],
)
def test_read_procthor_takes_no_type_from_a_hash(house_scene, object_fields, expected_type):
    scene = house_scene(changed(HOUSE, "objects", [TABLE, BOWL | object_fields]))
    assert scene.types[2] == expected_type


@pytest.mark.parametrize(
    ("file_name", "expected_types"),
    [
        ("p05_hash_asset_bed.json", ("6f3e0bed41c94a1f8a2077c5a9e4a813", "Bowl")),
        ("p06_holodeck_object.json", ("Television",)),
    ],
)
def test_read_procthor_takes_no_type_from_the_hashes_of_earlier_reports(file_name, expected_types):
    scene, *_ = read_procthor(require(INPUTS / file_name), "train")
    assert isinstance(scene, Scene)
    assert scene.types == expected_types


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


@pytest.mark.slow
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
