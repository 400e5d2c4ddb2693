"""Sweeps over epsilon: bit-identical to the sTDE rows of an evaluation, in one compilation."""

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
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.runs.run import Run
from jaxnav.runs.sweep import sweep_shifts

#: Thresholds and number of episodes of `evaluated`.
EPSILON = np.linspace(0, 1, 11)
EPISODES = 24
DECODINGS = ("argmax", "sample")


def select_row(outcome, row_index):
    """Outcome of a row, or of several rows."""
    return jax.tree.map(lambda leaf: leaf[row_index], outcome)


@pytest.fixture(scope="module")
def sweeps(drawn_run):
    """Sweeps of the run by decoding."""
    return {name: jaxnav.sweep(drawn_run, EPSILON, episodes=EPISODES, decoding=name) for name in DECODINGS}


@pytest.mark.parametrize("decoding", DECODINGS)
def test_sweep_equals_the_stde_rows_of_an_evaluation(sweeps, evaluated, decoding):
    sweep = sweeps[decoding]
    metrics = evaluated.metrics()
    assert sweep.compilations == 1
    np.testing.assert_array_equal(sweep.epsilon, EPSILON)

    # The evaluation also compiles replacements, so the sums of weights may be rounded otherwise.
    stde_rows = [EvaluationRow("stde", epsilon, "residual", decoding) for epsilon in EPSILON]
    row_indices = np.array([evaluated.rows.index(row) for row in stde_rows])
    expected = select_row(evaluated.outcome, row_indices)
    chex.assert_trees_all_equal(sweep.outcome._replace(total_weight=0), expected._replace(total_weight=0))
    np.testing.assert_allclose(sweep.outcome.mean_weight, expected.mean_weight, rtol=1e-6)

    # Metrics of all thresholds, seeds and episodes.
    for name in ("sr", "spl", "dts"):
        assert getattr(sweep, name).shape == (len(EPSILON), NUM_SEEDS, EPISODES)
        np.testing.assert_array_equal(getattr(sweep, name), metrics[name][row_indices])


@pytest.mark.parametrize("decoding", DECODINGS)
def test_sweep_removes_nothing_from_epsilon_1_on(sweeps, evaluated, decoding):
    mean_weights = sweeps[decoding].outcome.mean_weight.mean((1, 2))
    assert mean_weights[-1] == 0
    assert (np.diff(mean_weights) < 0).all()

    # From epsilon 1 on the outcome is that of the layout weights; at epsilon 0 removal changes episodes.
    layout_index = evaluated.rows.index(EvaluationRow("layout", None, None, decoding))
    layout_outcome = select_row(evaluated.outcome, layout_index)
    chex.assert_trees_all_equal(select_row(sweeps[decoding].outcome, -1), layout_outcome)
    assert (sweeps[decoding].outcome.length[0] != layout_outcome.length).any()


@pytest.mark.exhaustive
def test_sweep_evaluates_the_given_parameters(sweeps, drawn_run):
    def sweep_params(params):
        return jaxnav.sweep(drawn_run, EPSILON, params, episodes=EPISODES).outcome

    outcome = sweeps["argmax"].outcome
    params = drawn_run.policies(("layout",)).params
    chex.assert_trees_all_equal(sweep_params(params), outcome)

    # Reversed seeds give the outcomes in reversed order.
    reversed_params = jax.tree.map(lambda leaf: np.asarray(leaf)[::-1], params)
    reversed_outcome = sweep_params(reversed_params)
    chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[:, ::-1], reversed_outcome), outcome)

    # Changed parameters give other episodes.
    changed_params = jax.tree.map(lambda leaf: leaf + 0.1, params)
    assert (sweep_params(changed_params).length != outcome.length).any()


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
    for measure in (jaxnav.sweep, jaxnav.evaluate):
        with pytest.raises(InputError, match=problem):
            measure(drawn_run, **arguments)


@pytest.mark.parametrize("option", ["decoding", "form", "setting", "split", "world", "shift_by"])
def test_sweep_refuses_names_that_it_does_not_accept(drawn_run, option):
    options: dict[str, Any] = {option: "best"}
    with pytest.raises(InputError, match=rf"^--{option.replace('_', '-')} 'best': choose one of "):
        jaxnav.sweep(drawn_run, EPSILON, **options)


def test_sweep_refuses_runs_without_the_layout(drawn_run, tmp_path):
    baseline_run = Run(dataclasses.replace(drawn_run.config, arms=("baseline",)))
    with pytest.raises(InputError, match="was trained without the arm 'layout'; train a run with both --arms"):
        jaxnav.sweep(baseline_run, EPSILON)

    unfinished_run = Run(dataclasses.replace(drawn_run.config, run_dir=tmp_path))
    with pytest.raises(InputError, match="layout-0: is missing, so training has not finished"):
        jaxnav.sweep(unfinished_run, EPSILON)


def test_sweep_refuses_methods_that_cannot_use_the_layout(drawn_run):
    anonymous_run = Run(dataclasses.replace(drawn_run.config, method="anonymous", arms=("baseline",)))
    with pytest.raises(InputError, match=r"method 'anonymous' cannot use the layout, .* give a run of another method"):
        jaxnav.sweep(anonymous_run, EPSILON)


# Tables


def select_report_rows(rows, **fields):
    """Rows of a report that have the given values."""
    return [row for row in rows if fields.items() <= row.items()]


