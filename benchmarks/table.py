"""Tables and chart of docs/performance.md, from the benchmarks' results.

`python benchmarks/table.py` writes a table between each `<!-- table NAME -->` and `<!-- end -->` of the document: the
contents of results/performance/NAME.json, or with `NAME.key.key` a part of them.
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
DOCUMENT = ROOT / "docs" / "performance.md"
GROWTH_CHART = ROOT / "docs" / "images" / "performance" / "growth.png"
TABLE_MARKS = re.compile(r"<!-- table (\S+) -->\n.*?<!-- end -->", re.DOTALL)
#: Axes of the growth chart, and programs with their colors.
GROWTH_AXES = {
    "environments": "parallel episodes",
    "scenes": "scenes",
    "categories": "categories",
    "hidden": "hidden size",
}
GROWTH_PROGRAMS = {"environment": "#d95f02", "training": "#2166ac"}


def main() -> None:
    text = DOCUMENT.read_text()
    DOCUMENT.write_text(TABLE_MARKS.sub(lambda match: fill_table(match[1]), text))
    draw_growth(json.loads((RESULTS / "growth.json").read_text()), GROWTH_CHART)


# Tables


def fill_table(name: str) -> str:
    """Return one table between its marks."""
    file, *keys = name.split(".")
    part = json.loads((RESULTS / f"{file}.json").read_text())
    for key in keys:
        part = part[key]
    if not keys:
        part = {key: value for key, value in part.items() if key != "machine"}
    return f"<!-- table {name} -->\n{format_table(part)}\n<!-- end -->"


def format_table(part: Mapping[str, Any]) -> str:
    """Return a Markdown table of a result.

    If all entries have parts, each is a row with a column for each part; otherwise each leaf is a row.
    """
    if all(isinstance(entry, Mapping) and not is_spread(entry) for entry in part.values()):
        rows = {name: dict(iterate_leaves(entry)) for name, entry in part.items()}
    else:
        rows = {name: {"value": value} for name, value in iterate_leaves(part)}

    # Columns in the order in which they first occur; a row may lack some.
    columns = []
    for row in rows.values():
        columns += [column for column in row if column not in columns]

    lines = [["", *(column.replace("_", " ") for column in columns)], ["---"] + ["---:"] * len(columns)]
    for name, row in rows.items():
        lines.append([name.replace("_", " "), *(format_cell(row.get(column)) for column in columns)])
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
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
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
