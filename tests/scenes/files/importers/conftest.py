"""Readers of one input, written to a file first."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.importer_inputs.procthor import ASSETS
from support.scene_records import as_scene

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor
from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.scene import Scene


@pytest.fixture
def read_metadata(tmp_path: Path) -> Callable[[object], Scene | InputError]:
    def read(record: object) -> Scene | InputError:
        path = tmp_path / "room.json"
        path.write_text(json.dumps(record))
        (result,) = read_ai2thor(path, "val")
        return result

    return read


@pytest.fixture
def read_house(tmp_path: Path) -> Callable[..., Scene | InputError]:
    def read(house: object, assets: object = ASSETS, *, agent_part: bool = False) -> Scene | InputError:
        (tmp_path / "house.json").write_text(json.dumps(house))
        (tmp_path / "assets.json").write_text(json.dumps(assets))
        database = tmp_path / "assets.json" if assets else None
        result, *notes = read_procthor(tmp_path / "house.json", "val", database, agent_part)
        assert all(isinstance(note, ImportNote) for note in notes)
        assert not isinstance(result, ImportNote)
        return result

    return read


@pytest.fixture
def scene_of(read_house: Callable[..., Scene | InputError]) -> Callable[..., Scene]:
    """Return a reader of houses that must give a scene."""
    return lambda *arguments, **options: as_scene(read_house(*arguments, **options))
