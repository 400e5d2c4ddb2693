"""Tables, numbers and chart of the performance pages, from the benchmarks' results.

`python benchmarks/table.py` fills what stands between a mark and `<!-- end -->` in the pages `DOCUMENTS`:

  <!-- table NAME -->                   the table of results/performance/NAME.json
  <!-- table NAME.key.key -->           of a part of that file
  <!-- table NAME: key=heading; key --> these columns only, the first under another heading
  <!-- value NAME.key.key -->           one number within a line, not at its start
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results" / "performance"
DOCUMENTS = (ROOT / "docs" / "performance.md", ROOT / "docs" / "performance_details.md")
GROWTH_CHART = ROOT / "docs" / "images" / "performance" / "growth.png"
TABLE_MARKS = re.compile(r"(<!-- table (\S+?)(?:: (.+?))? -->\n).*?(<!-- end -->)", re.DOTALL)
VALUE_MARKS = re.compile(r"(<!-- value (.+?) -->).*?(<!-- end -->)")
#: Axes of the growth chart, and programs with their colors.
GROWTH_AXES = {
    "environments": "parallel episodes",
    "scenes": "scenes",
    "categories": "categories",
    "hidden": "hidden size",
}
GROWTH_PROGRAMS = {"environment": "#d95f02", "training": "#2166ac"}


def main() -> None:
    for document in DOCUMENTS:
        document.write_text(fill_page(document.read_text()))
    draw_growth(json.loads((RESULTS / "growth.json").read_text()), GROWTH_CHART)


# Tables and numbers


def fill_page(text: str) -> str:
    """Return a page with its tables and numbers taken from the results."""
    text = TABLE_MARKS.sub(lambda match: f"{match[1]}{make_table(match[2], match[3])}\n{match[4]}", text)
    return VALUE_MARKS.sub(lambda match: f"{match[1]}{format_cell(read_result(match[2]))}{match[3]}", text)


def make_table(name: str, columns: str | None) -> str:
    """Return the Markdown table that a mark asks for."""
    part = read_result(name)
    if "." not in name:
        part = {key: value for key, value in part.items() if key != "machine"}
    if columns is None:
        return format_table(part)

    # Each column is `key` or `key=heading`.
    headings = {}
    for column in columns.split("; "):
        key, _, heading = column.partition("=")
        headings[key] = heading or key
    return format_table(part, headings)


def read_result(name: str) -> Any:
    """Return the contents of a result file, or with `NAME.key.key` a part of them."""
    file, *keys = name.split(".")
    part = json.loads((RESULTS / f"{file}.json").read_text())
    for key in keys:
        part = part[key]
    return part


def format_table(part: Mapping[str, Any], headings: Mapping[str, str] | None = None) -> str:
    """Return a Markdown table of a result.

    If all entries have parts, each is a row with a column for each part; otherwise each leaf is a row.

    Args:
      part: of a result.
      headings: of the columns to show, by key; by default all columns, named by their keys.
    """
    if all(isinstance(entry, Mapping) and not is_spread(entry) for entry in part.values()):
        rows = {name: dict(iterate_leaves(entry)) for name, entry in part.items()}
    else:
        rows = {name: {"value": value} for name, value in iterate_leaves(part)}

    # Columns in the order in which they first occur; a row may lack some.
    if headings is None:
        headings = {column: column for row in rows.values() for column in row}

    lines = [["", *(heading.replace("_", " ") for heading in headings.values())], ["---"] + ["---:"] * len(headings)]
    for name, row in rows.items():
        lines.append([name.replace("_", " "), *(format_cell(row.get(column)) for column in headings)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def iterate_leaves(part: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and value of all leaves; spreads are leaves."""
    for name, value in part.items():
        if isinstance(value, Mapping) and not is_spread(value):
            yield from iterate_leaves(value, f"{prefix}{name}: ")
        else:
            yield f"{prefix}{name}", value


def is_spread(value: Any) -> bool:
    """True for a median with its bounds."""
    return isinstance(value, Mapping) and {"median", "min", "max"} <= set(value)


def format_cell(value: Any) -> str:
    """Return one cell; a spread as `median (minimum to maximum)`."""
    if is_spread(value):
        return f"{format_cell(value['median'])} ({format_cell(value['min'])} to {format_cell(value['max'])})"
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: ""}[value]
    if isinstance(value, int | float):
        if abs(value) >= 1e6:
            return f"{value / 1e6:.3g} M"
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value).replace("|", "\\|")


# The chart


def draw_growth(results: Mapping[str, Any], path: Path) -> None:
    """Draw steps per second and peak memory along every axis."""
    figure, panels = plt.subplots(2, len(GROWTH_AXES), figsize=(11, 5), sharey="row", layout="constrained")
    for (axis, label), (speed_axes, memory_axes) in zip(GROWTH_AXES.items(), panels.T, strict=True):
        for program, color in GROWTH_PROGRAMS.items():
            # The environment alone is not measured at every point.
            points = {int(x): point for x, point in results[axis].items() if f"{program}_steps_per_s" in point}
            rates = [point[f"{program}_steps_per_s"]["median"] for point in points.values()]
            peaks = [point[f"{program}_peak_resident_gb"] for point in points.values()]
            speed_axes.plot(list(points), rates, marker="o", markersize=4, color=color, label=program)
            memory_axes.plot(list(points), peaks, marker="o", markersize=4, color=color)

        # Both panels of a column share the ticks; only the lower one names them.
        ticks = [int(value) for value in results[axis]]
        set_growth_axes(speed_axes, ticks, [""] * len(ticks))
        set_growth_axes(memory_axes, ticks, [f"{tick:,}" for tick in ticks])
        memory_axes.set_xlabel(label)

    panels[0, 0].set_ylabel("steps per second")
    panels[1, 0].set_ylabel("peak memory, GB")
    panels[1, 0].yaxis.set_major_locator(LogLocator(2))
    panels[1, 0].yaxis.set_major_formatter("{x:g}")
    panels[1, 0].yaxis.set_minor_locator(NullLocator())
    panels[0, 0].legend(frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def set_growth_axes(axes: Axes, ticks: list[int], tick_labels: list[str]) -> None:
    """Give a panel logarithmic axes with these ticks."""
    axes.set(xscale="log", yscale="log")
    axes.set_xticks(ticks, tick_labels)
    axes.set_xticks([], minor=True)
    axes.tick_params(axis="x", labelsize=8, rotation=30)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
