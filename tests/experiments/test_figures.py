"""Figures of experiments: drawn data, labels and styles, and the rows of results that they are drawn from."""

import io
from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection, LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image
from support.result_rows import make_curve, make_seeded_interval

from jaxnav.choices import Form
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments import figures
from jaxnav.experiments.gap_traces import Belief
from jaxnav.experiments.similarity import GainBySimilarity, SuccessBySimilarity
from jaxnav.experiments.table import Curve, ResultRow, ResultTable
from jaxnav.viz.style import FIGURE_DPI, FIGURE_WIDTH, save_figure

FORMS: tuple[Form, ...] = ("residual", "paper")
BELIEFS: tuple[Belief, ...] = ("updated", "frozen")
SHIFTS = (0.0, 1.0)
METRICS = ("sr", "spl", "dts")


SUCCESS = {}
for _shift in SHIFTS:
    SUCCESS[_shift] = SuccessBySimilarity(
        episodes=np.array([4, 8, 2, 4]),
        similarity=np.array([0.9, 0.1, 0.5, 0.3]),
        success=np.array([1.0, 0.25, 0.5, 0.75]),
        pearson=make_seeded_interval(0.5, 0.1),
        spearman=make_seeded_interval(-0.25, 0.5),
    )
GAIN = GainBySimilarity(
    categories=("Sink", "Book", "Pan"),
    similarity=np.array([0.8, 0.4, 0.6]),
    baseline=np.array([70.0, 40.0, 50.0]),
    gain=np.array([-2.0, 6.0, 1.0]),
    slope=make_seeded_interval(-2.0, 0.5),
    pearson=make_seeded_interval(-0.75, 0.25),
)


def make_metrics(sr: float, spl: float, dts: float) -> dict[str, Interval]:
    return {"sr": make_seeded_interval(sr), "spl": make_seeded_interval(spl), "dts": make_seeded_interval(dts)}


SWEEPS: dict[tuple[float, Form], dict[float, dict[str, Interval]]] = {}
for _form in FORMS:
    for _shift in SHIFTS:
        SWEEPS[_shift, _form] = {
            0.0: make_metrics(60.0 - 10 * _shift, 30.0 - 10 * _shift, 1.5 + _shift),
            0.5: make_metrics(64.0, 34.0, 1.25),
            1.0: make_metrics(61.0, 31.0, 1.5),
        }
GAP_LINES: dict[tuple[float, Belief], Curve] = {}
for _shift in SHIFTS:
    for _belief in BELIEFS:
        GAP_LINES[_shift, _belief] = make_curve(0.7, 0.5 + 0.1 * _shift, 0.4, 0.3, half_width=0.05)
GAPS: dict[str, dict[tuple[float, Belief], Curve]] = {}
for _setting in ("paper", "released", "calibrated"):
    GAPS[_setting] = GAP_LINES
AUCS = {
    "calibrated": make_curve(0.5, 0.6, 0.7, 0.7, half_width=0.05),
    "evidence": make_curve(0.6, 0.7, 0.8, 0.8, half_width=0.05),
}
EFFECTS = {
    "shift 0": {"+ w": make_seeded_interval(3.0), "sTDE": make_seeded_interval(-1.0, 2.0)},
    "shift 1": {"+ w": make_seeded_interval(-4.0, 1.5)},
}
DRAWINGS: dict[str, Callable[[], Figure]] = {
    "similarity": lambda: figures.similarity_figure(SUCCESS),
    "gain": lambda: figures.gain_figure({1.0: GAIN}, "+ w + sTDE"),
    "epsilon": lambda: figures.epsilon_figure(SWEEPS),
    "gap": lambda: figures.gap_figure(GAPS),
    "auc": lambda: figures.auc_figure(AUCS),
    "effects": lambda: figures.effects_figure(EFFECTS),
}


def marked_lines(axes: Axes) -> list[np.ndarray]:
    """Data [T, 2] of every line with markers."""
    return [np.asarray(line.get_xydata()) for line in axes.get_lines() if line.get_marker() != "None"]


def band_limits(axes: Axes) -> list[np.ndarray]:
    """Lowest and highest point of every band, in the order of drawing."""
    bands = [artist for artist in axes.collections if isinstance(artist, FillBetweenPolyCollection)]
    return [band.get_datalim(axes.transData).get_points()[:, 1] for band in bands]


def legend_texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def assert_curve(axes: Axes, index: int, curve: Curve) -> None:
    """Assert that a line with markers and its band show a curve."""
    np.testing.assert_allclose(marked_lines(axes)[index], np.stack([curve.positions, curve.mean], axis=1))
    np.testing.assert_allclose(band_limits(axes)[index], [curve.low.min(), curve.high.max()])


