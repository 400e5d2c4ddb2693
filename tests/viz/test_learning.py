"""The learning curves of a run."""

import numpy as np
import pytest

from jaxnav.viz.learning import learning_figure
from jaxnav.viz.style import save_figure

ROWS = [
    {"arm": "baseline", "seed": seed, "env_steps": steps, "success": success}
    | ({"val_success": success / 2, "val_success_sampled": success / 4} if steps == 2_000_000 else {})
    for steps, successes in ((1_000_000, (0.2, 0.4)), (2_000_000, (0.6, 0.8)))
    for seed, success in enumerate(successes)
]
REACH = {
    "budgets": [10, 100],
    "val": {"baseline": {"argmax": [0.1, 0.5], "sample": [0.2, 0.6]}},
    "train": {"baseline": {"argmax": [0.3, 0.7], "sample": [0.0, 0.0]}},
}


def lines(axes):
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in axes.get_lines()]


def test_curves_are_means_over_seeds_in_percent(tmp_path):
    figure = learning_figure(ROWS, REACH, "ORG")
    curve_axes, budget_axes = figure.axes
    training, best, sampled = lines(curve_axes)
    np.testing.assert_allclose(training, ([1, 2], [30, 70]))  # (20 + 40) / 2 and (60 + 80) / 2
    np.testing.assert_allclose(best, ([2], [35]))
    np.testing.assert_allclose(sampled, ([2], [17.5]))
    np.testing.assert_allclose(lines(budget_axes), [([10, 100], course) for course in ([10, 50], [20, 60], [30, 70])])
    save_figure(figure, tmp_path / "learning.png")
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("rows", [ROWS, []])
def test_without_val_scenes_there_is_one_panel(rows):
    assert len(learning_figure(rows, None, "ORG").axes) == 1
