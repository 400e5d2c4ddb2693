"""Charts as SVG: of the page's colours and font, and of the numbers that they are given."""

import re
from xml.etree import ElementTree

import pytest
from matplotlib.figure import Figure

from jaxnav.report.charts import thresholds_chart, to_svg


def report_row(variant, decoding, epsilon):
    """A row of a report whose means are 10 + epsilon."""
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
