"""Charts as SVG: of the page's colours and font, and of the numbers they are given."""

import re
from xml.etree import ElementTree

import pytest
from matplotlib.figure import Figure

from jaxnav.report.charts import thresholds_chart, to_svg

REPORT = {
    "rows": [
        {"variant": variant, "decoding": decoding, "epsilon": epsilon, "form": "residual"}
        | {
            metric: {"mean": 10.0 + epsilon, "ci95": [5.0, 20.0], "seeds": [9.0, 11.0]}
            for metric in ("sr", "spl", "dts")
        }
        for variant, decoding, epsilon in (
            ("stde", "argmax", 0.0),
            ("stde", "argmax", 0.5),
            ("stde", "sample", 0.25),
            ("layout", "argmax", 0.75),
        )
    ]
}


@pytest.fixture
def figure():
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0, 1], color="#0072B2")
    axes.set_title("a < b & c", color="#333333")
    return figure


def test_an_svg_is_well_formed_and_its_text_is_text(figure):
    root = ElementTree.fromstring(to_svg(figure))
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert "a < b & c" in texts


def test_an_svg_takes_colours_and_font_from_the_page(figure):
    svg = to_svg(figure)
    assert "var(--blue)" in svg
    assert "var(--ink)" in svg
    assert not re.search("0072b2|333333|font-family|DejaVu|<style", svg, re.IGNORECASE)


def test_an_svg_depends_on_the_figure_alone(figure):
    assert to_svg(figure) == to_svg(figure)


def test_the_curve_has_the_thresholds_of_best_actions(monkeypatch):
    drawn = {}
    monkeypatch.setattr("jaxnav.report.charts.epsilon_figure", lambda sweeps: drawn.update(sweeps) or Figure())
    thresholds_chart({1.0: REPORT})
    sweep = drawn[1.0, "residual"]
    assert {epsilon: row.metric("spl").mean for epsilon, row in sweep.items()} == {0.0: 10.0, 0.5: 10.5}
    assert sweep[0.5].metric("sr").seeds == (9.0, 11.0)
