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

#: In the order in which a run goes through them.
COLOURS = {
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
DARK = ("scenes", "compile", "learning", "evaluation")
NARROW = 0.035  # share of the longest bar under which a part has no room for its number
TRAINED, ALONE = "#2166ac", "#d95f02"


def draw(results: Path, images: Path) -> None:
    """Draw every chart whose results are there."""
    images.mkdir(parents=True, exist_ok=True)
    runs = {
        path.stem: json.loads(path.read_text()) for path in sorted(results.glob("time_to_result*.json"), reverse=True)
    }
    if runs:
        _save(time_to_result(runs), images / "time_to_result.png")
    path = results / "growth.json"
    if path.exists():
        _save(growth(json.loads(path.read_text())), images / "growth.png")
    path = results / "curves.json"
    if path.exists():
        _save(curves(json.loads(path.read_text())["success"]), images / "curves.png")


def time_to_result(runs: dict[str, Any]) -> Figure:
    """Draw where the seconds of runs go, a bar each."""
    figure, axes = plt.subplots(figsize=(9, 1.7 + 0.6 * len(runs)), layout="constrained")
    longest = max(run["wall_s"]["both"] for run in runs.values())
    for at, run in enumerate(runs.values()):
        left = 0.0
        for part, colour in COLOURS.items():
            seconds = sum(command.get(part, 0.0) for command in run["seconds"].values())
            axes.barh(
                at, seconds, left=left, color=colour, edgecolor="white", height=0.6, label=part if not at else None
            )
            if seconds > NARROW * longest:
                colour = "w" if part in DARK else "k"
                axes.text(left + seconds / 2, at, f"{seconds:.0f}", ha="center", va="center", color=colour)
            left += seconds
        axes.text(left + 0.01 * longest, at, f"{left:.0f} s", va="center", weight="bold")
    names = [name.removeprefix("time_to_result").replace("_", " ").strip() or "now" for name in runs]
    axes.set_yticks(range(len(runs)), names)
    axes.set(xlim=(0, 1.08 * longest), xlabel="seconds of `make run`", ylim=(-0.5, len(runs) - 0.5))
    axes.invert_yaxis()
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False)
    axes.legend(ncols=6, loc="lower left", bbox_to_anchor=(0, 1), frameon=False, fontsize=9)
    return figure


def curves(results: dict[str, Any]) -> Figure:
    """Draw training success by steps with 95 % intervals."""
    figure, panels = plt.subplots(1, len(results), figsize=(9, 3.2), sharey=True, layout="constrained")
    for axes, (arm, points) in zip(panels, results.items(), strict=True):
        millions = [int(steps) / 1e6 for steps in points]
        for version, colour in (("before", ALONE), ("after", TRAINED)):
            low, mean, high = zip(*(point[version] for point in points.values()), strict=True)
            axes.plot(millions, mean, color=colour, label=version)
            axes.fill_between(millions, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.set(title=arm, xlabel="million steps of a policy")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("training success, %")
    panels[0].legend(frameon=False)
    return figure


def growth(results: dict[str, Any]) -> Figure:
    """Draw steps per second and peak memory along every axis."""
    names = {
        "environments": "parallel episodes",
        "scenes": "scenes",
        "categories": "categories",
        "hidden": "hidden size",
    }
    figure, panels = plt.subplots(2, len(names), figsize=(11, 5), sharey="row", layout="constrained")
    for (axis, label), (above, below) in zip(names.items(), panels.T, strict=True):
        for what, colour in (("environment", ALONE), ("training", TRAINED)):
            points = {int(x): point for x, point in results[axis].items() if f"{what}_steps_per_s" in point}
            _line(above, points, f"{what}_steps_per_s", what, colour)
            _line(below, points, f"{what}_peak_resident_gb", what, colour)
        below.set_xlabel(label)
        for axes in (above, below):
            axes.set(xscale="log", yscale="log")
            values = [int(value) for value in results[axis]]
            axes.set_xticks(values, [f"{value:,}" for value in values] if axes is below else [""] * len(values))
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


def _line(axes: Axes, points: dict[int, Any], key: str, label: str, colour: str) -> None:
    values = [point[key]["median"] if isinstance(point[key], dict) else point[key] for point in points.values()]
    axes.plot(list(points), values, marker="o", markersize=4, color=colour, label=label)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130)
    plt.close(figure)
