"""The study's figures draw the numbers they are given, name them with their units, and are saved byte for byte."""

import copy

import numpy as np
import pytest
from matplotlib.collections import FillBetweenPolyCollection
from PIL import Image

from jaxnav.study import figures


def interval(mean, half):
    return {"mean": mean, "ci95": [mean - half, mean + half]}


def band(mean, half=0.05):
    return {"mean": mean, "low": [x - half for x in mean], "high": [x + half for x in mean]}


def metric(mean):
    return band(mean, 1.0) | {"seeds": [[x - 0.5 for x in mean], [x + 0.5 for x in mean]]}


FIG4 = {
    "panels": [
        {
            "shift": shift,
            "similarity": [0.9, 0.1, 0.5, 0.3],
            "success": [1.0, 0.25, 0.5, 0.75],
            "episodes": [4, 8, 2, 4],
            "pearson": interval(0.5, 0.1),
            "spearman": interval(-0.25, 0.5),
        }
        for shift in (0.0, 1.0)
    ]
}
FIG5 = {
    "panels": [
        {
            "shift": 1.0,
            "variant": "+ w + sTDE",
            "categories": ["Sink", "Book", "Pan"],
            "similarity": [0.8, 0.4, 0.6],
            "baseline": [70.0, 40.0, 50.0],
            "gain": [-2.0, 6.0, 1.0],
            "slope": interval(-2.0, 0.5),
            "pearson": interval(-0.75, 0.25),
        }
    ]
}
FIG6A = {
    "epsilon": [0.0, 0.5, 1.0],
    "lines": [
        {
            "shift": shift,
            "form": form,
            "sr": metric([60.0 - 10 * shift, 64.0, 61.0]),
            "spl": metric([30.0 - 10 * shift, 34.0, 31.0]),
            "dts": metric([1.5 + shift, 1.25, 1.5]),
        }
        for form in ("residual", "paper")
        for shift in (0.0, 1.0)
    ],
}
FIG6B = {
    "steps": [0, 1, 2, 3],
    "panels": [
        {
            "setting": setting,
            "lines": [
                {"shift": shift, "belief": belief, **band([0.7, 0.5 + 0.1 * shift, 0.4, 0.3])}
                for shift in (0.0, 1.0)
                for belief in ("updated", "frozen")
            ],
        }
        for setting in ("paper", "released", "calibrated")
    ],
}
AUC = {
    "steps": [0, 1, 2],
    "lines": [{"setting": "calibrated", **band([0.5, 0.6, 0.7])}, {"setting": "evidence", **band([0.6, 0.7, 0.8])}],
}
EFFECTS = {
    "groups": [
        {"title": "Shift 0", "rows": [{"name": "+ w", **interval(3.0, 1.0)}, {"name": "sTDE", **interval(-1.0, 2.0)}]},
        {"title": "Shift 1", "rows": [{"name": "+ w", **interval(-4.0, 1.5)}]},
    ]
}
DRAWN = {
    figures.similarity_figure: FIG4,
    figures.gain_figure: FIG5,
    figures.epsilon_figure: FIG6A,
    figures.gap_figure: FIG6B,
    figures.auc_figure: AUC,
    figures.effects_figure: EFFECTS,
}


def lines(axes):
    """Data [T, 2] of every line with markers, in the order drawn."""
    return [line.get_xydata() for line in axes.get_lines() if line.get_marker() != "None"]


def bands(axes):
    """(low, high) of every band, in the order drawn."""
    polygons = [artist for artist in axes.collections if isinstance(artist, FillBetweenPolyCollection)]
    return [artist.get_datalim(axes.transData).get_points()[:, 1] for artist in polygons]


def assert_line(axes, index, x, line):
    np.testing.assert_allclose(lines(axes)[index], np.stack([x, line["mean"]], axis=1))
    np.testing.assert_allclose(bands(axes)[index], [min(line["low"]), max(line["high"])])