def assert_first_line_is_level(axes: Axes, level: float) -> None:
    np.testing.assert_array_equal(np.asarray(axes.get_lines()[0].get_ydata()), [level, level])


# Figures of given data


def test_the_similarity_figure_shows_points_sizes_and_means(monkeypatch):
    monkeypatch.setattr(figures, "NUM_BINS", 2)
    axes = DRAWINGS["similarity"]().axes[0]
    (points,) = axes.collections
    assert isinstance(points, PathCollection)
    np.testing.assert_allclose(np.asarray(points.get_offsets()), [[0.9, 100], [0.1, 25], [0.5, 50], [0.3, 75]])

    # Areas are in the ratio of the episodes, 4 : 8 : 2 : 4.
    np.testing.assert_allclose(points.get_sizes(), figures.MAX_MARKER_AREA * np.array([0.5, 1.0, 0.25, 0.5]))

    # Means of both halves of the similarity, weighted by episodes: (0.1 * 8 + 0.3 * 4) / 12 = 1/6 and
    # (25 * 8 + 75 * 4) / 12 = 125/3; (0.5 * 2 + 0.9 * 4) / 6 = 23/30 and (50 * 2 + 100 * 4) / 6 = 250/3.
    np.testing.assert_allclose(marked_lines(axes)[0], [[1 / 6, 125 / 3], [23 / 30, 250 / 3]])
    title = axes.get_title(loc="left")
    assert "0.50 [0.40, 0.60]" in title
    assert "−0.25 [−0.75, 0.25]" in title  # noqa: RUF001


def test_the_gain_figure_sorts_categories_by_similarity():
    sr_axes, gain_axes = DRAWINGS["gain"]().axes
    assert [bar.get_height() for bar in sr_axes.patches if isinstance(bar, Rectangle)] == [40, 50, 70]
    np.testing.assert_allclose(marked_lines(gain_axes)[0], [[0, 6], [1, 1], [2, -2]])
    labels = [text.get_text() for text in gain_axes.get_xticklabels()]
    assert [label.split() for label in labels] == [["Book", "0.40"], ["Pan", "0.60"], ["Sink", "0.80"]]
    title = sr_axes.get_title(loc="left")
    assert "+ w + sTDE" in title
    assert "−2.0 [−2.5, −1.5]" in title  # noqa: RUF001


def test_the_epsilon_figure_has_a_row_by_form_and_a_column_by_metric():
    figure = DRAWINGS["epsilon"]()
    for (shift, form), metrics_by_epsilon in SWEEPS.items():
        row_axes = figure.axes[3 * FORMS.index(form) :][:3]
        line_index = SHIFTS.index(shift)
        for axes, metric in zip(row_axes, METRICS, strict=True):
            intervals = [metrics[metric] for metrics in metrics_by_epsilon.values()]
            assert_curve(axes, line_index, Curve.from_intervals(list(metrics_by_epsilon), intervals))

            # Thin lines show the three training runs of each shift.
            seed_lines = [np.asarray(line.get_ydata()) for line in axes.get_lines() if line.get_marker() == "None"]
            seeds = np.transpose([interval.seeds for interval in intervals])
            np.testing.assert_allclose(seed_lines[3 * line_index :][:3], seeds)
    assert legend_texts(figure)[:2] == ["shift 0", "shift 1"]


def test_the_gap_figure_has_a_panel_by_estimator():
    figure = DRAWINGS["gap"]()
    assert len(figure.axes) == len(GAPS)
    for axes, setting in zip(figure.axes, GAPS, strict=True):
        assert setting in axes.get_title(loc="left")
        assert_first_line_is_level(axes, 0.5)
        for index, curve in enumerate(GAP_LINES.values()):
            assert_curve(axes, index, curve)

        # The marker shows the shift, and the dash shows the belief.
        lines = [line for line in axes.get_lines() if line.get_marker() != "None"]
        assert [line.get_linestyle() for line in lines] == ["-", "--", "-", "--"]
        assert lines[0].get_marker() == lines[1].get_marker() != lines[2].get_marker() == lines[3].get_marker()


def test_the_auc_figure_has_a_line_by_estimator():
    figure = DRAWINGS["auc"]()
    (axes,) = figure.axes
    assert_first_line_is_level(axes, 0.5)
    for index, curve in enumerate(AUCS.values()):
        assert_curve(axes, index, curve)
    assert legend_texts(figure)[:2] == ["calibrated", "evidence"]


