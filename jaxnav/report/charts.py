"""The charts of the report's page: figures as SVG whose colors and font follow the page."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.choices import Form
from jaxnav.evaluation.report import PART_LABELS, ExperienceLead, difference_label
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.figures import effects_figure, epsilon_figure
from jaxnav.report.page import Chart
from jaxnav.viz.learning import ARM_COLORS, learning_figure
from jaxnav.viz.style import default_style, freeze_axes_positions, make_panels, set_panel_title

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

#: Width of a chart, inches: labels of 8 points have 13 pixels where a chart is as wide as the page.
_PAGE_WIDTH = 10.0

#: Color of the points in charts of decision shares.
_SHARE_COLOR = "#0072B2"
#: Opacity of the bands, as in the other figures.
_BAND_OPACITY = 0.16


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

    # Axes that begin at 0 and end at 100 % show differences in their true size.
    figure = epsilon_figure(sweeps)
    for axes in figure.axes:
        axes.set_ylim(bottom=0)
        if axes.get_ylabel().endswith("(%)"):
            axes.set_ylim(top=100)
    return make_chart(figure, "SR, SPL and DTS by threshold, best actions.")


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
    return make_chart(effects_figure(leads_by_shift), "Lead in success over layout-blind agents, best actions.")


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
    return make_chart(effects_figure(differences_by_shift), "Paired differences in success, best actions.")


@default_style
def shares_chart(reports: Mapping[float, Mapping[str, Any]]) -> Chart:
    """Draw the shares of decisions that depend on each of their parts, with best actions.

    Args:
      reports: reports of evaluations with decision shares, by shift.
    """
    # Parts of several rows have the name of their row.
    shares_by_shift: dict[float, dict[str, Interval]] = {}
    variants = {entry["variant"] for report in reports.values() for entry in report["decision_shares"]}
    for shift, report in reports.items():
        shares = shares_by_shift.setdefault(shift, {})
        for entry in report["decision_shares"]:
            if entry["decoding"] == "argmax":
                row_suffix = f", {entry['variant']}" if len(variants) > 1 else ""
                shares[PART_LABELS[entry["part"]] + row_suffix] = Interval.from_json(entry["share"])

    # One panel for each shift, side by side, with equal axes.
    num_parts = len(next(iter(shares_by_shift.values())))
    height = 0.28 * num_parts + 0.9
    figure, panels = make_panels(1, len(shares_by_shift), height=height, sharex=True, sharey=True)
    for axes, (shift, shares) in zip(panels[0], shares_by_shift.items(), strict=True):
        for position, share in enumerate(shares.values()):
            axes.hlines(position, share.low, share.high, color=_SHARE_COLOR, lw=1.8)
            axes.plot(share.mean, position, "o", color=_SHARE_COLOR, ms=5.5, clip_on=False)
        set_panel_title(axes, f"Shift {shift:g}")
        axes.set(xlim=(0, 100), xlabel="Share of decisions (%)")

    # The first part is at the top.
    panels[0, 0].set_yticks(range(num_parts), list(next(iter(shares_by_shift.values()))))
    panels[0, 0].set_ylim(num_parts - 0.4, -0.6)
    return make_chart(figure, "Share of decisions that depend on each part, best actions.")


def learning_chart(
    log_rows: Sequence[Mapping[str, Any]], success_by_budget: Mapping[str, Any] | None, title: str
) -> Chart:
    """Draw success during training, with bands from the worst to the best training run.

    Args:
      log_rows: the training log.
      success_by_budget: success within each budget, see `Run.success_by_budget`; None for no right panel.
      title: title of the figure.
    """
    figure = learning_figure(log_rows, success_by_budget, title)
    _draw_seed_ranges(figure.axes[0], log_rows)
    return make_chart(figure, "Learning curves: success during training, and success within a number of actions.")


def _draw_seed_ranges(axes: Axes, log_rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the range over training runs of success in val episodes with best actions."""
    # Success in percent, by arm and million steps.
    success_by_step: dict[str, dict[float, list[float]]] = {}
    for row in log_rows:
        if row.get("val_success") is not None:
            success_of_arm = success_by_step.setdefault(row["arm"], {})
            success_of_arm.setdefault(row["env_steps"] / 1e6, []).append(100.0 * row["val_success"])

    for arm, success_of_arm in success_by_step.items():
        lowest = [min(values) for values in success_of_arm.values()]
        highest = [max(values) for values in success_of_arm.values()]
        steps = list(success_of_arm)
        axes.fill_between(steps, lowest, highest, color=ARM_COLORS[arm], alpha=_BAND_OPACITY, lw=0)


def make_chart(figure: Figure, caption: str) -> Chart:
    """Return a figure as a chart that is as wide as the page.

    Args:
      figure: figure of any width.
      caption: description in words.
    """
    figure.set_figwidth(_PAGE_WIDTH)
    figure.set_layout_engine("constrained")
    return Chart(to_svg(freeze_axes_positions(figure)), caption)


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
