"""A run whose policies were drawn instead of trained, and its evaluation."""

import numpy as np
import pytest
from support.tiny_run import draw_run, tiny_config

import jaxnav
from jaxnav.runs.config import RunConfig
from jaxnav.runs.run import Run

EPSILON = np.linspace(0, 1, 11)
EPISODES = 24


@pytest.fixture(scope="session")
def config(tmp_path_factory) -> RunConfig:
    """The settings of the command's tests."""
    return tiny_config(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def drawn_run(config) -> Run:
    """A run as training leaves it, with policies that act by what they see."""
    return draw_run(config)


@pytest.fixture(scope="session")
def evaluated(drawn_run) -> jaxnav.Results:
    """Its evaluation, at every epsilon."""
    return jaxnav.evaluate(drawn_run, epsilon=EPSILON, episodes=EPISODES)
