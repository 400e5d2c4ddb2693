"""Look of the study's figures.

Lines differ by marker and dash as well as by colour, and colours by lightness, so all can be read in grey.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.evaluation.statistics import Interval
from jaxnav.store.files import write_atomic
from jaxnav.study.curves import Curve
from jaxnav.viz.plan import INK, PALE

WIDTH, DPI = 7.0, 150  # inches; shown 700 pixels wide, a point of type is 1.4 pixels

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


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG.

    Its bytes depend on the figure alone; `path` is replaced at once.

    Raises:
      OSError: the file cannot be written; `path` is as it was.
    """
    png = io.BytesIO()
    figure.savefig(png, format="png", metadata={"Software": None})
    write_atomic(path, png.getvalue())


def grid(rows: int, columns: int, *, height: float, **sharing: Any) -> tuple[Figure, np.ndarray]:
    """Return a figure with plain axes [rows, columns]; inches."""
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, **sharing)
    for axes in panels.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(PALE)
        axes.tick_params(labelcolor=INK, labelsize=8, color=PALE)
        axes.xaxis.label.set(fontsize=9, color=INK)
        axes.yaxis.label.set(fontsize=9, color=INK)
    return figure, panels


def fix_placement(figure: Figure) -> Figure:
    """Fix where the axes are, which moves with each drawing."""
    for _ in range(2):
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure


def set_title(axes: Axes, *lines: str) -> None:
    """Set the title, left."""
    axes.set_title("\n".join(lines), loc="left", fontsize=8.5, color=INK)


def draw_band(axes: Axes, x: Sequence[float], curve: Curve, style: dict[str, Any]) -> None:
    """Draw a curve, its band and at most twelve markers."""
    axes.fill_between(x, curve.low, curve.high, color=style["color"], alpha=0.16, lw=0)
    axes.plot(x, curve.mean, markevery=-(-len(x) // 12), **style)


def legend_key(label: str, style: dict[str, Any]) -> Line2D:
    """Return a key of the legend."""
    return Line2D([], [], label=label, **style)


def add_legend(figure: Figure, keys: Sequence[Line2D]) -> None:
    """Add a legend above all axes."""
    columns = len(keys) if len(keys) < 5 else 3
    figure.legend(handles=keys, loc="outside upper center", ncols=columns, fontsize=8, frameon=False, handlelength=3)


def interval_text(interval: Interval, form: str) -> str:
    """Return an interval with typographic minus signs."""
    return f"{interval:{form}}".replace("-", "\N{MINUS SIGN}")
