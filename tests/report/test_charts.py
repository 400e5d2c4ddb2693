"""Tests of the charts as SVG: they use the colours and the font of the page, and draw the given numbers."""

import re
from xml.etree import ElementTree

import pytest
from matplotlib.figure import Figure

from jaxnav.report.charts import learning_chart, make_chart, shares_chart, thresholds_chart, to_svg


def report_row(variant, decoding, epsilon):
    """Row of a report whose means are 10 + epsilon."""
    row = {"variant": variant, "decoding": decoding, "epsilon": epsilon, "form": "residual"}
    for metric in ("sr", "spl", "dts"):
        row[metric] = {"mean": 10.0 + epsilon, "ci95": [5.0, 20.0], "seeds": [9.0, 11.0]}
    return row


REPORT = {
    "rows": [
        report_row("stde", "argmax", 0.0),
        report_row("stde", "argmax", 0.5),
        report_row("stde", "sample", 0.25),
        report_row("layout", "argmax", 0.75),
    ]
}


@pytest.fixture
def figure():
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0, 1], color="#0072B2")
    axes.set_title("a < b & c", color="#333333")
    return figure


def test_to_svg_is_well_formed_and_keeps_text_as_text(figure):
    root = ElementTree.fromstring(to_svg(figure))
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert "a < b & c" in texts


def test_to_svg_takes_colours_and_font_from_the_page(figure):
    svg_text = to_svg(figure)
    assert "var(--blue)" in svg_text
    assert "var(--ink)" in svg_text
    assert not re.search("0072b2|333333|font-family|DejaVu|<style", svg_text, re.IGNORECASE)


def test_to_svg_is_deterministic(figure):
    assert to_svg(figure) == to_svg(figure)


def test_thresholds_chart_draws_the_rows_of_stde_with_argmax(monkeypatch):
    drawn_sweeps = {}
    monkeypatch.setattr("jaxnav.report.charts.epsilon_figure", lambda sweeps: drawn_sweeps.update(sweeps) or Figure())
    thresholds_chart({1.0: REPORT})
    sweep = drawn_sweeps[1.0, "residual"]
    assert {epsilon: metrics["spl"].mean for epsilon, metrics in sweep.items()} == {0.0: 10.0, 0.5: 10.5}
    assert sweep[0.5]["sr"].seeds == (9.0, 11.0)


@pytest.fixture
def drawn_figures(monkeypatch):
    """List of the figures that charts are made of, in order."""
    figures = []
    monkeypatch.setattr("jaxnav.report.charts.to_svg", lambda figure: figures.append(figure) or "")
    return figures


def test_thresholds_chart_shows_rates_on_their_whole_range(drawn_figures):
    thresholds_chart({1.0: REPORT})
    limits = [axes.get_ylim() for axes in drawn_figures[0].axes]
    assert limits[:2] == [(0, 100), (0, 100)]
    assert limits[2][0] == 0


def test_make_chart_lays_out_a_figure_for_the_width_of_the_page(drawn_figures):
    narrow_figure = Figure(figsize=(3, 2), layout="constrained")
    axes = narrow_figure.subplots()
    make_chart(narrow_figure, "caption")
    assert narrow_figure.get_figwidth() == 10
    assert axes.get_position().x1 > 0.97


def test_learning_chart_has_a_band_from_the_worst_to_the_best_run(drawn_figures):
    # Two runs, of which the second one has no success on the validation split at the second step.
    log_rows = []
    for env_steps, successes in ((1_000_000, (0.2, 0.4)), (2_000_000, (0.5, None))):
        for success in successes:
            log_rows.append({"arm": "layout", "env_steps": env_steps, "success": 0.1, "val_success": success})
    learning_chart(log_rows, None, "title")

    # Corners of the band in millions of steps and percent.
    (band,) = drawn_figures[0].axes[0].collections
    corners = {tuple(corner) for corner in band.get_paths()[0].vertices.round(6)}
    assert corners == {(1.0, 20.0), (1.0, 40.0), (2.0, 50.0)}


def test_shares_chart_draws_the_parts_of_decisions_with_best_actions(drawn_figures):
    def share_entry(part, decoding, mean, bounds):
        share = {"mean": mean, "ci95": bounds}
        return {"variant": "layout", "decoding": decoding, "part": part, "share": share}

    entries = [
        share_entry("other_categories", "argmax", 5.0, [-2.0, 12.0]),
        share_entry("memory", "argmax", 40.0, None),
        share_entry("memory", "sample", 90.0, None),
    ]
    report = REPORT | {"decision_shares": entries}
    shares_chart({0.0: report, 1.0: report})

    # The two shares with best actions, one a line; the share with sampled actions is not drawn.
    for axes in drawn_figures[0].axes:
        points = [tuple(map(float, line.get_xydata()[0])) for line in axes.lines]
        assert points == [(5.0, 0.0), (40.0, 1.0)]
        assert axes.get_xlim() == (0, 100)
