"""Generated rooms, shared by several files."""

import pytest

from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.scene import Scene


@pytest.fixture(scope="session")
def rooms() -> list[Scene]:
    return [generate_room("train", i, 0) for i in range(200)]
