"""The learning curves of a run."""

import numpy as np
import pytest

from jaxnav.viz.learning import learning_figure
from jaxnav.viz.style import save_figure


def log_row(seed, env_steps, success, **val_success):
    return {"arm": "baseline", "seed": seed, "env_steps": env_steps, "success": success, **val_success}


ROWS = [
    log_row(0, 1_000_000, 0.2),
    log_row(1, 1_000_000, 0.4),
    log_row(0, 2_000_000, 0.6, val_success=0.3, val_success_sampled=0.15),
    log_row(1, 2_000_000, 0.8, val_success=0.4, val_success_sampled=0.2),
]
REACH = {
    "budgets": [10, 100],
    "val": {"baseline": {"argmax": [0.1, 0.5], "sample": [0.2, 0.6]}},
    "train": {"baseline": {"argmax": [0.3, 0.7], "sample": [0.0, 0.0]}},
}


def drawn_lines(axes):
    """The x and y of every line of a panel."""
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in axes.get_lines()]


def test_learning_figure_draws_percentages_as_means_over_seeds(tmp_path):
    figure = learning_figure(ROWS, REACH, "ORG")
    curve_axes, budget_axes = figure.axes

    # Success by million steps: (20 + 40) / 2 and (60 + 80) / 2 in training, then (30 + 40) / 2 and (15 + 20) / 2.
    training_line, argmax_line, sampled_line = drawn_lines(curve_axes)
    np.testing.assert_allclose(training_line, ([1, 2], [30, 70]))
    np.testing.assert_allclose(argmax_line, ([2], [35]))
    np.testing.assert_allclose(sampled_line, ([2], [17.5]))

    # Success by budget of actions: argmax and sampled in val scenes, argmax in training scenes.
    expected_lines = [([10, 100], [10, 50]), ([10, 100], [20, 60]), ([10, 100], [30, 70])]
    np.testing.assert_allclose(drawn_lines(budget_axes), expected_lines)

    save_figure(figure, tmp_path / "learning.png")
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("rows", [ROWS, []])
def test_learning_figure_without_val_scenes_has_one_panel(rows):
    assert len(learning_figure(rows, None, "ORG").axes) == 1


def test_undefined_success_is_a_gap():
    """No episode of any seed ended in the second chunk, and none of seed 1 in the third."""
    rows = [*ROWS[:2], log_row(0, 2_000_000, None), log_row(1, 2_000_000, None)]
    rows += [log_row(0, 3_000_000, 0.5), log_row(1, 3_000_000, None)]
    (curve_axes,) = learning_figure(rows, None, "ORG").axes
    np.testing.assert_allclose(drawn_lines(curve_axes)[0], ([1, 2, 3], [30, np.nan, 50]))
