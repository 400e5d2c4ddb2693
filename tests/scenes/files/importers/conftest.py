"""Readers of one input, written to a file first."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.importer_inputs.procthor import ASSETS
from support.scene_records import as_scene, without_counts

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor
from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.scene import Scene


@pytest.fixture
def read_metadata(tmp_path: Path) -> Callable[[object], Scene | InputError]:
    """Return a reader of one record of controller metadata."""

    def read(record: object) -> Scene | InputError:
        metadata_file = tmp_path / "room.json"
        metadata_file.write_text(json.dumps(record))
        (result,) = without_counts(read_ai2thor(metadata_file, "val"))
        return result

    return read


@pytest.fixture
def read_house(tmp_path: Path) -> Callable[..., Scene | InputError]:
    """Return a reader of one house with an asset database, or without one if it is empty."""

    def read(house: object, assets: object = ASSETS, *, agent_part: bool = False) -> Scene | InputError:
        house_file = tmp_path / "house.json"
        house_file.write_text(json.dumps(house))
        asset_file = tmp_path / "assets.json"
        asset_file.write_text(json.dumps(assets))
        result, *notes = without_counts(read_procthor(house_file, "val", asset_file if assets else None, agent_part))
        assert all(isinstance(note, ImportNote) for note in notes)
        assert not isinstance(result, ImportNote)
        return result

    return read


@pytest.fixture
def house_scene(read_house: Callable[..., Scene | InputError]) -> Callable[..., Scene]:
    """Return a reader of houses that must give a scene."""
    return lambda *arguments, **options: as_scene(read_house(*arguments, **options))
