"""The sweep is the evaluation's rows of sTDE, to the bit, in one compilation."""

import dataclasses

import chex
import jax
import numpy as np
import pytest
from support.tiny_run import NUM_SEEDS

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.runs.run import Run

EPSILON, EPISODES = np.linspace(0, 1, 11), 24  # those of `evaluated`
DECODINGS = ("argmax", "sample")


def _row(outcome, row):
    return jax.tree.map(lambda leaf: leaf[row], outcome)


@pytest.fixture(scope="module")
def swept(drawn_run):
    return {name: jaxnav.sweep(drawn_run, EPSILON, episodes=EPISODES, decoding=name) for name in DECODINGS}


@pytest.mark.parametrize("decoding", DECODINGS)
def test_sweep_equals_the_stde_rows_of_an_evaluation(swept, evaluated, decoding):
    sweep = swept[decoding]
    metrics = evaluated.metrics()
    assert sweep.compilations == 1
    np.testing.assert_array_equal(sweep.epsilon, EPSILON)
    rows = np.array([evaluated.rows.index(EvaluationRow("stde", epsilon, "residual", decoding)) for epsilon in EPSILON])
    chex.assert_trees_all_equal(sweep.outcome, _row(evaluated.outcome, rows))
    for name in ("sr", "spl", "dts"):
        assert getattr(sweep, name).shape == (len(EPSILON), NUM_SEEDS, EPISODES)
        np.testing.assert_array_equal(getattr(sweep, name), metrics[name][rows])


@pytest.mark.parametrize("decoding", DECODINGS)
def test_sweep_removes_nothing_from_epsilon_1_on(swept, evaluated, decoding):
    mean_weights = swept[decoding].outcome.mean_weight.mean((1, 2))
    assert mean_weights[-1] == 0
    assert (np.diff(mean_weights) < 0).all()
    layout = evaluated.rows.index(EvaluationRow("layout", None, None, decoding))
    row = _row(evaluated.outcome, layout)
    chex.assert_trees_all_equal(_row(swept[decoding].outcome, -1), row)
    assert (swept[decoding].outcome.length[0] != row.length).any()  # what is removed at epsilon 0 matters here


@pytest.mark.slow
def test_sweep_evaluates_the_given_parameters(swept, drawn_run):
    params = drawn_run.policies(("layout",)).params
    repeated_outcomes = {
        name: jaxnav.sweep(drawn_run, EPSILON, own, episodes=EPISODES).outcome
        for name, own in {
            "same": params,
            "reversed": jax.tree.map(lambda leaf: np.asarray(leaf)[::-1], params),
            "other": jax.tree.map(lambda leaf: leaf + 0.1, params),
        }.items()
    }
    outcome = swept["argmax"].outcome
    chex.assert_trees_all_equal(repeated_outcomes["same"], outcome)
    chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[:, ::-1], repeated_outcomes["reversed"]), outcome)
    assert (repeated_outcomes["other"].length != outcome.length).any()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"epsilon": ()}, "epsilon: give at least one number"),
        ({"epsilon": np.zeros(0)}, "epsilon: give at least one number"),
        ({"epsilon": (0.5, -0.1)}, "epsilon -0.1: give numbers from 0"),
        ({"epsilon": (float("nan"),)}, "epsilon nan: give numbers from 0"),
        ({"epsilon": (float("inf"),)}, "epsilon inf: give numbers from 0"),
        ({"epsilon": (0.5,), "episodes": 0}, "episodes 0: give at least 1"),
        ({"epsilon": (0.5,), "seed": -1}, "seed -1: give a whole number from 0"),
        ({"epsilon": (0.5,), "seed": 2**32}, "seed 4294967296: give a whole number from 0"),
    ],
)
def test_sweep_refuses_impossible_arguments(drawn_run, arguments, problem):
    for call in (jaxnav.sweep, jaxnav.evaluate):
        with pytest.raises(InputError, match=problem):
            call(drawn_run, **arguments)


def test_sweep_refuses_runs_without_the_layout(drawn_run, tmp_path):
    baseline = Run(dataclasses.replace(drawn_run.config, arms=("baseline",)))
    with pytest.raises(InputError, match="was trained without the arm 'layout'; train one with all --arms"):
        jaxnav.sweep(baseline, EPSILON)
    unfinished_run = Run(dataclasses.replace(drawn_run.config, run_dir=tmp_path))
    with pytest.raises(InputError, match="layout-0: is missing, so training has not finished"):
        jaxnav.sweep(unfinished_run, EPSILON)
