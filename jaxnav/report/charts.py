"""The charts of a page, as SVG whose colours follow the page."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure

from jaxnav.causal import Form
from jaxnav.evaluation.accounting import Entry
from jaxnav.evaluation.report_tables import difference_label
from jaxnav.evaluation.statistics import Interval
from jaxnav.report.content import Chart
from jaxnav.runs.directory import Run
from jaxnav.study.curves import GapCourse
from jaxnav.study.figures import effects_figure, epsilon_figure, gap_figure, similarity_figure
from jaxnav.study.records import Metric, SuccessBySimilarity
from jaxnav.viz.learning import learning_figure

#: Colours of the figures, as the page names them.
_COLOURS = {
    "#333333": "ink",
    "#1a1a1a": "ink",
    "#8a8a8a": "pale",
    "#0072b2": "blue",
    "#d55e00": "orange",
    "#56b4e9": "sky",
    "#cc79a7": "pink",
    "#ffffff": "paper",
}


class _Row(NamedTuple):
    """Hold a row of an evaluation's report."""

    fields: Mapping[str, Any]

    def metric(self, name: Metric) -> Interval:
        """Return one of the metrics."""
        return Interval.from_json(self.fields[name])


def learning_chart(run: Run) -> Chart:
    """Draw success while training, in training and val scenes."""
    figure = learning_figure(run.log(), run.reach(), run.config.method.upper())
    return Chart(to_svg(figure), "Learning curves: success while training and within a number of actions.")


def thresholds_chart(reports: Mapping[float, Mapping[str, Any]]) -> Chart:
    """Draw the metrics over the threshold of sTDE.

    Args:
      reports: evaluations by shift.
    """
    sweeps: dict[tuple[float, Form], dict[float, _Row]] = {}
    for shift, report in reports.items():
        for row in report["rows"]:
            if (row["variant"], row["decoding"]) == ("stde", "argmax"):
                sweeps.setdefault((shift, row["form"]), {})[row["epsilon"]] = _Row(row)
    return Chart(to_svg(epsilon_figure(sweeps)), "Success, path length and distance by threshold.")


def leads_chart(accounts: Mapping[float, Sequence[Entry]]) -> Chart:
    """Draw the leads in success over agents without experience, by shift."""
    groups = {
        f"Shift {shift:g}": {e.variant: e.lead for e in entries if (e.metric, e.decoding) == ("sr", "argmax")}
        for shift, entries in accounts.items()
    }
    return Chart(to_svg(effects_figure(groups)), "Lead in success over agents that cannot know any layout.")


def differences_chart(reports: Mapping[float, Mapping[str, Any]]) -> Chart:
    """Draw the paired differences in success, by shift."""
    groups = {f"Shift {shift:g}": _differences(report) for shift, report in reports.items()}
    return Chart(to_svg(effects_figure(groups)), "Paired differences in success, best actions.")


def _differences(report: Mapping[str, Any]) -> dict[str, Interval]:
    """Return the differences in success, best actions, by name."""
    entries = [e for e in report["differences"] if (e["metric"], e["decoding"]) == ("sr", "argmax")]
    return {difference_label(entry): Interval.from_json(entry) for entry in entries}


def gap_chart(course: GapCourse) -> Chart:
    """Draw the mean layout gap by step."""
    return Chart(to_svg(gap_figure(course)), "Mean layout gap by step.")


def similarity_chart(by_shift: Mapping[float, SuccessBySimilarity]) -> Chart:
    """Draw success against layout similarity."""
    return Chart(to_svg(similarity_figure(by_shift)), "Success against layout similarity.")


def to_svg(figure: Figure) -> str:
    """Return a figure as an SVG element.

    Its bytes depend on the figure alone. Text is text in the page's font, and colours are variables of the page.
    """
    text = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxnav"}):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' id="\w+_\d+"', "", svg)  # the same in every figure
    svg = re.sub(r"<style.*?</style>", "", svg, flags=re.DOTALL)  # would be the whole page's
    svg = re.sub(r"font-family: [^;]*; ?", "", svg)
    for colour, name in _COLOURS.items():
        svg = svg.replace(colour, f"var(--{name})")
    return svg