def keys(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_similarity_points_sizes_and_means(monkeypatch):
    monkeypatch.setattr(figures, "BINS", 2)
    own = figures.similarity_figure(FIG4).axes[0]
    (points,) = own.collections
    np.testing.assert_allclose(points.get_offsets(), [[0.9, 100], [0.1, 25], [0.5, 50], [0.3, 75]])
    # Areas are in the ratio of the episodes, 4 : 8 : 2 : 4.
    np.testing.assert_allclose(points.get_sizes(), figures.MAX_AREA * np.array([0.5, 1.0, 0.25, 0.5]))
    # Halves by similarity, weighted by episodes: (0.1 * 8 + 0.3 * 4) / 12 = 1/6 and (25 * 8 + 75 * 4) / 12 = 125/3;
    # (0.5 * 2 + 0.9 * 4) / 6 = 23/30 and (50 * 2 + 100 * 4) / 6 = 250/3.
    np.testing.assert_allclose(lines(own)[0], [[1 / 6, 125 / 3], [23 / 30, 250 / 3]])
    assert (own.get_xlabel(), own.get_ylabel()) == ("Layout similarity (cosine)", "SR (%)")
    title = own.get_title(loc="left").split("\n")
    assert title == ["Shift 0", "Pearson r 0.50 [0.40, 0.60]", "Spearman r −0.25 [−0.75, 0.25]"]  # noqa: RUF001


def test_gain_is_sorted_by_similarity():
    above, below = figures.gain_figure(FIG5).axes
    assert [bar.get_height() for bar in above.patches] == [40, 50, 70]
    np.testing.assert_allclose(lines(below)[0], [[0, 6], [1, 1], [2, -2]])
    assert [text.get_text() for text in below.get_xticklabels()] == ["Book 0.40", "Pan 0.60", "Sink 0.80"]
    assert (above.get_ylabel(), below.get_ylabel()) == ("Baseline SR (%)", "Gain (SR points)")
    title = above.get_title(loc="left")
    assert "+ w + sTDE" in title
    assert "−2.0 [−2.5, −1.5] points per 0.1 of similarity" in title  # noqa: RUF001


def test_epsilon_has_a_row_per_form_and_a_column_per_metric():
    figure = figures.epsilon_figure(FIG6A)
    axes = np.reshape(figure.axes, (2, 3))
    for i, line in enumerate(FIG6A["lines"]):
        for own, name in zip(axes[i // 2], ("sr", "spl", "dts"), strict=True):
            assert_line(own, i % 2, FIG6A["epsilon"], line[name])
            thin = [drawn.get_ydata() for drawn in own.get_lines() if drawn.get_marker() == "None"]
            np.testing.assert_allclose(thin[2 * (i % 2) : 2 * (i % 2) + 2], line[name]["seeds"])
    assert [own.get_ylabel() for own in axes[0]] == ["SR (%)", "SPL (%)", "DTS (m)"]
    assert keys(figure) == ["shift 0", "shift 1", "one training seed"]


def test_gap_has_a_panel_per_setting():
    figure = figures.gap_figure(FIG6B)
    assert [own.get_title(loc="left") for own in figure.axes] == [
        "Setting paper",
        "Setting released",
        "Setting calibrated",
    ]
    for own, panel in zip(figure.axes, FIG6B["panels"], strict=True):
        for i, line in enumerate(panel["lines"]):
            assert_line(own, i, FIG6B["steps"], line)
        drawn = [line for line in own.get_lines() if line.get_marker() != "None"]
        assert [line.get_linestyle() for line in drawn] == ["-", "--", "-", "--"]  # updated, frozen
        assert drawn[0].get_marker() == drawn[1].get_marker() != drawn[2].get_marker() == drawn[3].get_marker()
        assert list(own.get_lines()[0].get_ydata()) == [0.5, 0.5]
    assert keys(figure)[:2] == ["shift 0, belief updated", "shift 0, belief frozen"]


def test_auc_has_a_line_per_setting_and_chance():
    figure = figures.auc_figure(AUC)
    (own,) = figure.axes
    for i, line in enumerate(AUC["lines"]):
        assert_line(own, i, AUC["steps"], line)
    assert list(own.get_lines()[0].get_ydata()) == [0.5, 0.5]
    assert keys(figure) == ["calibrated", "evidence", "chance"]
    assert own.get_xlabel() == "Step"


def test_effects_are_filled_where_the_interval_excludes_0():
    first, second = figures.effects_figure(EFFECTS).axes
    np.testing.assert_allclose(np.concatenate(lines(first)), [[3, 0], [-1, 1]])
    drawn = [(segment[0][0], segment[1][0]) for artist in first.collections for segment in artist.get_segments()]
    assert drawn == [(2, 4), (-3, 1)]
    filled = [line.get_markerfacecolor() != "white" for own in (first, second) for line in own.get_lines()[1:]]
    assert filled == [True, False, True]
    assert [text.get_text() for text in first.get_yticklabels()] == ["+ w", "sTDE"]
    assert first.yaxis_inverted()  # the first row is on top
    assert first.texts[0].get_text() == "+3.0 [+2.0, +4.0]"
    assert second.get_xlabel().startswith("Difference in SR (points)")


@pytest.mark.parametrize("draw", DRAWN, ids=lambda draw: draw.__name__)
def test_equal_data_gives_equal_bytes(draw, tmp_path):
    data = copy.deepcopy(DRAWN[draw])
    figure = draw(data)
    assert data == DRAWN[draw]
    paths = [tmp_path / "new" / name for name in ("a.png", "b.png", "c.png")]
    figures.save(figure, paths[0])
    figures.save(figure, paths[1])
    figures.save(draw(data), paths[2])
    assert len({path.read_bytes() for path in paths}) == 1
    with Image.open(paths[0]) as png:
        assert png.width == figures.WIDTH * figures.DPI
        assert not png.text


@pytest.mark.parametrize("draw", DRAWN, ids=lambda draw: draw.__name__)
def test_all_text_is_inside_the_figure(draw):
    figure = draw(DRAWN[draw])
    box = figure.get_tightbbox()  # inches
    assert box.x0 >= 0
    assert box.y0 >= 0
    assert box.x1 <= figures.WIDTH
    assert box.y1 <= figure.get_figheight()


def test_neighbouring_styles_differ_in_grey():
    rgb = [[int(style["color"][i : i + 2], 16) for i in (1, 3, 5)] for style in figures.STYLES]
    grey = np.array(rgb) @ (0.299, 0.587, 0.114)
    assert (np.abs(np.diff(grey[:4])) > 35).all()
    assert len({style["marker"] for style in figures.STYLES}) == len(figures.STYLES)