def test_more_lines_than_styles_are_distinguishable():
    curve_by_estimator = {f"estimator {index}": make_curve(0.5, 0.6, 0.7, half_width=0.05) for index in range(9)}
    (axes,) = figures.auc_figure(curve_by_estimator).axes
    lines = [line for line in axes.get_lines() if line.get_marker() != "None"]
    line_styles = {(line.get_color(), line.get_marker(), line.get_markerfacecolor()) for line in lines}
    assert len(lines) == len(line_styles) == 9

    # Every shift has a line in the sweep, too.
    sweeps: dict[tuple[float, Form], dict[float, dict[str, Interval]]] = {}
    for index in range(9):
        sweeps[index / 8, "paper"] = {0.0: make_metrics(60.0, 30.0, 1.5), 1.0: make_metrics(61.0, 31.0, 1.5)}
    assert len(set(legend_texts(figures.epsilon_figure(sweeps)))) == 9 + 1  # and the training seeds


def test_the_effects_figure_fills_markers_whose_interval_excludes_zero():
    first_axes, second_axes = DRAWINGS["effects"]().axes
    np.testing.assert_allclose(np.concatenate(marked_lines(first_axes)), [[3, 0], [-1, 1]])

    # The intervals of the first panel are 3 +- 1 and -1 +- 2.
    limits = []
    for artist in first_axes.collections:
        if isinstance(artist, LineCollection):
            limits += [(start[0], end[0]) for start, end in artist.get_segments()]
    assert limits == [(2, 4), (-3, 1)]

    # In both panels, the intervals 3 +- 1 and -4 +- 1.5 exclude zero, and -1 +- 2 does not.
    markers = [*first_axes.get_lines()[1:], *second_axes.get_lines()[1:]]
    assert [marker.get_markerfacecolor() != "white" for marker in markers] == [True, False, True]

    # The first effect is at the top, with its numbers next to it.
    assert [text.get_text() for text in first_axes.get_yticklabels()] == ["+ w", "sTDE"]
    assert first_axes.yaxis_inverted()
    assert first_axes.texts[0].get_text() == "+3.0 [+2.0, +4.0]"


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAWINGS)
def test_equal_data_gives_equal_bytes(name, tmp_path):
    figure = DRAWINGS[name]()
    paths = [tmp_path / file_name for file_name in ("first.png", "again.png", "redrawn.png")]
    save_figure(figure, paths[0])
    save_figure(figure, paths[1])
    save_figure(DRAWINGS[name](), paths[2])
    assert len({path.read_bytes() for path in paths}) == 1

    # The files have the size of figures.
    with Image.open(io.BytesIO(paths[0].read_bytes())) as png:
        assert png.width == FIGURE_WIDTH * FIGURE_DPI
        assert not set(png.info) - {"dpi"}  # neither a date nor a version


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAWINGS)
def test_all_text_is_inside_the_figure(name):
    figure = DRAWINGS[name]()
    box = figure.get_tightbbox()  # inches
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= FIGURE_WIDTH
    assert box.y1 <= figure.get_figheight()


def grey_level(color: str) -> float:
    """Luma of ITU-R BT.601 of a color `#rrggbb`."""
    rgb = [int(color[start : start + 2], 16) for start in (1, 3, 5)]
    return float(np.array(rgb) @ (0.299, 0.587, 0.114))


def test_neighbouring_line_styles_differ_in_grey():
    grey_levels = [grey_level(style["color"]) for style in figures.LINE_STYLES]
    assert (np.abs(np.diff(grey_levels[:4])) > 35).all()
    assert len({style["marker"] for style in figures.LINE_STYLES}) == len(figures.LINE_STYLES)


# Figures of the result table

FIELDS = {"world": "rooms", "run": "main"}


def make_table(*rows: dict) -> ResultTable:
    return ResultTable([ResultRow(**{**FIELDS, **row}) for row in rows])


