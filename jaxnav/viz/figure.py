"""Figures with plain axes, and their files."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.store.files import write_atomic
from jaxnav.viz.plan import INK, PALE

WIDTH, DPI = 7.0, 150  # inches; shown 700 pixels wide, a point of type is 1.4 pixels


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
    axes.set_title("\n".join(lines), loc="left", fontsize=8.5, color=INK, parse_math=False)  # may hold a file's name
