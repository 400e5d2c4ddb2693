"""Figures of the study, drawn from its result files.

`draw_study_figures` draws all figures of a folder of results; the run report uses some of the drawing functions for its
own charts. Bands and bars are 95 % intervals. Lines differ by marker and dash as well as by colour, and colours by
lightness, so that all figures are readable in grey.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.document import table_1_rows
from jaxnav.study.records import (
    SWEPT_FORMS,
    AucPanel,
    Belief,
    Condition,
    Curve,
    GainBySimilarity,
    GapCurves,
    StudyMetric,
    SuccessBySimilarity,
)
from jaxnav.study.results import WorldResults, load_study_results
from jaxnav.viz.style import MUTED_COLOR, TEXT_COLOR, freeze_axes_positions, make_panels, save_figure, set_panel_title

_LINE = {"lw": 1.5, "ms": 4.5}
#: Styles of lines; neighbours differ in lightness.
LINE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#1a1a1a", "marker": "o", "ls": "-"} | _LINE,
    {"color": "#D55E00", "marker": "^", "ls": "-."} | _LINE,
    {"color": "#56B4E9", "marker": "s", "ls": "-"} | _LINE,
    {"color": "#0072B2", "marker": "D", "ls": "--"} | _LINE,
    {"color": "#CC79A7", "marker": "v", "ls": (0, (6, 1.5))} | _LINE,
    {"color": "#8a8a8a", "marker": "P", "ls": (0, (3, 1, 1, 1, 1, 1))} | _LINE,
)
REFERENCE_STYLE = {"color": MUTED_COLOR, "lw": 1, "ls": ":"}
SEED_STYLE = {"lw": 0.6, "alpha": 0.6}
MEAN_STYLE = {"color": TEXT_COLOR, "marker": "D", "lw": 1.4, "ms": 4.5, "mec": "white"}
BAR_COLOR = "#a9a9a9"
POINT_COLOR = "#0072B2"
MAX_MARKER_AREA = 60.0  # points^2, of the marker with the most episodes
NUM_BINS = 6  # in the similarity figure, of equal numbers of points
_METRIC_LABELS: Mapping[StudyMetric, str] = {"sr": "SR (%)", "spl": "SPL (%)", "dts": "DTS (m)"}
_BELIEF_STYLES: Mapping[Belief, dict[str, Any]] = {"updated": {"ls": "-"}, "frozen": {"ls": "--", "mfc": "white"}}


class MetricRow(Protocol):
    """A row of results with an interval per metric."""

    def metric(self, name: StudyMetric) -> Interval:
        """One of the metrics."""
        ...


# All figures of a study


def draw_study_figures(folder: Path, images: Path) -> None:
    """Draw the figures of the results in a folder.

    Raises:
      InputError: there are no results.
    """
    results = load_study_results(folder)
    if results is None:
        raise InputError(f"{folder}: holds no results; run the study first")

    images.mkdir(parents=True, exist_ok=True)
    for world, world_results in results.worlds.items():
        for name, figure in _world_figures(world_results).items():
            save_figure(figure, images / f"{world}-{name}.png")


def _world_figures(results: WorldResults) -> dict[str, Figure]:
    """Figures of one world by name, as in `document.FIGURE_CAPTIONS`."""
    conditions = results.conditions
    gap_curves = results.gap_curves
    first_condition = conditions[0]
    last_condition = conditions[-1]

    similarity_by_shift = {condition.shift: condition.similarity for condition in conditions}
    gain_by_shift = {condition.shift: condition.gains.stde for condition in (first_condition, last_condition)}
    effects_by_shift = {f"shift {condition.shift:g}": _stde_effects(condition) for condition in conditions}
    sweeps = {}
    for condition in conditions:
        for form in SWEPT_FORMS:
            sweeps[condition.shift, form] = dict(sorted(condition.rows_by_epsilon(form).items()))

    return {
        "fig4": similarity_figure(similarity_by_shift),
        "fig5": gain_figure(gain_by_shift, "+ w + sTDE"),
        "fig6a": epsilon_figure(sweeps),
        "fig6b": gap_figure(gap_curves.at_shifts(first_condition.shift, last_condition.shift)),
        "auc": auc_figure(gap_curves.steps, gap_curves.auc[-1]),
        "effects": effects_figure(effects_by_shift),
    }


def _stde_effects(condition: Condition) -> dict[str, Interval]:
    """Differences in SR of sTDE to the layout's weights, by name."""
    effects = {}
    for name, row in table_1_rows(condition):
        is_stde = row.trial.variant == "stde" and row.trial.control is None
        if is_stde and row.difference is not None:
            effects[name.replace("`", "")] = row.difference.sr
    return effects


