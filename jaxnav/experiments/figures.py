"""Figures of the pages of experiments.

`FIGURES` draws figures from the result table; the run report uses some of the drawing functions for its own charts.
Bands and bars are 95 % intervals. Lines differ by marker and dash as well as by colour, and colours by lightness, so
that all figures are readable in grey.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.choices import Form
from jaxnav.evaluation.report import METRIC_COLUMNS
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.gap_traces import Belief
from jaxnav.experiments.similarity import GainBySimilarity, SuccessBySimilarity, gain_of_table, success_of_table
from jaxnav.experiments.table import Curve, ResultTable
from jaxnav.experiments.trials import RESIDUAL_HALF, STDE_NAMES, SWEPT_FORMS, Trial
from jaxnav.viz.style import (
    MUTED_COLOR,
    TEXT_COLOR,
    default_style,
    freeze_axes_positions,
    make_panels,
    repeat_styles,
    set_panel_title,
)

_LINE = {"lw": 1.5, "ms": 4.5}
#: Styles of lines; neighbours differ in lightness.
LINE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#1a1a1a", "marker": "o", "ls": "-"} | _LINE,
    {"color": "#D55E00", "marker": "^", "ls": "-."} | _LINE,
    {"color": "#56B4E9", "marker": "s", "ls": "-"} | _LINE,
    {"color": "#0072B2", "marker": "D", "ls": "--"} | _LINE,
    {"color": "#CC79A7", "marker": "v", "ls": (0, (6, 1.5))} | _LINE,
    {"color": "#8a8a8a", "marker": "P", "ls": (0, (3, 1, 1, 1, 1, 1))} | _LINE,
    {"color": "#009E73", "marker": "X", "ls": ":"} | _LINE,
)
REFERENCE_STYLE = {"color": MUTED_COLOR, "lw": 1, "ls": ":"}
SEED_STYLE = {"lw": 0.6, "alpha": 0.6}
MEAN_STYLE = {"color": TEXT_COLOR, "marker": "D", "lw": 1.4, "ms": 4.5, "mec": "white"}
BAR_COLOR = "#a9a9a9"
POINT_COLOR = "#0072B2"
MAX_MARKER_AREA = 60.0  # points^2, of the marker with the most episodes
NUM_BINS = 6  # in the similarity figure, of equal numbers of points
_BELIEF_STYLES: Mapping[Belief, dict[str, Any]] = {"updated": {"ls": "-"}, "frozen": {"ls": "--", "mfc": "white"}}

#: Mean gaps of one estimator, by shift and belief.
GapLines = Mapping[tuple[float, Belief], Curve]


# Figures of a page, from the rows of one run


def _similarity_of_table(table: ResultTable, shifts: Sequence[float], fields: Mapping[str, Any]) -> Figure:
    return similarity_figure({shift: success_of_table(table, **fields, shift=shift) for shift in shifts})


def _gain_of_table(table: ResultTable, shifts: Sequence[float], fields: Mapping[str, Any]) -> Figure:
    trial_fields = {**fields, **Trial("stde", "argmax", *RESIDUAL_HALF).row_fields()}
    gains = {shift: gain_of_table(table, **trial_fields, shift=shift) for shift in (shifts[0], shifts[-1])}
    return gain_figure(gains, "+ w + sTDE")


def _epsilon_of_table(table: ResultTable, shifts: Sequence[float], fields: Mapping[str, Any]) -> Figure:
    # sTDE with best actions, at every threshold that was evaluated.
    sweeps = {}
    for shift, form in itertools.product(shifts, SWEPT_FORMS):
        stde = {**fields, "variant": "stde", "decoding": "argmax", "form": form, "gap": "novelty", "shift": shift}
        thresholds = sorted(table.distinct("epsilon", **stde, metric="sr", reference="", control=""))
        metrics_by_epsilon = {}
        for epsilon in thresholds:
            metrics = {metric: table.find(**stde, epsilon=epsilon, metric=metric) for metric in METRIC_COLUMNS}
            metrics_by_epsilon[epsilon] = metrics
        sweeps[shift, form] = metrics_by_epsilon
    return epsilon_figure(sweeps)


def _gap_of_table(table: ResultTable, shifts: Sequence[float], fields: Mapping[str, Any]) -> Figure:
    # One panel per estimator, with the first and the last shift.
    panels: dict[str, GapLines] = {}
    for setting in table.distinct("variant", **fields, metric="gap"):
        lines = {}
        for shift, belief in itertools.product((shifts[0], shifts[-1]), _BELIEF_STYLES):
            lines[shift, belief] = table.curve(**fields, variant=setting, shift=shift, control=belief, metric="gap")
        panels[setting] = lines
    return gap_figure(panels)


def _auc_of_table(table: ResultTable, shifts: Sequence[float], fields: Mapping[str, Any]) -> Figure:
    auc = {**fields, "shift": shifts[-1], "control": "updated", "metric": "gap auc"}
    settings = table.distinct("variant", **auc)
    return auc_figure({setting: table.curve(**auc, variant=setting) for setting in settings})


def _effects_of_table(table: ResultTable, shifts: Sequence[float], fields: Mapping[str, Any]) -> Figure:
    # Differences of sTDE to the layout weights, with either gap.
    effects_by_shift = {}
    for shift in shifts:
        effects = {}
        for (name, options), gap in itertools.product(STDE_NAMES.items(), ("novelty", "evidence")):
            trial = {**fields, **Trial("stde", "argmax", *options).row_fields(), "shift": shift, "reference": "layout"}
            gap_name = "" if gap == "novelty" else f", {gap}"
            effects[f"+ w + {name}{gap_name}"] = table.find(**trial, gap=gap, metric="sr")
        effects_by_shift[f"shift {shift:g}"] = effects
    return effects_figure(effects_by_shift)


#: Figures of pages, by name: called with the table, the shifts, and the fields of the run.
FIGURES = {
    "fig4": _similarity_of_table,
    "fig5": _gain_of_table,
    "fig6a": _epsilon_of_table,
    "fig6b": _gap_of_table,
    "auc": _auc_of_table,
    "effects": _effects_of_table,
}


# One figure each


@default_style
def similarity_figure(by_shift: Mapping[float, SuccessBySimilarity]) -> Figure:
    """Draw SR against layout similarity (paper's Fig. 4).

    One point per goal category and scene, one panel per shift.
    """
    figure, panels = make_panels(1, len(by_shift), height=3.4, sharex=True, sharey=True)
    max_episodes = max(points.episodes.max() for points in by_shift.values())

    for axes, (shift, points) in zip(panels[0], by_shift.items(), strict=True):
        similarity = points.similarity
        success = 100 * points.success
        episodes = points.episodes
        marker_area = MAX_MARKER_AREA * episodes / max_episodes
        axes.scatter(similarity, success, s=marker_area, color=POINT_COLOR, alpha=0.22, lw=0)

        # Means over bins of equal numbers of points, weighted by episodes.
        bin_centers = []
        bin_means = []
        for members in np.array_split(np.argsort(similarity), NUM_BINS):
            if len(members):
                bin_centers.append(np.average(similarity[members], weights=episodes[members]))
                bin_means.append(np.average(success[members], weights=episodes[members]))
        axes.plot(bin_centers, bin_means, **MEAN_STYLE)

        pearson = interval_text(points.pearson, ".2f")
        spearman = interval_text(points.spearman, ".2f")
        set_panel_title(axes, f"Shift {shift:g}", f"Pearson r {pearson}", f"Spearman r {spearman}")
        axes.set(xlabel="Layout similarity (cosine)", ylim=(-6, 106))

    panels[0, 0].set_ylabel("SR (%)")
    point_style = {"color": POINT_COLOR, "marker": "o", "ls": "", "alpha": 0.5}
    point_key = legend_key("category in a scene, area: episodes", point_style)
    add_legend(figure, [point_key, legend_key(f"mean of each 1/{NUM_BINS} of the points", MEAN_STYLE)])
    return freeze_axes_positions(figure)


@default_style
def gain_figure(by_shift: Mapping[float, GainBySimilarity], variant: str) -> Figure:
    """Draw baseline SR and the gain of a variant per category (paper's Fig. 5).

    Categories are in order of layout similarity, with two panels per shift.
    """
    figure, panels = make_panels(2 * len(by_shift), 1, height=4.4 * len(by_shift))
    max_gain = max(1.0, *(np.abs(gains.gain).max() for gains in by_shift.values()))
    gain_limit = 1.15 * max_gain

    for (shift, gains), (sr_axes, gain_axes) in zip(by_shift.items(), panels.reshape(-1, 2), strict=True):
        order = np.argsort(gains.similarity, kind="stable")
        positions = np.arange(len(order))

        # Above: SR of the baseline.
        sr_axes.bar(positions, gains.baseline[order], 0.7, color=BAR_COLOR)
        sr_axes.set(ylabel="Baseline SR (%)", ylim=(0, 100), xticks=positions, xticklabels=[])
        set_panel_title(
            sr_axes,
            f"Shift {shift:g}: gain of {variant} over the baseline",
            f"Slope: {interval_text(gains.slope, '+.1f')} points per 0.1 of similarity; "
            f"Pearson r = {interval_text(gains.pearson, '.2f')}",
        )

        # Below: gain over the baseline.
        gain_axes.axhline(0, color=TEXT_COLOR, lw=0.8)
        gain_axes.vlines(positions, 0, gains.gain[order], color=POINT_COLOR, lw=1.6)
        gain_axes.plot(positions, gains.gain[order], "o", color=POINT_COLOR, ms=5)
        names = [f"{gains.categories[index]} {gains.similarity[index]:.2f}" for index in order]
        gain_axes.set_xticks(positions, names, rotation=90)
        gain_axes.set(ylabel="Gain (SR points)", ylim=(-gain_limit, gain_limit))
        gain_axes.set_xlabel("Goal category and its mean layout similarity (cosine), lowest first")

        for axes in (sr_axes, gain_axes):
            axes.set_xlim(-0.7, len(positions) - 0.3)
    return freeze_axes_positions(figure)


@default_style
def epsilon_figure(sweeps: Mapping[tuple[float, Form], Mapping[float, Mapping[str, Interval]]]) -> Figure:
    """Draw the metrics over epsilon (paper's Fig. 6a).

    One line per shift, one row of panels per form.

    Args:
      sweeps: metrics of sTDE by epsilon, rising, for each shift and form.
    """
    forms = list(dict.fromkeys(form for _, form in sweeps))
    shifts = sorted({shift for shift, _ in sweeps})
    figure, panels = make_panels(len(forms), len(METRIC_COLUMNS), height=2.3 * len(forms) + 0.4, sharey="col")

    style_by_shift = dict(zip(shifts, repeat_styles(LINE_STYLES, len(shifts)), strict=True))
    for (shift, form), metrics_by_epsilon in sweeps.items():
        style = style_by_shift[shift]
        epsilons = list(metrics_by_epsilon)
        for axes, metric in zip(panels[forms.index(form)], METRIC_COLUMNS, strict=True):
            intervals = [metrics[metric] for metrics in metrics_by_epsilon.values()]
            axes.plot(epsilons, [interval.seeds for interval in intervals], color=style["color"], **SEED_STYLE)
            draw_band(axes, Curve.from_intervals(epsilons, intervals), style)

    for form, row_axes in zip(forms, panels, strict=True):
        for axes, (label, _) in zip(row_axes, METRIC_COLUMNS.values(), strict=True):
            axes.set(ylabel=label, xlabel="Threshold ε")
        set_panel_title(row_axes[0], f"{form.capitalize()} form")

    keys = [legend_key(f"shift {shift:g}", style) for shift, style in style_by_shift.items()]
    add_legend(figure, [*keys, legend_key("one training seed", {"color": MUTED_COLOR, **SEED_STYLE})])
    return freeze_axes_positions(figure)


@default_style
def gap_figure(panels_by_setting: Mapping[str, GapLines]) -> Figure:
    """Draw the mean layout gap by step (paper's Fig. 6b).

    One panel per setting of the estimator, with the belief updated or frozen.
    """
    num_panels = len(panels_by_setting)
    num_rows = (num_panels + 1) // 2
    figure, panels = make_panels(num_rows, min(2, num_panels), height=2.3 * num_rows + 0.4, sharey=True)

    # A colour and marker per shift, a dash per belief.
    shifts = sorted({shift for lines in panels_by_setting.values() for shift, _ in lines})
    styles = {}
    for shift, shift_style in zip(shifts, repeat_styles(LINE_STYLES, len(shifts)), strict=True):
        for belief, belief_style in _BELIEF_STYLES.items():
            styles[shift, belief] = shift_style | belief_style

    for axes, (setting, lines) in zip(panels.flat, panels_by_setting.items(), strict=False):
        axes.axhline(0.5, **REFERENCE_STYLE)
        for (shift, belief), curve in lines.items():
            draw_band(axes, curve, styles[shift, belief])
        axes.set(ylim=(-0.02, 1.02), xlabel="Step")
        set_panel_title(axes, f"Setting {setting}")
        axes.set_ylabel("Mean layout gap D" if axes in panels[:, 0] else "")

    # An odd number of settings leaves one panel empty.
    for axes in panels.flat[num_panels:]:
        axes.remove()

    keys = [legend_key(f"shift {shift:g}, belief {belief}", style) for (shift, belief), style in styles.items()]
    add_legend(figure, [*keys, legend_key("ε = 0.5", REFERENCE_STYLE)])
    return freeze_axes_positions(figure)


@default_style
def auc_figure(curve_by_setting: Mapping[str, Curve]) -> Figure:
    """Draw the AUC of the gap by step, one line per setting."""
    figure, panels = make_panels(1, 1, height=3.6)
    axes = panels[0, 0]
    axes.axhline(0.5, **REFERENCE_STYLE)
    axes.set(xlabel="Step", ylabel="AUC of the gap, shifted against unshifted")

    keys = []
    styles = repeat_styles(LINE_STYLES, len(curve_by_setting))
    for (setting, curve), style in zip(curve_by_setting.items(), styles, strict=True):
        draw_band(axes, curve, style)
        keys.append(legend_key(setting, style))
    add_legend(figure, [*keys, legend_key("chance", REFERENCE_STYLE)])
    return freeze_axes_positions(figure)


@default_style
def effects_figure(groups: Mapping[str, Mapping[str, Interval]]) -> Figure:
    """Draw differences in SR with their intervals.

    Markers are filled where the interval excludes 0.

    Args:
      groups: effects in points by name, for each panel title.
    """
    heights = [len(effects) + 1 for effects in groups.values()]
    figure, panels = make_panels(len(groups), 1, height=0.26 * sum(heights) + 0.6, sharex=True, height_ratios=heights)

    for axes, (title, effects) in zip(panels[:, 0], groups.items(), strict=True):
        axes.axvline(0, color=TEXT_COLOR, lw=0.8)
        for position, effect in enumerate(effects.values()):
            axes.hlines(position, effect.low, effect.high, color=POINT_COLOR, lw=1.8)
            excludes_zero = effect.low > 0 or effect.high < 0
            face_color = POINT_COLOR if excludes_zero else "white"
            axes.plot(effect.mean, position, "o", color=POINT_COLOR, ms=5.5, mfc=face_color)

            # The numbers stand to the right of the axes.
            text = interval_text(effect, "+.1f")
            right_of_axes = axes.get_yaxis_transform()
            axes.text(1.02, position, text, color=TEXT_COLOR, fontsize=8, va="center", transform=right_of_axes)

        # The first effect is at the top.
        axes.set_yticks(range(len(effects)), list(effects))
        axes.set_ylim(len(effects) - 0.4, -0.6)
        set_panel_title(axes, title)

    panels[-1, 0].set_xlabel("Difference in SR (points); filled: the 95 % interval excludes 0")
    return freeze_axes_positions(figure)


# Parts of figures


def draw_band(axes: Axes, curve: Curve, style: dict[str, Any]) -> None:
    """Draw a curve with its band and at most twelve markers."""
    axes.fill_between(curve.positions, curve.low, curve.high, color=style["color"], alpha=0.16, lw=0)
    marker_interval = -(-len(curve.positions) // 12)
    axes.plot(curve.positions, curve.mean, markevery=marker_interval, **style)


def legend_key(label: str, style: dict[str, Any]) -> Line2D:
    """Make an entry of a legend."""
    return Line2D([], [], label=label, **style)


def add_legend(figure: Figure, keys: Sequence[Line2D]) -> None:
    """Add a legend above all axes."""
    num_columns = len(keys) if len(keys) < 5 else 3
    figure.legend(
        handles=keys, loc="outside upper center", ncols=num_columns, fontsize=8, frameon=False, handlelength=3
    )


def interval_text(interval: Interval, number_format: str) -> str:
    """Format an interval with typographic minus signs."""
    return f"{interval:{number_format}}".replace("-", "\N{MINUS SIGN}")
