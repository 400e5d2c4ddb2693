"""The figures draw and name the numbers they are given."""

import dataclasses
import io
from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection, LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image
from support.study_results import band, estimate, interval, row

from jaxnav.causal import Form
from jaxnav.study import figures
from jaxnav.study.records import (
    AucLine,
    AucPanel,
    Belief,
    Curve,
    GainBySimilarity,
    GapCurves,
    GapLine,
    GapPanel,
    SuccessBySimilarity,
    Trial,
    TrialRow,
)
from jaxnav.viz.style import FIGURE_DPI, FIGURE_WIDTH, save_figure

FORMS: tuple[Form, ...] = ("residual", "paper")
BELIEFS: tuple[Belief, ...] = ("updated", "frozen")


def trial_row(epsilon: float, form: Form, sr: float, spl: float, dts: float) -> TrialRow:
    plain = row(Trial("stde", "argmax", epsilon, form), 0.0)
    return dataclasses.replace(plain, sr=estimate(sr), spl=estimate(spl), dts=estimate(dts))


SUCCESS = {
    shift: SuccessBySimilarity(
        category=np.arange(4),
        scene=np.arange(4),
        episodes=np.array([4, 8, 2, 4]),
        similarity=np.array([0.9, 0.1, 0.5, 0.3]),
        success=np.array([1.0, 0.25, 0.5, 0.75]),
        left_out=0,
        pearson=interval(0.5, 0.1),
        spearman=interval(-0.25, 0.5),
    )
    for shift in (0.0, 1.0)
}
GAIN = GainBySimilarity(
    category=np.arange(3),
    episodes=np.array([4, 4, 4]),
    similarity=np.array([0.8, 0.4, 0.6]),
    baseline=np.array([70.0, 40.0, 50.0]),
    gain=np.array([-2.0, 6.0, 1.0]),
    left_out=0,
    slope=interval(-2.0, 0.5),
    pearson=interval(-0.75, 0.25),
    categories=("Sink", "Book", "Pan"),
)
SWEEPS: dict[tuple[float, Form], dict[float, TrialRow]] = {
    (shift, form): {
        0.0: trial_row(0.0, form, 60.0 - 10 * shift, 30.0 - 10 * shift, 1.5 + shift),
        0.5: trial_row(0.5, form, 64.0, 34.0, 1.25),
        1.0: trial_row(1.0, form, 61.0, 31.0, 1.5),
    }
    for form in FORMS
    for shift in (0.0, 1.0)
}
LINES = tuple(
    GapLine(shift, belief, band(np.array([0.7, 0.5 + 0.1 * shift, 0.4, 0.3]), 0.05))
    for shift in (0.0, 1.0)
    for belief in BELIEFS
)
AUC = AucPanel(
    1.0,
    (
        AucLine("calibrated", band(np.array([0.5, 0.6, 0.7, 0.7]), 0.05)),
        AucLine("evidence", band(np.array([0.6, 0.7, 0.8, 0.8]), 0.05)),
    ),
)
COURSE = GapCurves(
    steps=(0, 1, 2, 3),
    running=np.ones((2, 4)),
    panels=tuple(GapPanel(setting, LINES) for setting in ("paper", "released", "calibrated")),
    auc=(AUC,),
)
EFFECTS = {
    "Shift 0": {"+ w": interval(3.0, 1.0), "sTDE": interval(-1.0, 2.0)},
    "Shift 1": {"+ w": interval(-4.0, 1.5)},
}
DRAWINGS: dict[str, Callable[[], Figure]] = {
    "similarity": lambda: figures.similarity_figure(SUCCESS),
    "gain": lambda: figures.gain_figure({1.0: GAIN}, "+ w + sTDE"),
    "epsilon": lambda: figures.epsilon_figure(SWEEPS),
    "gap": lambda: figures.gap_figure(COURSE),
    "auc": lambda: figures.auc_figure(COURSE.steps, AUC),
    "effects": lambda: figures.effects_figure(EFFECTS),
}


def lines(axes: Axes) -> list[np.ndarray]:
    """Return data [T, 2] of every line with markers."""
    return [np.asarray(line.get_xydata()) for line in axes.get_lines() if line.get_marker() != "None"]


def bands(axes: Axes) -> list[np.ndarray]:
    """Return (low, high) of every band, in the order drawn."""
    polygons = [artist for artist in axes.collections if isinstance(artist, FillBetweenPolyCollection)]
    return [artist.get_datalim(axes.transData).get_points()[:, 1] for artist in polygons]


def assert_line(axes: Axes, index: int, x, curve: Curve) -> None:
    np.testing.assert_allclose(lines(axes)[index], np.stack([x, curve.mean], axis=1))
    np.testing.assert_allclose(bands(axes)[index], [curve.low.min(), curve.high.max()])


def assert_level(axes: Axes, level: float) -> None:
    """Assert that the first line is a level."""
    np.testing.assert_array_equal(np.asarray(axes.get_lines()[0].get_ydata()), [level, level])