# One figure each


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


def epsilon_figure(sweeps: Mapping[tuple[float, Form], Mapping[float, MetricRow]]) -> Figure:
    """Draw the metrics over epsilon (paper's Fig. 6a).

    One line per shift, one row of panels per form.

    Args:
      sweeps: rows of sTDE by epsilon, rising, for each shift and form.
    """
    forms = list(dict.fromkeys(form for _, form in sweeps))
    shifts = sorted({shift for shift, _ in sweeps})
    figure, panels = make_panels(len(forms), len(_METRIC_LABELS), height=2.3 * len(forms) + 0.4, sharey="col")

    for (shift, form), row_by_epsilon in sweeps.items():
        style = LINE_STYLES[shifts.index(shift)]
        epsilons = list(row_by_epsilon)
        for axes, metric in zip(panels[forms.index(form)], _METRIC_LABELS, strict=True):
            intervals = [row.metric(metric) for row in row_by_epsilon.values()]
            axes.plot(epsilons, [interval.seeds for interval in intervals], color=style["color"], **SEED_STYLE)
            draw_band(axes, epsilons, Curve.from_intervals(intervals), style)

    for form, row_axes in zip(forms, panels, strict=True):
        for axes, label in zip(row_axes, _METRIC_LABELS.values(), strict=True):
            axes.set(ylabel=label, xlabel="Threshold ε")
        set_panel_title(row_axes[0], f"{form.capitalize()} form")

    keys = [legend_key(f"shift {shift:g}", style) for shift, style in zip(shifts, LINE_STYLES, strict=False)]
    add_legend(figure, [*keys, legend_key("one training seed", {"color": MUTED_COLOR, **SEED_STYLE})])
    return freeze_axes_positions(figure)


def gap_figure(gap_curves: GapCurves) -> Figure:
    """Draw the mean layout gap by step (paper's Fig. 6b).

    One panel per setting, with the belief updated or frozen.
    """
    num_panels = len(gap_curves.panels)
    num_rows = (num_panels + 1) // 2
    figure, panels = make_panels(num_rows, min(2, num_panels), height=2.3 * num_rows + 0.4, sharey=True)

    # A colour and marker per shift, a dash per belief.
    shifts = sorted({line.shift for panel in gap_curves.panels for line in panel.lines})
    styles = {}
    for shift, shift_style in zip(shifts, LINE_STYLES, strict=False):
        for belief, belief_style in _BELIEF_STYLES.items():
            styles[shift, belief] = shift_style | belief_style

    for axes, panel in zip(panels.flat, gap_curves.panels, strict=False):
        axes.axhline(0.5, **REFERENCE_STYLE)
        for line in panel.lines:
            draw_band(axes, gap_curves.steps, line.curve, styles[line.shift, line.belief])
        axes.set(ylim=(-0.02, 1.02), xlabel="Step")
        set_panel_title(axes, f"Setting {panel.setting}")
        axes.set_ylabel("Mean layout gap D" if axes in panels[:, 0] else "")

    # An odd number of settings leaves one panel empty.
    for axes in panels.flat[num_panels:]:
        axes.remove()

    keys = [legend_key(f"shift {shift:g}, belief {belief}", style) for (shift, belief), style in styles.items()]
    add_legend(figure, [*keys, legend_key("ε = 0.5", REFERENCE_STYLE)])
    return freeze_axes_positions(figure)


def auc_figure(steps: Sequence[int], panel: AucPanel) -> Figure:
    """Draw the AUC of the gap by step, one line per setting."""
    figure, panels = make_panels(1, 1, height=3.6)
    axes = panels[0, 0]
    axes.axhline(0.5, **REFERENCE_STYLE)
    axes.set(xlabel="Step", ylabel="AUC of the gap, shifted against unshifted")

    keys = []
    for line, style in zip(panel.lines, LINE_STYLES, strict=False):
        draw_band(axes, steps, line.curve, style)
        keys.append(legend_key(line.setting, style))
    add_legend(figure, [*keys, legend_key("chance", REFERENCE_STYLE)])
    return freeze_axes_positions(figure)


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


def draw_band(axes: Axes, steps: Sequence[float], curve: Curve, style: dict[str, Any]) -> None:
    """Draw a curve with its band and at most twelve markers."""
    axes.fill_between(steps, curve.low, curve.high, color=style["color"], alpha=0.16, lw=0)
    marker_interval = -(-len(steps) // 12)
    axes.plot(steps, curve.mean, markevery=marker_interval, **style)


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