@pytest.mark.slow
def test_the_similarity_figures_are_drawn_from_rows_by_point_and_category():
    rows = []
    stde = {"variant": "stde", "decoding": "argmax", "form": "residual", "epsilon": 0.5}
    for shift, success in SUCCESS.items():
        baseline = {"variant": "baseline", "shift": shift}
        no_bounds = np.full(4, np.nan)
        for metric, values in (("sr", success.success), ("episodes", success.episodes)):
            curve = Curve(success.similarity, values, no_bounds, no_bounds)
            rows.append({**baseline, "metric": f"{metric} by similarity", "value": curve})
        for index, category in enumerate(GAIN.categories):
            for metric in ("similarity", "baseline", "gain"):
                value = make_seeded_interval(float(getattr(GAIN, metric)[index]) + shift)
                category_fields = {"shift": shift, "category": category, "metric": f"{metric} by category"}
                rows.append({**stde, **category_fields, "value": value})
    table = make_table(*rows)

    # Fig. 4 has a panel by shift.
    figure = figures.FIGURES["fig4"](table, SHIFTS, FIELDS)
    for axes, expected_axes in zip(figure.axes, DRAWINGS["similarity"]().axes, strict=True):
        np.testing.assert_allclose(marked_lines(axes), marked_lines(expected_axes))

    # Fig. 5 has two panels by shift; the gains at the second are one point more.
    axes = figures.FIGURES["fig5"](table, SHIFTS, FIELDS).axes
    np.testing.assert_allclose(marked_lines(axes[1])[0], [[0, 6], [1, 1], [2, -2]])
    np.testing.assert_allclose(marked_lines(axes[3])[0], [[0, 7], [1, 2], [2, -1]])


@pytest.mark.slow
def test_the_epsilon_figure_is_drawn_from_sweeps_with_best_actions():
    rows = []
    for (shift, form), metrics_by_epsilon in SWEEPS.items():
        for epsilon, metrics in metrics_by_epsilon.items():
            sweep = {"variant": "stde", "gap": "novelty", "form": form, "epsilon": epsilon, "shift": shift}
            for metric, interval in metrics.items():
                rows.append({**sweep, "decoding": "argmax", "metric": metric, "value": interval})

                # The figure ignores sampled actions, controls, further gaps and differences.
                for change in ({"decoding": "sample"}, {"control": "noise"}, {"gap": "clock"}, {"reference": "layout"}):
                    other_row = {**sweep, "decoding": "argmax", "metric": metric, **change}
                    rows.append({**other_row, "value": make_seeded_interval(7.0), "epsilon": 0.25})
    figure = figures.FIGURES["fig6a"](make_table(*rows), SHIFTS, FIELDS)
    for axes, expected_axes in zip(figure.axes, DRAWINGS["epsilon"]().axes, strict=True):
        np.testing.assert_allclose(marked_lines(axes), marked_lines(expected_axes))


@pytest.mark.slow
def test_the_gap_figures_are_drawn_from_curves_of_the_outer_shifts():
    shifts = (0.0, 0.5, 1.0)
    ignored_curve = make_curve(9, 9, 9, 9, half_width=0.05)
    rows = []
    for shift in shifts:
        for setting in GAPS:
            for belief in BELIEFS:
                curve = GAP_LINES[shift, belief] if shift in SHIFTS else ignored_curve
                rows.append({"shift": shift, "variant": setting, "control": belief, "metric": "gap", "value": curve})
        for setting, auc in AUCS.items():
            curve = auc if shift == 1.0 else ignored_curve
            rows.append({"shift": shift, "variant": setting, "control": "updated", "metric": "gap auc", "value": curve})
    table = make_table(*rows)

    # Gaps are drawn at the first and the last shift, AUCs at the last.
    for name, drawing in (("fig6b", "gap"), ("auc", "auc")):
        figure = figures.FIGURES[name](table, shifts, FIELDS)
        for axes, expected_axes in zip(figure.axes, DRAWINGS[drawing]().axes, strict=True):
            np.testing.assert_allclose(marked_lines(axes), marked_lines(expected_axes))


def test_the_effects_figure_is_drawn_from_differences_to_the_layout():
    # Each form with its threshold, each gap and each shift have their own effect.
    rows = []
    effects = {("residual", 0.5, "novelty"): 1, ("residual", 0.5, "evidence"): 2}
    effects |= {("paper", 0.0, "novelty"): 3, ("paper", 0.0, "evidence"): 4}
    for shift in SHIFTS:
        for (form, epsilon, gap), effect in effects.items():
            stde = {"variant": "stde", "decoding": "argmax", "form": form, "epsilon": epsilon, "gap": gap}
            difference = {"shift": shift, "reference": "layout", "metric": "sr"}
            rows.append({**stde, **difference, "value": make_seeded_interval(effect + 10 * shift)})
    figure = figures.FIGURES["effects"](make_table(*rows), SHIFTS, FIELDS)
    for axes, shift in zip(figure.axes, SHIFTS, strict=True):
        drawn_effects = [float(points[0, 0]) for points in marked_lines(axes)]
        assert drawn_effects == [1 + 10 * shift, 2 + 10 * shift, 3 + 10 * shift, 4 + 10 * shift]