@pytest.mark.parametrize("decoding", DECODINGS)
def test_rows_of_a_sweep_equal_the_report_of_an_evaluation(sweeps, evaluated, decoding):
    rows = sweeps[decoding].rows()
    assert [row.epsilon for row in rows] == EPSILON.tolist()

    for row in rows:
        fields = {"epsilon": row.epsilon, "decoding": decoding}
        (report_row,) = select_report_rows(evaluated.report["rows"], variant="stde", **fields)
        for metric in ("sr", "spl", "dts"):
            assert row.metrics[metric] == Interval.from_json(report_row[metric])
            (difference,) = select_report_rows(evaluated.report["differences"], to="stde", metric=metric, **fields)
            assert row.changes[metric] == Interval.from_json(difference)


@pytest.mark.slow
def test_no_removal_has_a_row_unless_a_threshold_is_1(drawn_run, sweeps, evaluated):
    sweep_to_one = sweeps["argmax"]
    layout_index = evaluated.rows.index(EvaluationRow("layout", None, None, "argmax"))
    chex.assert_trees_all_equal(sweep_to_one.no_removal, select_row(evaluated.outcome, layout_index))

    # Without a threshold of 1, the last row is that of no removal.
    sweep = jaxnav.sweep(drawn_run, (0.0, 0.5), episodes=EPISODES)
    *_, last_row = sweep.rows()
    assert (last_row.epsilon, last_row.removed) == (None, 0.0)
    assert last_row.metrics == sweep_to_one.rows()[-1].metrics
    assert last_row.changes["sr"].mean == 0.0


def test_table_of_a_sweep_has_a_line_for_every_threshold(sweeps):
    table = sweeps["argmax"].table()
    assert table.row_count == 1 + len(EPSILON)  # a heading for the shift, and the thresholds
    assert [*table.columns[0].cells][:3] == ["shift 0", "0", "0.1"]
    assert [note.partition(" ")[0] for note in sweeps["argmax"].notes()] == ["95", "Removed:", "Change:"]


# Several shifts


@pytest.mark.exhaustive
def test_shifts_share_a_compilation_and_equal_evaluations(drawn_run):
    results = sweep_shifts(drawn_run, (0.0, 0.5), (0.0, 1.0), episodes=EPISODES)
    assert [result.compilations for result in results] == [1, 0]
    for shift, result in zip((0.0, 1.0), results, strict=True):
        assert result.settings["shift"] == shift
        evaluation = jaxnav.evaluate(drawn_run, shift=shift, epsilon=(0.0, 0.5), episodes=EPISODES)
        stde_rows = [EvaluationRow("stde", epsilon, "residual", "argmax") for epsilon in (0.0, 0.5)]
        row_indices = np.array([evaluation.rows.index(row) for row in stde_rows])
        chex.assert_trees_all_equal(result.outcome, select_row(evaluation.outcome, row_indices))
    assert (results[0].outcome.length != results[1].outcome.length).any()


# Directories and policies


@pytest.mark.exhaustive
def test_run_directory_is_measured_as_its_run(drawn_run, sweeps, evaluated):
    path = str(drawn_run.config.run_dir)
    chex.assert_trees_all_equal(jaxnav.sweep(path, EPSILON, episodes=EPISODES).outcome, sweeps["argmax"].outcome)
    evaluation = jaxnav.evaluate(path, epsilon=EPSILON, episodes=EPISODES)
    chex.assert_trees_all_equal(evaluation.outcome, evaluated.outcome)


@pytest.mark.exhaustive
def test_sweep_of_a_policy_equals_the_sweep_of_its_run(drawn_run):
    # A policy is evaluated in the usual scenes of its world.
    run = Run(dataclasses.replace(drawn_run.config, worlds=RunConfig().worlds))
    run_outcome = jaxnav.sweep(run, (0.0, 0.5), episodes=EPISODES).outcome
    folder = run.config.run_dir / POLICIES_DIR / "layout-1"
    for source in (folder, str(folder), jaxnav.load_policy(folder)):
        sweep = jaxnav.sweep(source, (0.0, 0.5), episodes=EPISODES)
        assert sweep.sr.shape == (2, 1, EPISODES)
        chex.assert_trees_all_equal(sweep.outcome, jax.tree.map(lambda leaf: leaf[:, 1:2], run_outcome))

    # Intervals of a single policy are over scenes.
    interval = sweep.rows()[0].metrics["sr"]
    assert interval.has_bounds
    assert "hold for this policy alone" in sweep.notes()[0]


def test_sweep_refuses_names_and_policies_without_layout(drawn_run, tmp_path):
    message = r"nowhere: neither a run directory .* a packaged policy: apartments-belief, .*, rooms-org$"
    with pytest.raises(InputError, match=message):
        jaxnav.sweep("nowhere")
    with pytest.raises(InputError, match="neither a run directory"):
        jaxnav.sweep(tmp_path)

    # The arm `baseline` does not use the layout.
    baseline_folder = drawn_run.config.run_dir / POLICIES_DIR / "baseline-0"
    for baseline in (baseline_folder, jaxnav.load_policy(baseline_folder)):
        with pytest.raises(InputError, match="a policy of the arm 'baseline', which does not use the layout"):
            jaxnav.sweep(baseline)


def test_policy_in_memory_has_no_counts_for_priors_of_other_estimators():
    policy = jaxnav.load_policy("rooms-org")
    for measure in (jaxnav.sweep, jaxnav.evaluate):
        with pytest.raises(InputError, match=r"setting 'paper' needs the counts behind the priors, .* by its folder"):
            measure(policy, setting="paper")


def test_evaluate_refuses_a_list_of_policies():
    policy = jaxnav.load_policy("rooms-org")
    with pytest.raises(InputError, match="give one policy at a time"):
        jaxnav.evaluate([policy, policy])
