"""Look of all figures: colors, axes without clutter, and files whose bytes depend on the figure alone."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.store.files import write_atomic

FIGURE_WIDTH = 7.0  # inches
FIGURE_DPI = 150  # documents show a figure 700 pixels wide: a point of type is 1.4 pixels

TEXT_COLOR = "#333333"
MUTED_COLOR = "#8a8a8a"


#: Decorator of functions that draw: figures look alike, and are drawn at all, whatever the user's matplotlibrc sets.
default_style = matplotlib.style.context("default")


def make_panels(rows: int, columns: int, *, height: float, **sharing: Any) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes [rows, columns].

    Args:
      rows: number of rows.
      columns: number of columns.
      height: height of the figure in inches.
      **sharing: further arguments of `Figure.subplots`.
    """
    figure = Figure(figsize=(FIGURE_WIDTH, height), dpi=FIGURE_DPI, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, **sharing)
    for axes in panels.flat:
        style_axes(axes, label_size=8)
        axes.xaxis.label.set(fontsize=9, color=TEXT_COLOR)
        axes.yaxis.label.set(fontsize=9, color=TEXT_COLOR)
    return figure, panels


def style_axes(axes: Axes, label_size: float) -> None:
    """Remove the upper and right border, and mute the remaining ones."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED_COLOR)
    axes.tick_params(labelcolor=TEXT_COLOR, labelsize=label_size, color=MUTED_COLOR)


def repeat_styles(styles: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """Return styles of `count` lines; when all styles are used, they repeat with white markers."""
    line_styles = []
    for index in range(count):
        num_repeats, style_index = divmod(index, len(styles))
        line_style = dict(styles[style_index])
        if num_repeats % 2 == 1:
            line_style["mfc"] = "white"
        line_styles.append(line_style)
    return line_styles


def set_panel_title(axes: Axes, *lines: str) -> None:
    """Set the title of axes, aligned to the left."""
    title = "\n".join(lines)
    # A title may contain the name of a file, which must not be parsed as a formula.
    axes.set_title(title, loc="left", fontsize=8.5, color=TEXT_COLOR, parse_math=False)


def freeze_axes_positions(figure: Figure) -> Figure:
    """Lay out the axes of a figure and fix their positions, which would otherwise move with each drawing."""
    for _ in range(2):
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure


@default_style
def save_figure(figure: Figure, path: Path, dpi: int | None = None) -> None:
    """Write a figure as a PNG, atomically.

    Args:
      figure: figure to write.
      path: file to write.
      dpi: pixels per inch; None for those of the figure.

    Raises:
      OSError: the file cannot be written; `path` is unchanged.
    """
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=dpi or figure.dpi, metadata={"Software": None})
    write_atomic(path, png.getvalue())
