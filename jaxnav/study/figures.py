"""Figures of the study: each takes what the results' JSON holds and returns a Matplotlib figure.

Lines differ by marker and dash as well as by colour, and colours by lightness, so all can be read in grey. Success
rates (SR), SPL, gains and differences are in percent or percentage points unless stated, DTS in metres. An interval is
`{"mean": float, "ci95": [low, high]}`; bands and error bars are 95 % intervals.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.store.files import write_atomic
from jaxnav.viz.plan import INK, PALE

WIDTH, DPI = 7.0, 150  # inches; shown 700 pixels wide, a point of type is 1.4 pixels
MAX_AREA = 60.0  # points^2, of the marker with the most episodes
BINS = 6  # in the similarity figure, of equal numbers of points

#: Of lines; neighbours differ in lightness.
STYLES: tuple[dict[str, Any], ...] = tuple(
    {"color": color, "marker": marker, "ls": dash, "lw": 1.5, "ms": 4.5}
    for color, marker, dash in zip(
        ("#1a1a1a", "#D55E00", "#56B4E9", "#0072B2", "#CC79A7", "#8a8a8a"),
        "o^sDvP",
        ("-", "-.", "-", "--", (0, (6, 1.5)), (0, (3, 1, 1, 1, 1, 1))),
        strict=True,
    )
)
LEVEL, SEED = {"color": PALE, "lw": 1, "ls": ":"}, {"lw": 0.6, "alpha": 0.6}
MEAN = {"color": INK, "marker": "D", "lw": 1.4, "ms": 4.5, "mec": "white"}
BAR, POINT = "#a9a9a9", "#0072B2"
_METRICS = {"sr": "SR (%)", "spl": "SPL (%)", "dts": "DTS (m)"}
_BELIEFS: dict[str, dict[str, Any]] = {"updated": {"ls": "-"}, "frozen": {"ls": "--", "mfc": "white"}}


def save(figure: Figure, path: Path) -> None:
    """Writes the figure as a PNG whose bytes depend on the figure alone; `path` is replaced at once.

    Raises:
      OSError: the file cannot be written; `path` is as it was.
    """
    png = io.BytesIO()
    figure.savefig(png, format="png", metadata={"Software": None})
    write_atomic(path, png.getvalue())


def similarity_figure(fig4: dict[str, Any]) -> Figure:
    """SR against layout similarity, a point per goal category and scene, a panel per shift (paper's Fig. 4).

    Args:
      fig4: `panels`, each with `shift`, `similarity`, `success` (0-1), `episodes` (one number per point), and the
        intervals `pearson` and `spearman`.
    """
    panels = fig4["panels"]
    figure, axes = _grid(1, len(panels), height=3.4, sharex=True, sharey=True)
    most = max(max(panel["episodes"]) for panel in panels)
    for own, panel in zip(axes[0], panels, strict=True):
        x, y, weight = (np.asarray(panel[name]) for name in ("similarity", "success", "episodes"))
        own.scatter(x, 100 * y, s=MAX_AREA * weight / most, color=POINT, alpha=0.22, lw=0)
        bins = [part for part in np.array_split(np.argsort(x), BINS) if len(part)]
        centres, means = ([np.average(values[part], weights=weight[part]) for part in bins] for values in (x, 100 * y))
        own.plot(centres, means, **MEAN)
        related = (f"{name.capitalize()} r {_interval(panel[name], '.2f')}" for name in ("pearson", "spearman"))
        _title(own, f"Shift {panel['shift']:g}", *related)
        own.set(xlabel="Layout similarity (cosine)", ylim=(-6, 106))
    axes[0, 0].set_ylabel("SR (%)")
    point = _key("category in a scene, area: episodes", {"color": POINT, "marker": "o", "ls": "", "alpha": 0.5})
    _legend(figure, [point, _key(f"mean of each 1/{BINS} of the points", MEAN)])
    return _settled(figure)


def gain_figure(fig5: dict[str, Any]) -> Figure:
    """Baseline SR and a variant's gain per category, in order of layout similarity (paper's Fig. 5).

    Args:
      fig5: `panels`, each with `shift`, `variant`, and per category `categories`, `similarity`, `baseline` (%) and
        `gain` (points), and the intervals `slope` (points of gain per 0.1 of similarity) and `pearson`.
    """
    panels = fig5["panels"]
    figure, axes = _grid(2 * len(panels), 1, height=4.4 * len(panels))
    reach = 1.15 * max(1.0, *(np.abs(panel["gain"]).max() for panel in panels))
    for panel, (above, below) in zip(panels, axes.reshape(-1, 2), strict=True):
        order = np.argsort(panel["similarity"], kind="stable")
        x = np.arange(len(order))
        above.bar(x, np.asarray(panel["baseline"])[order], 0.7, color=BAR)
        above.set(ylabel="Baseline SR (%)", ylim=(0, 100), xticks=x, xticklabels=[])
        _title(
            above,
            f"Shift {panel['shift']:g}: gain of {panel['variant']} over the baseline",
            f"Slope: {_interval(panel['slope'], '+.1f')} points per 0.1 of similarity; "
            f"Pearson r = {_interval(panel['pearson'], '.2f')}",
        )
        below.axhline(0, color=INK, lw=0.8)
        gain = np.asarray(panel["gain"])[order]
        below.vlines(x, 0, gain, color=POINT, lw=1.6)
        below.plot(x, gain, "o", color=POINT, ms=5)
        names = [f"{panel['categories'][i]} {panel['similarity'][i]:.2f}" for i in order]
        below.set_xticks(x, names, rotation=90)
        below.set(ylabel="Gain (SR points)", ylim=(-reach, reach))
        below.set_xlabel("Goal category and its mean layout similarity (cosine), lowest first")
        for own in (above, below):
            own.set_xlim(-0.7, len(x) - 0.3)
    return _settled(figure)


def epsilon_figure(fig6a: dict[str, Any]) -> Figure:
    """SR, SPL and DTS over the threshold of sTDE, a line per shift, a row per form (paper's Fig. 6a).

    Args:
      fig6a: `epsilon` [E] and `lines`, each with `shift`, `form`, and `sr`, `spl` (%), `dts` (metres), which hold
        `mean`, `low`, `high` [E] and `seeds` [S, E].
    """
    forms = list(dict.fromkeys(line["form"] for line in fig6a["lines"]))
    shifts = sorted({line["shift"] for line in fig6a["lines"]})
    figure, axes = _grid(len(forms), len(_METRICS), height=2.3 * len(forms) + 0.4, sharey="col")
    for line in fig6a["lines"]:
        style = STYLES[shifts.index(line["shift"])]
        for own, metric in zip(axes[forms.index(line["form"])], _METRICS, strict=True):
            own.plot(fig6a["epsilon"], np.transpose(line[metric]["seeds"]), color=style["color"], **SEED)
            _band_line(own, fig6a["epsilon"], line[metric], style)
    for form, row in zip(forms, axes, strict=True):
        for own, label in zip(row, _METRICS.values(), strict=True):
            own.set(ylabel=label, xlabel="Threshold ε")
        _title(row[0], f"{form.capitalize()} form")
    keys = [_key(f"shift {shift:g}", style) for shift, style in zip(shifts, STYLES, strict=False)]
    _legend(figure, [*keys, _key("one training seed", {"color": PALE, **SEED})])
    return _settled(figure)


def gap_figure(fig6b: dict[str, Any]) -> Figure:
    """Mean layout gap step by step, the belief updated or frozen, a panel per setting (paper's Fig. 6b).

    Args:
      fig6b: `steps` [T] and `panels`, each with `setting` and `lines`: `shift`, `belief` (`updated` or `frozen`), and
        `mean`, `low`, `high` [T].
    """
    panels = fig6b["panels"]
    rows, columns = (len(panels) + 1) // 2, min(2, len(panels))
    figure, axes = _grid(rows, columns, height=2.3 * rows + 0.4, sharey=True)
    shifts = sorted({line["shift"] for panel in panels for line in panel["lines"]})

    def style(shift: float, belief: str) -> dict[str, Any]:
        return STYLES[shifts.index(shift)] | _BELIEFS[belief]

    for own, panel in zip(axes.flat, panels, strict=False):
        own.axhline(0.5, **LEVEL)
        for line in panel["lines"]:
            _band_line(own, fig6b["steps"], line, style(line["shift"], line["belief"]))
        own.set(ylim=(-0.02, 1.02), xlabel="Step")
        _title(own, f"Setting {panel['setting']}")
        own.set_ylabel("Mean layout gap D" if own in axes[:, 0] else "")
    for own in axes.flat[len(panels) :]:
        own.remove()
    keys = [_key(f"shift {shift:g}, belief {belief}", style(shift, belief)) for shift in shifts for belief in _BELIEFS]
    _legend(figure, [*keys, _key("ε = 0.5", LEVEL)])
    return _settled(figure)


def auc_figure(auc: dict[str, Any]) -> Figure:
    """How well the gap tells shifted from unshifted episodes, step by step, a line per setting.

    Args:
      auc: `steps` [T] and `lines`, each with `setting` and `mean`, `low`, `high` [T].
    """
    figure, axes = _grid(1, 1, height=3.6)
    axes[0, 0].axhline(0.5, **LEVEL)
    axes[0, 0].set(xlabel="Step", ylabel="AUC of the gap, shifted against unshifted")
    keys = []
    for i, line in enumerate(auc["lines"]):
        _band_line(axes[0, 0], auc["steps"], line, STYLES[i])
        keys.append(_key(line["setting"], STYLES[i]))
    _legend(figure, [*keys, _key("chance", LEVEL)])
    return _settled(figure)


def effects_figure(effects: dict[str, Any]) -> Figure:
    """Differences in SR with their intervals, a panel per group; filled where the interval excludes 0.

    Args:
      effects: `groups`, each with `title` and `rows`: `name` and an interval, in points.
    """
    groups = effects["groups"]
    heights = [len(group["rows"]) + 1 for group in groups]
    figure, axes = _grid(len(groups), 1, height=0.26 * sum(heights) + 0.6, sharex=True, height_ratios=heights)
    for own, group in zip(axes[:, 0], groups, strict=True):
        own.axvline(0, color=INK, lw=0.8)
        for y, row in enumerate(group["rows"]):
            low, high = row["ci95"]
            own.hlines(y, low, high, color=POINT, lw=1.8)
            own.plot(row["mean"], y, "o", color=POINT, ms=5.5, mfc=POINT if low > 0 or high < 0 else "white")
            text = _interval(row, "+.1f")
            own.text(1.02, y, text, color=INK, fontsize=8, va="center", transform=own.get_yaxis_transform())
        own.set_yticks(range(len(group["rows"])), [row["name"] for row in group["rows"]])
        own.set_ylim(len(group["rows"]) - 0.4, -0.6)
        _title(own, group["title"])
    axes[-1, 0].set_xlabel("Difference in SR (points); filled: the 95 % interval excludes 0")
    return _settled(figure)


def _grid(rows: int, columns: int, *, height: float, **sharing: Any) -> tuple[Figure, np.ndarray]:
    """A figure with [rows, columns] of plain axes; `height` in inches."""
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **sharing)
    for own in axes.flat:
        own.spines[["top", "right"]].set_visible(False)
        own.spines[["left", "bottom"]].set_color(PALE)
        own.tick_params(labelcolor=INK, labelsize=8, color=PALE)
        own.xaxis.label.set(fontsize=9, color=INK)
        own.yaxis.label.set(fontsize=9, color=INK)
    return figure, axes


def _settled(figure: Figure) -> Figure:
    """Fixes the layout, which would move a little with each drawing."""
    for _ in range(2):
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure


def _title(axes: Axes, *lines: str) -> None:
    axes.set_title("\n".join(lines), loc="left", fontsize=8.5, color=INK)


def _band_line(axes: Axes, x: list[float], line: dict[str, Any], style: dict[str, Any]) -> None:
    """The mean, with at most twelve markers, and its band."""
    axes.fill_between(x, line["low"], line["high"], color=style["color"], alpha=0.16, lw=0)
    axes.plot(x, line["mean"], markevery=-(-len(x) // 12), **style)


def _key(label: str, style: dict[str, Any]) -> Line2D:
    return Line2D([], [], label=label, **style)


def _legend(figure: Figure, keys: list[Line2D]) -> None:
    columns = len(keys) if len(keys) < 5 else 3
    figure.legend(handles=keys, loc="outside upper center", ncols=columns, fontsize=8, frameon=False, handlelength=3)


def _interval(own: dict[str, Any], form: str) -> str:
    if own["mean"] is None:
        return "undefined"
    low, high = own["ci95"]
    return f"{own['mean']:{form}} [{low:{form}}, {high:{form}}]".replace("-", "\N{MINUS SIGN}")
