"""Figure of a sweep: SR and SPL over the threshold of sTDE, and their differences to no removal."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxnav.evaluation.statistics import Interval
from jaxnav.policies.methods import method_label
from jaxnav.runs.sweep import Sweep
from jaxnav.viz.style import (
    MUTED_COLOR,
    TEXT_COLOR,
    default_style,
    freeze_axes_positions,
    make_panels,
    repeat_styles,
    set_panel_title,
)

# Styles of the layout shifts; neighbours differ in lightness, marker and dash.
_SHIFT_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "marker": "o", "ls": "-"},
    {"color": "#D55E00", "marker": "^", "ls": "--"},
    {"color": "#009E73", "marker": "s", "ls": "-."},
    {"color": "#CC79A7", "marker": "D", "ls": ":"},
    {"color": "#56B4E9", "marker": "v", "ls": "-"},
)
_METRIC_TITLES = {"sr": "SR", "spl": "SPL"}


@default_style
def sweep_figure(sweeps: Sweep | Sequence[Sweep], title: str | None = None) -> Figure:
    """Draw SR and SPL over the threshold, with a curve for each layout shift.

    The upper panels show the means on axes that start at 0, with a thin line for each training seed. The lower panels
    show the differences to no removal, paired on episodes. Bands are 95 % intervals, see `Sweep.notes`.

    Args:
      sweeps: results of `jaxnav.sweep`, one for each layout shift.
      title: title of the figure; None for method, source and episodes.
    """
    sweeps = [sweeps] if isinstance(sweeps, Sweep) else list(sweeps)
    figure, panels = make_panels(2, 2, height=5.2, sharex=True)

    max_percent = 0.0
    for sweep, style in zip(sweeps, repeat_styles(_SHIFT_STYLES, len(sweeps)), strict=True):
        # Rows in rising order of their thresholds; no removal is no point of the curve.
        row_by_threshold = {row.epsilon: row for row in sweep.rows() if row.epsilon is not None}
        thresholds = sorted(row_by_threshold)
        rows = [row_by_threshold[threshold] for threshold in thresholds]
        for column, metric in enumerate(_METRIC_TITLES):
            intervals = [row.metrics[metric] for row in rows]
            if len(intervals[0].seeds) > 1:
                seed_means = [interval.seeds for interval in intervals]
                panels[0, column].plot(thresholds, seed_means, color=style["color"], lw=0.6, alpha=0.5)
            _draw_curve(panels[0, column], thresholds, intervals, style)
            _draw_curve(panels[1, column], thresholds, [row.changes[metric] for row in rows], style)
            max_percent = max(max_percent, *(_upper_bound(interval) for interval in intervals))

    # Percent from 0, equally for both metrics; differences around 0, with at least one point on either side.
    change_limit = max(1.0, *(abs(limit) for axes in panels[1] for limit in axes.get_ylim()))
    for axes, metric_title in zip(panels[0], _METRIC_TITLES.values(), strict=True):
        axes.set(ylabel=f"{metric_title} (%)", ylim=(0, min(102.0, 1.1 * max_percent + 1.0)))
    for axes, metric_title in zip(panels[1], _METRIC_TITLES.values(), strict=True):
        axes.axhline(0, color=TEXT_COLOR, lw=0.8, zorder=0)
        axes.set(ylabel=f"change in {metric_title} (points)", ylim=(-change_limit, change_limit))
        axes.set_xlabel("threshold ε of sTDE; no removal from 1 on")
    set_panel_title(panels[0, 0], _describe_evaluation(sweeps[0]) if title is None else title)
    set_panel_title(panels[1, 0], "Difference to no removal, paired on episodes")

    _add_legend(figure, sweeps)
    return freeze_axes_positions(figure)


def _draw_curve(axes: Axes, thresholds: Sequence[float], intervals: Sequence[Interval], style: dict[str, Any]) -> None:
    """Draw means with their band; intervals without bounds have no band."""
    axes.plot(thresholds, [interval.mean for interval in intervals], lw=1.4, ms=3.5, **style)
    if all(interval.has_bounds for interval in intervals):
        low = [interval.low for interval in intervals]
        high = [interval.high for interval in intervals]
        axes.fill_between(thresholds, low, high, color=style["color"], alpha=0.15, lw=0)


def _upper_bound(interval: Interval) -> float:
    return max(interval.mean, *interval.seeds, interval.high if interval.has_bounds else 0.0)


def _describe_evaluation(sweep: Sweep) -> str:
    """Method, source and episodes, for a title."""
    settings = sweep.settings
    decoding = {"argmax": "best actions", "sample": "sampled actions"}[settings["decoding"]]
    source_name = Path(settings["source"]).name
    episodes = f"{settings['episodes']:,} {settings['split']} episodes"
    return f"{method_label(settings['method'])}, {source_name}: {episodes}, {decoding}"


def _add_legend(figure: Figure, sweeps: Sequence[Sweep]) -> None:
    handles: list[Artist] = []
    for sweep, style in zip(sweeps, repeat_styles(_SHIFT_STYLES, len(sweeps)), strict=True):
        handles.append(Line2D([], [], label=f"shift {sweep.settings['shift']:g}", lw=1.4, ms=4, **style))
    if sweeps[0].sr.shape[1] > 1:
        handles.append(Line2D([], [], label="one training seed", color=MUTED_COLOR, lw=0.6))

    # The first sentence of the first note states what the bands cover, or that there are none.
    band_label = sweeps[0].notes()[0].partition(".")[0]
    handles.append(Patch(label=band_label, color=MUTED_COLOR, alpha=0.3, lw=0))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
