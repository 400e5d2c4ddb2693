"""Figures of the study; bands are 95 % intervals."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure

from jaxnav.causal import Form
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.curves import AucPanel, Belief, Curve, GapCourse
from jaxnav.study.records import GainBySimilarity, Metric, SuccessBySimilarity
from jaxnav.study.style import (
    BAR,
    LEVEL,
    MEAN,
    POINT,
    SEED,
    STYLES,
    add_legend,
    draw_band,
    interval_text,
    legend_key,
)
from jaxnav.viz.figure import fix_placement, grid, set_title
from jaxnav.viz.plan import INK, PALE

MAX_AREA = 60.0  # points^2, of the marker with the most episodes
BINS = 6  # in the similarity figure, of equal numbers of points
_METRICS: Mapping[Metric, str] = {"sr": "SR (%)", "spl": "SPL (%)", "dts": "DTS (m)"}
_BELIEFS: Mapping[Belief, dict[str, Any]] = {"updated": {"ls": "-"}, "frozen": {"ls": "--", "mfc": "white"}}


class Measured(Protocol):
    """A row of a table."""

    def metric(self, name: Metric) -> Interval:
        """Return one of the metrics."""
        ...


def similarity_figure(by_shift: Mapping[float, SuccessBySimilarity]) -> Figure:
    """Draw SR against layout similarity (paper's Fig. 4).

    There is a point per goal category and scene, and a panel per shift.
    """
    figure, panels = grid(1, len(by_shift), height=3.4, sharex=True, sharey=True)
    most = max(points.episodes.max() for points in by_shift.values())
    for axes, (shift, points) in zip(panels[0], by_shift.items(), strict=True):
        x, y, weight = points.similarity, points.success, points.episodes
        axes.scatter(x, 100 * y, s=MAX_AREA * weight / most, color=POINT, alpha=0.22, lw=0)
        bins = [part for part in np.array_split(np.argsort(x), BINS) if len(part)]
        centres, means = ([np.average(values[part], weights=weight[part]) for part in bins] for values in (x, 100 * y))
        axes.plot(centres, means, **MEAN)
        pearson, spearman = (interval_text(r, ".2f") for r in (points.pearson, points.spearman))
        set_title(axes, f"Shift {shift:g}", f"Pearson r {pearson}", f"Spearman r {spearman}")
        axes.set(xlabel="Layout similarity (cosine)", ylim=(-6, 106))
    panels[0, 0].set_ylabel("SR (%)")
    point = legend_key("category in a scene, area: episodes", {"color": POINT, "marker": "o", "ls": "", "alpha": 0.5})
    add_legend(figure, [point, legend_key(f"mean of each 1/{BINS} of the points", MEAN)])
    return fix_placement(figure)


def gain_figure(by_shift: Mapping[float, GainBySimilarity], variant: str) -> Figure:
    """Draw baseline SR and a variant's gain (paper's Fig. 5).

    They are per category, in order of layout similarity, with a pair of panels per shift.
    """
    figure, panels = grid(2 * len(by_shift), 1, height=4.4 * len(by_shift))
    reach = 1.15 * max(1.0, *(np.abs(gains.gain).max() for gains in by_shift.values()))
    for (shift, gains), (above, below) in zip(by_shift.items(), panels.reshape(-1, 2), strict=True):
        order = np.argsort(gains.similarity, kind="stable")
        x = np.arange(len(order))
        above.bar(x, gains.baseline[order], 0.7, color=BAR)
        above.set(ylabel="Baseline SR (%)", ylim=(0, 100), xticks=x, xticklabels=[])
        set_title(
            above,
            f"Shift {shift:g}: gain of {variant} over the baseline",
            f"Slope: {interval_text(gains.slope, '+.1f')} points per 0.1 of similarity; "
            f"Pearson r = {interval_text(gains.pearson, '.2f')}",
        )
        below.axhline(0, color=INK, lw=0.8)
        below.vlines(x, 0, gains.gain[order], color=POINT, lw=1.6)
        below.plot(x, gains.gain[order], "o", color=POINT, ms=5)
        names = [f"{gains.categories[i]} {gains.similarity[i]:.2f}" for i in order]
        below.set_xticks(x, names, rotation=90)
        below.set(ylabel="Gain (SR points)", ylim=(-reach, reach))
        below.set_xlabel("Goal category and its mean layout similarity (cosine), lowest first")
        for axes in (above, below):
            axes.set_xlim(-0.7, len(x) - 0.3)
    return fix_placement(figure)


def epsilon_figure(sweeps: Mapping[tuple[float, Form], Mapping[float, Measured]]) -> Figure:
    """Draw the metrics over epsilon (paper's Fig. 6a).

    There is a line per shift, and a row of panels per form.

    Args:
      sweeps: by shift and form, rows of sTDE by epsilon, rising.
    """
    forms = list(dict.fromkeys(form for _, form in sweeps))
    shifts = sorted({shift for shift, _ in sweeps})
    figure, panels = grid(len(forms), len(_METRICS), height=2.3 * len(forms) + 0.4, sharey="col")
    for (shift, form), by_epsilon in sweeps.items():
        style, epsilons = STYLES[shifts.index(shift)], list(by_epsilon)
        for axes, metric in zip(panels[forms.index(form)], _METRICS, strict=True):
            estimates = [row.metric(metric) for row in by_epsilon.values()]
            axes.plot(epsilons, [estimate.seeds for estimate in estimates], color=style["color"], **SEED)
            draw_band(axes, epsilons, Curve.of(estimates), style)
    for form, row in zip(forms, panels, strict=True):
        for axes, label in zip(row, _METRICS.values(), strict=True):
            axes.set(ylabel=label, xlabel="Threshold ε")
        set_title(row[0], f"{form.capitalize()} form")
    keys = [legend_key(f"shift {shift:g}", style) for shift, style in zip(shifts, STYLES, strict=False)]
    add_legend(figure, [*keys, legend_key("one training seed", {"color": PALE, **SEED})])
    return fix_placement(figure)


def gap_figure(course: GapCourse) -> Figure:
    """Draw the mean layout gap by step (paper's Fig. 6b).

    There is a panel per setting, with the belief updated or frozen.
    """
    rows, columns = (len(course.panels) + 1) // 2, min(2, len(course.panels))
    figure, panels = grid(rows, columns, height=2.3 * rows + 0.4, sharey=True)
    shifts = sorted({line.shift for panel in course.panels for line in panel.lines})

    def style(shift: float, belief: Belief) -> dict[str, Any]:
        return STYLES[shifts.index(shift)] | _BELIEFS[belief]

    for axes, panel in zip(panels.flat, course.panels, strict=False):
        axes.axhline(0.5, **LEVEL)
        for line in panel.lines:
            draw_band(axes, course.steps, line.curve, style(line.shift, line.belief))
        axes.set(ylim=(-0.02, 1.02), xlabel="Step")
        set_title(axes, f"Setting {panel.setting}")
        axes.set_ylabel("Mean layout gap D" if axes in panels[:, 0] else "")
    for axes in panels.flat[len(course.panels) :]:
        axes.remove()
    keys = [
        legend_key(f"shift {shift:g}, belief {belief}", style(shift, belief)) for shift in shifts for belief in _BELIEFS
    ]
    add_legend(figure, [*keys, legend_key("ε = 0.5", LEVEL)])
    return fix_placement(figure)


def auc_figure(steps: Sequence[int], panel: AucPanel) -> Figure:
    """Draw the AUC of the gap by step and setting."""
    figure, panels = grid(1, 1, height=3.6)
    axes = panels[0, 0]
    axes.axhline(0.5, **LEVEL)
    axes.set(xlabel="Step", ylabel="AUC of the gap, shifted against unshifted")
    for line, style in zip(panel.lines, STYLES, strict=False):
        draw_band(axes, steps, line.curve, style)
    keys = [legend_key(line.setting, style) for line, style in zip(panel.lines, STYLES, strict=False)]
    add_legend(figure, [*keys, legend_key("chance", LEVEL)])
    return fix_placement(figure)


def effects_figure(groups: Mapping[str, Mapping[str, Interval]]) -> Figure:
    """Draw differences in SR with their intervals.

    Markers are filled where the interval excludes 0.

    Args:
      groups: effects in points, by title of the panel and name.
    """
    heights = [len(effects) + 1 for effects in groups.values()]
    figure, panels = grid(len(groups), 1, height=0.26 * sum(heights) + 0.6, sharex=True, height_ratios=heights)
    for axes, (title, effects) in zip(panels[:, 0], groups.items(), strict=True):
        axes.axvline(0, color=INK, lw=0.8)
        for y, effect in enumerate(effects.values()):
            axes.hlines(y, effect.low, effect.high, color=POINT, lw=1.8)
            filled = effect.low > 0 or effect.high < 0
            axes.plot(effect.mean, y, "o", color=POINT, ms=5.5, mfc=POINT if filled else "white")
            text = interval_text(effect, "+.1f")
            axes.text(1.02, y, text, color=INK, fontsize=8, va="center", transform=axes.get_yaxis_transform())
        axes.set_yticks(range(len(effects)), list(effects))
        axes.set_ylim(len(effects) - 0.4, -0.6)
        set_title(axes, title)
    panels[-1, 0].set_xlabel("Difference in SR (points); filled: the 95 % interval excludes 0")
    return fix_placement(figure)
