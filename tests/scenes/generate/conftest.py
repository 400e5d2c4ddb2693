"""Rooms that several files measure, generated once."""

import pytest

from jaxnav.scenes.generate.rooms import generate_rooms
from jaxnav.scenes.scene import Scene


@pytest.fixture(scope="session")
def rooms() -> list[Scene]:
    return generate_rooms(num_train=200, num_val=0, num_test=0, seed=0)
