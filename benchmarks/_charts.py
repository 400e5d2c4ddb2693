"""The charts of the performance document, for `table.py`."""

import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

#: Color of each part of a run, in the order in which a run goes through them.
PART_COLORS = {
    "imports": "#b0b0b0",
    "scenes": "#8c6d31",
    "prior": "#e7ba52",
    "calibration": "#f2d58c",
    "compile": "#d6616b",
    "rollout": "#6baed6",
    "learning": "#2166ac",
    "checkpoints": "#74c476",
    "evaluation": "#7b5ea7",
    "report": "#c5b0d5",
    "other": "#dddddd",
}
#: Parts whose color needs white text.
DARK_PARTS = ("scenes", "compile", "learning", "evaluation")
#: A part that is shorter than this share of the longest bar has no room for its number.
MIN_LABELED_SHARE = 0.035
TRAINING_COLOR = "#2166ac"
ENVIRONMENT_COLOR = "#d95f02"


def draw_charts(results: Path, images: Path) -> None:
    """Draw every chart whose results exist."""
    images.mkdir(parents=True, exist_ok=True)

    runs = {}
    for path in sorted(results.glob("time_to_result*.json"), reverse=True):
        runs[path.stem] = json.loads(path.read_text())
    if runs:
        _save(draw_time_to_result(runs), images / "time_to_result.png")

    path = results / "growth.json"
    if path.exists():
        _save(draw_growth(json.loads(path.read_text())), images / "growth.png")
    path = results / "curves.json"
    if path.exists():
        _save(draw_curves(json.loads(path.read_text())["success"]), images / "curves.png")


def draw_time_to_result(runs: dict[str, Any]) -> Figure:
    """Draw the seconds of each run as one bar, divided into parts."""
    figure, axes = plt.subplots(figsize=(9, 1.7 + 0.6 * len(runs)), layout="constrained")
    longest = max(run["wall_s"]["both"] for run in runs.values())
    for bar_index, run in enumerate(runs.values()):
        # Stack the parts of both commands from left to right.
        bar_end = 0.0
        for part, color in PART_COLORS.items():
            seconds = sum(command.get(part, 0.0) for command in run["seconds"].values())
            axes.barh(
                bar_index,
                seconds,
                left=bar_end,
                color=color,
                edgecolor="white",
                height=0.6,
                label=part if bar_index == 0 else None,
            )
            if seconds > MIN_LABELED_SHARE * longest:
                text_color = "w" if part in DARK_PARTS else "k"
                axes.text(
                    bar_end + seconds / 2, bar_index, f"{seconds:.0f}", ha="center", va="center", color=text_color
                )
            bar_end += seconds
        axes.text(bar_end + 0.01 * longest, bar_index, f"{bar_end:.0f} s", va="center", weight="bold")

    names = [name.removeprefix("time_to_result").replace("_", " ").strip() or "now" for name in runs]
    axes.set_yticks(range(len(runs)), names)
    axes.set(xlim=(0, 1.08 * longest), xlabel="seconds of `make run`", ylim=(-0.5, len(runs) - 0.5))
    axes.invert_yaxis()
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False)
    axes.legend(ncols=6, loc="lower left", bbox_to_anchor=(0, 1), frameon=False, fontsize=9)
    return figure


def draw_curves(results: dict[str, Any]) -> Figure:
    """Draw training success by steps with 95 % intervals, a panel for each arm."""
    figure, panels = plt.subplots(1, len(results), figsize=(9, 3.2), sharey=True, layout="constrained")
    for axes, (arm, points) in zip(panels, results.items(), strict=True):
        millions = [int(steps) / 1e6 for steps in points]
        for version, color in (("before", ENVIRONMENT_COLOR), ("after", TRAINING_COLOR)):
            low, mean, high = zip(*(point[version] for point in points.values()), strict=True)
            axes.plot(millions, mean, color=color, label=version)
            axes.fill_between(millions, low, high, color=color, alpha=0.2, linewidth=0)
        axes.set(title=arm, xlabel="million steps of a policy")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("training success, %")
    panels[0].legend(frameon=False)
    return figure


def draw_growth(results: dict[str, Any]) -> Figure:
    """Draw steps per second and peak memory along every axis."""
    labels = {
        "environments": "parallel episodes",
        "scenes": "scenes",
        "categories": "categories",
        "hidden": "hidden size",
    }
    figure, panels = plt.subplots(2, len(labels), figsize=(11, 5), sharey="row", layout="constrained")
    for (axis, label), (speed_axes, memory_axes) in zip(labels.items(), panels.T, strict=True):
        # The environment alone is not measured at every point.
        for program, color in (("environment", ENVIRONMENT_COLOR), ("training", TRAINING_COLOR)):
            points = {int(x): point for x, point in results[axis].items() if f"{program}_steps_per_s" in point}
            _draw_line(speed_axes, points, f"{program}_steps_per_s", program, color)
            _draw_line(memory_axes, points, f"{program}_peak_resident_gb", program, color)

        # Both panels of a column share the ticks; only the lower one names them.
        memory_axes.set_xlabel(label)
        ticks = [int(value) for value in results[axis]]
        tick_labels = [f"{tick:,}" for tick in ticks]
        for axes in (speed_axes, memory_axes):
            axes.set(xscale="log", yscale="log")
            axes.set_xticks(ticks, tick_labels if axes is memory_axes else [""] * len(ticks))
            axes.set_xticks([], minor=True)
            axes.tick_params(axis="x", labelsize=8, rotation=30)
            axes.grid(alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("steps per second")
    panels[1, 0].set_ylabel("peak memory, GB")
    panels[1, 0].yaxis.set_major_locator(LogLocator(2))
    panels[1, 0].yaxis.set_major_formatter("{x:g}")
    panels[1, 0].yaxis.set_minor_locator(NullLocator())
    panels[0, 0].legend(frameon=False)
    return figure


def _draw_line(axes: Axes, points: dict[int, Any], key: str, label: str, color: str) -> None:
    values = []
    for point in points.values():
        value = point[key]
        values.append(value["median"] if isinstance(value, dict) else value)
    axes.plot(list(points), values, marker="o", markersize=4, color=color, label=label)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130)
    plt.close(figure)
