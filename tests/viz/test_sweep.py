"""Tests of the figure of a sweep: a curve and a band for every shift, and axes that do not exaggerate."""

import numpy as np
import pytest
from support.tiny_run import NUM_SEEDS, draw_run, tiny_config

from jaxnav.runs.sweep import sweep_shifts
from jaxnav.viz.sweep import sweep_figure

EPSILON = (0.5, 0.0, 1.0)


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    run = draw_run(tiny_config(tmp_path_factory.mktemp("figure")))
    return sweep_shifts(run, EPSILON, (0.0, 1.0), episodes=24)


@pytest.mark.slow
def test_curves_are_the_rows_in_rising_order_of_the_threshold(sweeps):
    # Curves have markers, unlike the lines of seeds. The second curve shows the mean success of the second sweep.
    sr_axes = sweep_figure(sweeps).axes[0]
    curves = [line for line in sr_axes.lines if line.get_marker() != "None"]
    assert len(curves) == len(sweeps)
    rows = {row.epsilon: row for row in sweeps[1].rows()}
    expected_means = [rows[epsilon].metrics["sr"].mean for epsilon in (0.0, 0.5, 1.0)]
    np.testing.assert_array_equal(curves[1].get_xdata(), sorted(EPSILON))
    np.testing.assert_array_equal(curves[1].get_ydata(), expected_means)

    # A thin line for every seed and a band for every shift.
    assert len(sr_axes.lines) == len(sweeps) * (1 + NUM_SEEDS)
    assert len(sr_axes.collections) == len(sweeps)


@pytest.mark.slow
def test_axes_of_percent_start_at_0_and_axes_of_changes_are_symmetric(sweeps):
    sr_axes, spl_axes, sr_change_axes, spl_change_axes = sweep_figure(sweeps).axes
    for axes in (sr_axes, spl_axes):
        bottom, top = axes.get_ylim()
        assert bottom == 0
        assert top <= 102
    assert sr_change_axes.get_ylim() == spl_change_axes.get_ylim()
    bottom, top = sr_change_axes.get_ylim()
    assert bottom == -top <= -1


@pytest.mark.slow
def test_title_names_method_and_episodes(sweeps):
    sweep, _ = sweeps
    title = sweep_figure(sweep).axes[0].get_title(loc="left")
    assert title == "ORG, run: 24 val episodes, best actions"
    assert sweep_figure(sweep, "Mine").axes[0].get_title(loc="left") == "Mine"
