"""The sweep is the evaluation's rows of sTDE, to the bit, in one compilation."""

import dataclasses
from typing import Any

import chex
import jax
import numpy as np
import pytest
from support.tiny_run import NUM_SEEDS

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.runs.config import RunConfig
from jaxnav.runs.evaluate import sweep_shifts
from jaxnav.runs.policies import POLICIES_DIR
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
    # The evaluation also compiles replacements, so the sums of weights may be rounded otherwise.
    expected = _row(evaluated.outcome, rows)
    chex.assert_trees_all_equal(sweep.outcome._replace(mean_weight=0), expected._replace(mean_weight=0))
    np.testing.assert_allclose(sweep.outcome.mean_weight, expected.mean_weight, rtol=1e-6)
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


@pytest.mark.exhaustive
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
        ({"epsilon": (0.5, -0.1)}, "epsilon -0.1: give finite numbers of at least 0"),
        ({"epsilon": (float("nan"),)}, "epsilon nan: give finite numbers of at least 0"),
        ({"epsilon": (float("inf"),)}, "epsilon inf: give finite numbers of at least 0"),
        ({"epsilon": (0.5,), "episodes": 0}, "episodes 0: give at least 1"),
        ({"epsilon": (0.5,), "seed": -1}, "seed -1: give a whole number from 0"),
        ({"epsilon": (0.5,), "seed": 2**32}, "seed 4294967296: give a whole number from 0"),
    ],
)
def test_sweep_refuses_impossible_arguments(drawn_run, arguments, problem):
    for call in (jaxnav.sweep, jaxnav.evaluate):
        with pytest.raises(InputError, match=problem):
            call(drawn_run, **arguments)


@pytest.mark.parametrize("option", ["decoding", "form", "setting", "split", "world", "shift_by"])
def test_sweep_refuses_names_that_it_does_not_accept(drawn_run, option):
    options: dict[str, Any] = {option: "best"}
    with pytest.raises(InputError, match=rf"^--{option.replace('_', '-')} 'best': choose one of "):
        jaxnav.sweep(drawn_run, EPSILON, **options)


def test_sweep_refuses_runs_without_the_layout(drawn_run, tmp_path):
    baseline = Run(dataclasses.replace(drawn_run.config, arms=("baseline",)))
    with pytest.raises(InputError, match="was trained without the arm 'layout'; train a run with both --arms"):
        jaxnav.sweep(baseline, EPSILON)
    unfinished_run = Run(dataclasses.replace(drawn_run.config, run_dir=tmp_path))
    with pytest.raises(InputError, match="layout-0: is missing, so training has not finished"):
        jaxnav.sweep(unfinished_run, EPSILON)


def test_sweep_refuses_methods_that_cannot_use_the_layout(drawn_run):
    anonymous = Run(dataclasses.replace(drawn_run.config, method="anonymous", arms=("baseline",)))
    with pytest.raises(InputError, match=r"method 'anonymous' cannot use the layout, .* give a run of another method"):
        jaxnav.sweep(anonymous, EPSILON)


# Tables


@pytest.mark.parametrize("decoding", DECODINGS)
def test_rows_of_a_sweep_equal_the_report_of_an_evaluation(swept, evaluated, decoding):
    rows = swept[decoding].rows()
    assert [row.epsilon for row in rows] == EPSILON.tolist()

    for row in rows:
        fields = {"epsilon": row.epsilon, "decoding": decoding}
        (report_row,) = select_rows(evaluated.report["rows"], variant="stde", **fields)
        for metric in ("sr", "spl", "dts"):
            assert row.metrics[metric] == Interval.from_json(report_row[metric])
            (difference,) = select_rows(evaluated.report["differences"], to="stde", metric=metric, **fields)
            assert row.changes[metric] == Interval.from_json(difference)


def select_rows(rows, **fields):
    """Return the rows of a report that have the given values."""
    return [row for row in rows if fields.items() <= row.items()]


@pytest.mark.slow
def test_no_removal_has_a_row_unless_a_threshold_is_1(drawn_run, swept, evaluated):
    full = swept["argmax"]
    layout = evaluated.rows.index(EvaluationRow("layout", None, None, "argmax"))
    chex.assert_trees_all_equal(full.no_removal, _row(evaluated.outcome, layout))

    sweep = jaxnav.sweep(drawn_run, (0.0, 0.5), episodes=EPISODES)
    *_, last_row = sweep.rows()
    assert (last_row.epsilon, last_row.removed) == (None, 0.0)
    assert last_row.metrics == full.rows()[-1].metrics
    assert last_row.changes["sr"].mean == 0.0


