"""Look of the study's figures.

Lines differ by marker and dash as well as by colour, and colours by lightness, so all can be read in grey.
"""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.curves import Curve
from jaxnav.viz.plan import INK, PALE

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