def keys(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_similarity_points_sizes_and_means(monkeypatch):
    monkeypatch.setattr(figures, "NUM_BINS", 2)
    axes = DRAWINGS["similarity"]().axes[0]
    (points,) = axes.collections
    assert isinstance(points, PathCollection)
    np.testing.assert_allclose(np.asarray(points.get_offsets()), [[0.9, 100], [0.1, 25], [0.5, 50], [0.3, 75]])
    # Areas are in the ratio of the episodes, 4 : 8 : 2 : 4.
    np.testing.assert_allclose(points.get_sizes(), figures.MAX_MARKER_AREA * np.array([0.5, 1.0, 0.25, 0.5]))
    # Halves by similarity, weighted by episodes: (0.1 * 8 + 0.3 * 4) / 12 = 1/6 and (25 * 8 + 75 * 4) / 12 = 125/3;
    # (0.5 * 2 + 0.9 * 4) / 6 = 23/30 and (50 * 2 + 100 * 4) / 6 = 250/3.
    np.testing.assert_allclose(lines(axes)[0], [[1 / 6, 125 / 3], [23 / 30, 250 / 3]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Layout similarity (cosine)", "SR (%)")
    title = axes.get_title(loc="left").split("\n")
    assert title == ["Shift 0", "Pearson r 0.50 [0.40, 0.60]", "Spearman r −0.25 [−0.75, 0.25]"]  # noqa: RUF001


def test_gain_is_sorted_by_similarity():
    above, below = DRAWINGS["gain"]().axes
    assert [bar.get_height() for bar in above.patches if isinstance(bar, Rectangle)] == [40, 50, 70]
    np.testing.assert_allclose(lines(below)[0], [[0, 6], [1, 1], [2, -2]])
    assert [text.get_text() for text in below.get_xticklabels()] == ["Book 0.40", "Pan 0.60", "Sink 0.80"]
    assert (above.get_ylabel(), below.get_ylabel()) == ("Baseline SR (%)", "Gain (SR points)")
    title = above.get_title(loc="left")
    assert "+ w + sTDE" in title
    assert "−2.0 [−2.5, −1.5] points per 0.1 of similarity" in title  # noqa: RUF001


def test_epsilon_has_a_row_per_form_and_a_column_per_metric():
    figure = DRAWINGS["epsilon"]()
    for i, by_epsilon in enumerate(SWEEPS.values()):
        for axes, metric in zip(figure.axes[3 * (i // 2) :][:3], ("sr", "spl", "dts"), strict=True):
            estimates = [row.metric(metric) for row in by_epsilon.values()]
            assert_line(axes, i % 2, list(by_epsilon), Curve.from_intervals(estimates))
            thin = [np.asarray(line.get_ydata()) for line in axes.get_lines() if line.get_marker() == "None"]
            seeds = np.transpose([estimate.seeds for estimate in estimates])
            np.testing.assert_allclose(thin[3 * (i % 2) : 3 * (i % 2) + 3], seeds)
    assert [axes.get_ylabel() for axes in figure.axes[:3]] == ["SR (%)", "SPL (%)", "DTS (m)"]
    assert keys(figure) == ["shift 0", "shift 1", "one training seed"]


def test_gap_has_a_panel_per_setting():
    figure = DRAWINGS["gap"]()
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "Setting paper",
        "Setting released",
        "Setting calibrated",
    ]
    for axes in figure.axes:
        for i, line in enumerate(LINES):
            assert_line(axes, i, COURSE.steps, line.curve)
        drawn = [line for line in axes.get_lines() if line.get_marker() != "None"]
        assert [line.get_linestyle() for line in drawn] == ["-", "--", "-", "--"]  # updated, frozen
        assert drawn[0].get_marker() == drawn[1].get_marker() != drawn[2].get_marker() == drawn[3].get_marker()
        assert_level(axes, 0.5)
    assert keys(figure)[:2] == ["shift 0, belief updated", "shift 0, belief frozen"]


def test_auc_has_a_line_per_setting_and_chance():
    figure = DRAWINGS["auc"]()
    (axes,) = figure.axes
    for i, line in enumerate(AUC.lines):
        assert_line(axes, i, COURSE.steps, line.curve)
    assert_level(axes, 0.5)
    assert keys(figure) == ["calibrated", "evidence", "chance"]
    assert axes.get_xlabel() == "Step"


def test_effects_are_filled_where_the_interval_excludes_0():
    first, second = DRAWINGS["effects"]().axes
    np.testing.assert_allclose(np.concatenate(lines(first)), [[3, 0], [-1, 1]])
    bars = [artist for artist in first.collections if isinstance(artist, LineCollection)]
    assert [(start[0], end[0]) for bar in bars for start, end in bar.get_segments()] == [(2, 4), (-3, 1)]
    filled = [line.get_markerfacecolor() != "white" for axes in (first, second) for line in axes.get_lines()[1:]]
    assert filled == [True, False, True]
    assert [text.get_text() for text in first.get_yticklabels()] == ["+ w", "sTDE"]
    assert first.yaxis_inverted()  # the first row is on top
    assert first.texts[0].get_text() == "+3.0 [+2.0, +4.0]"
    assert second.get_xlabel().startswith("Difference in SR (points)")


@pytest.mark.parametrize("name", DRAWINGS)
def test_equal_data_gives_equal_bytes(name, tmp_path):
    figure = DRAWINGS[name]()
    paths = [tmp_path / "new" / file for file in ("a.png", "b.png", "c.png")]
    save_figure(figure, paths[0])
    save_figure(figure, paths[1])
    save_figure(DRAWINGS[name](), paths[2])
    assert len({path.read_bytes() for path in paths}) == 1
    with Image.open(io.BytesIO(paths[0].read_bytes())) as png:
        assert png.width == FIGURE_WIDTH * FIGURE_DPI
        assert not set(png.info) - {"dpi"}  # no text


@pytest.mark.parametrize("name", DRAWINGS)
def test_all_text_is_inside_the_figure(name):
    figure = DRAWINGS[name]()
    box = figure.get_tightbbox()  # inches
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= FIGURE_WIDTH
    assert box.y1 <= figure.get_figheight()