def test_table_of_a_sweep_has_a_line_for_every_threshold(swept):
    table = swept["argmax"].table()
    assert table.row_count == 1 + len(EPSILON)  # the heading of the shift, and the thresholds
    assert [*table.columns[0].cells][:3] == ["shift 0", "0", "0.1"]
    assert [note.partition(" ")[0] for note in swept["argmax"].notes()] == ["95", "Removed:", "Change:"]


# Several shifts


@pytest.mark.exhaustive
def test_shifts_share_a_compilation_and_equal_evaluations(drawn_run):
    results = sweep_shifts(drawn_run, (0.0, 0.5), (0.0, 1.0), episodes=EPISODES)
    assert [result.compilations for result in results] == [1, 0]
    for shift, result in zip((0.0, 1.0), results, strict=True):
        assert result.settings["shift"] == shift
        evaluation = jaxnav.evaluate(drawn_run, shift=shift, epsilon=(0.0, 0.5), episodes=EPISODES)
        rows = [evaluation.rows.index(EvaluationRow("stde", epsilon, "residual", "argmax")) for epsilon in (0.0, 0.5)]
        chex.assert_trees_all_equal(result.outcome, _row(evaluation.outcome, np.array(rows)))
    assert (results[0].outcome.length != results[1].outcome.length).any()


# Directories and policies


@pytest.mark.exhaustive
def test_run_directory_stands_for_its_run(drawn_run, swept, evaluated):
    path = str(drawn_run.config.run_dir)
    chex.assert_trees_all_equal(jaxnav.sweep(path, EPSILON, episodes=EPISODES).outcome, swept["argmax"].outcome)
    evaluation = jaxnav.evaluate(path, epsilon=EPSILON, episodes=EPISODES)
    chex.assert_trees_all_equal(evaluation.outcome, evaluated.outcome)


@pytest.mark.exhaustive
def test_policy_equals_the_run_that_exported_it(drawn_run):
    # A policy is evaluated in the usual scenes of its world.
    run = Run(dataclasses.replace(drawn_run.config, worlds=RunConfig().worlds))
    run_outcome = jaxnav.sweep(run, (0.0, 0.5), episodes=EPISODES).outcome
    folder = run.config.run_dir / POLICIES_DIR / "layout-1"
    for source in (folder, str(folder), jaxnav.load_policy(folder)):
        sweep = jaxnav.sweep(source, (0.0, 0.5), episodes=EPISODES)
        assert sweep.sr.shape == (2, 1, EPISODES)
        chex.assert_trees_all_equal(sweep.outcome, jax.tree.map(lambda leaf: leaf[:, 1:2], run_outcome))

    # A single policy has intervals over scenes.
    interval = sweep.rows()[0].metrics["sr"]
    assert interval.has_bounds
    assert "hold for this policy alone" in sweep.notes()[0]


def test_sweep_refuses_what_is_no_run_and_no_layout_policy(drawn_run, tmp_path):
    with pytest.raises(
        InputError,
        match=r"nowhere: neither a run directory .* a packaged policy: apartments-belief, .*, rooms-org$",
    ):
        jaxnav.sweep("nowhere")
    with pytest.raises(InputError, match="neither a run directory"):
        jaxnav.sweep(tmp_path)
    baseline_folder = drawn_run.config.run_dir / POLICIES_DIR / "baseline-0"
    for baseline in (baseline_folder, jaxnav.load_policy(baseline_folder)):
        with pytest.raises(InputError, match="a policy of the arm 'baseline', which does not use the layout"):
            jaxnav.sweep(baseline)


def test_a_policy_in_memory_has_no_counts_for_the_priors_of_other_estimators():
    policy = jaxnav.load_policy("rooms-org")
    for measure in (jaxnav.sweep, jaxnav.evaluate):
        with pytest.raises(InputError, match=r"setting 'paper' needs the counts behind the priors, .* by its folder"):
            measure(policy, setting="paper")


def test_a_list_of_policies_is_no_agent():
    policy = jaxnav.load_policy("rooms-org")
    with pytest.raises(InputError, match="give one policy at a time"):
        jaxnav.evaluate([policy, policy])
