"""A run whose policies were drawn instead of trained, and experiments that measure it."""

import dataclasses
from collections.abc import Callable

import pytest
from rich.console import Console
from support.tiny_run import draw_run, tiny_config

import jaxnav
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import ExperimentConfig, check_experiment
from jaxnav.runs.run import Run

EPISODES = 24


@pytest.fixture(scope="session")
def drawn_run(tmp_path_factory) -> Run:
    """A run as training leaves it, with both arms and two seeds; it has no logs."""
    return draw_run(tiny_config(tmp_path_factory.mktemp("runs")))


@pytest.fixture(scope="session")
def evaluated(drawn_run) -> jaxnav.Results:
    """The evaluation of the run at shift 0, as `jaxnav eval` does it."""
    return jaxnav.evaluate(drawn_run, shift=0.0, episodes=EPISODES, form="residual")


@pytest.fixture
def make_experiment(drawn_run, tmp_path) -> Callable[..., ExperimentConfig]:
    """Make an experiment of the drawn run, whose results are in a folder of the test."""

    def make(**changes) -> ExperimentConfig:
        run = {"run": str(drawn_run.config.run_dir)}
        config = ExperimentConfig(
            results=tmp_path / "results",
            runs=tmp_path / "runs",
            worlds={"rooms": {}},
            agents={"main": run},
            shifts=(0.0,),
            episodes=EPISODES,
        )
        return check_experiment(dataclasses.replace(config, **changes))

    return make


@pytest.fixture
def make_bench(make_experiment) -> Callable[..., Bench]:
    """Make the bench of an experiment of the drawn run."""

    def make(**changes) -> Bench:
        return Bench(make_experiment(**changes), Console(quiet=True))

    return make
