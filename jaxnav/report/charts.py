"""The charts of the report's page: figures as SVG whose colors and font follow the page."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from jaxnav.choices import Form
from jaxnav.evaluation.report import ExperienceLead, difference_label
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.figures import effects_figure, epsilon_figure
from jaxnav.report.page import Chart
from jaxnav.viz.style import default_style

#: Variables of the page's style sheet, by the colors of the figures.
_PAGE_COLORS = {
    "#333333": "ink",
    "#1a1a1a": "ink",
    "#8a8a8a": "pale",
    "#0072b2": "blue",
    "#d55e00": "orange",
    "#56b4e9": "sky",
    "#cc79a7": "pink",
    "#ffffff": "paper",
}


def thresholds_chart(reports: Mapping[float, Mapping[str, Any]]) -> Chart:
    """Draw the metrics over the threshold of sTDE.

    Args:
      reports: reports of evaluations, by shift.
    """
    # Metrics of sTDE with best actions, by shift and form of the gap, then by threshold.
    sweeps: dict[tuple[float, Form], dict[float, dict[str, Interval]]] = {}
    for shift, report in reports.items():
        for report_row in report["rows"]:
            if (report_row["variant"], report_row["decoding"]) == ("stde", "argmax"):
                metrics = {name: Interval.from_json(report_row[name]) for name in ("sr", "spl", "dts")}
                sweeps.setdefault((shift, report_row["form"]), {})[report_row["epsilon"]] = metrics
    return Chart(to_svg(epsilon_figure(sweeps)), "SR, SPL and DTS by threshold, best actions.")


def leads_chart(accounts: Mapping[float, Sequence[ExperienceLead]]) -> Chart:
    """Draw the leads in success over layout-blind agents.

    Args:
      accounts: leads of a run, by shift.
    """
    # One group for each shift: leads in success with best actions, by row of the report.
    leads_by_shift = {}
    for shift, leads in accounts.items():
        lead_by_variant: dict[str, Interval] = {}
        for lead in leads:
            if (lead.metric, lead.decoding) == ("sr", "argmax"):
                lead_by_variant[lead.variant] = lead.lead
        leads_by_shift[f"Shift {shift:g}"] = lead_by_variant
    return Chart(to_svg(effects_figure(leads_by_shift)), "Lead in success over layout-blind agents, best actions.")


def differences_chart(reports: Mapping[float, Mapping[str, Any]]) -> Chart:
    """Draw the paired differences in success, with best actions.

    Args:
      reports: reports of evaluations, by shift.
    """
    # One group for each shift; the other metrics and sampled actions stand in the tables only.
    differences_by_shift = {}
    for shift, report in reports.items():
        differences: dict[str, Interval] = {}
        for entry in report["differences"]:
            if (entry["metric"], entry["decoding"]) == ("sr", "argmax"):
                differences[difference_label(entry)] = Interval.from_json(entry)
        differences_by_shift[f"Shift {shift:g}"] = differences
    return Chart(to_svg(effects_figure(differences_by_shift)), "Paired differences in success, best actions.")


@default_style
def to_svg(figure: Figure) -> str:
    """Return a figure as an SVG element.

    The bytes depend on the figure alone. Text is text in the page's font, and colors are variables of the page.
    """
    # Without the date, the version and random ids, equal figures give equal bytes.
    svg_file = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxnav"}):
        figure.savefig(svg_file, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg_text = svg_file.getvalue()

    # Keep the element alone, without ids, which all figures share, and without a style, which would be the page's.
    svg_text = svg_text[svg_text.index("<svg") :]
    svg_text = re.sub(r"<metadata>.*?</metadata>", "", svg_text, flags=re.DOTALL)
    svg_text = re.sub(r' id="\w+_\d+"', "", svg_text)
    svg_text = re.sub(r"<style.*?</style>", "", svg_text, flags=re.DOTALL)

    # Take font and colors from the page.
    svg_text = re.sub(r"font-family: [^;]*; ?", "", svg_text)
    for hex_color, css_variable in _PAGE_COLORS.items():
        svg_text = svg_text.replace(hex_color, f"var(--{css_variable})")
    return svg_text
