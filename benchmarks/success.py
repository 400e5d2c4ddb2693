"""Time to success of training runs.

`python benchmarks/success.py RUN [RUN ...]` reads the logs of finished runs. For every arm: val success and SPL of the
last measurement (best and sampled actions, mean over seeds with its 95 % interval by Student's t), and after how many
environment steps of a policy, CPU seconds and wall seconds of the whole run the mean success with best actions was
first at 70, 80 and 90 %. Seconds count everything since the command's start: scenes, compilation, measurements, and the
other policies that were trained side by side. The result goes to stdout as JSON, a table to stderr.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from _common import report
from scipy.stats import t

from jaxnav.runs.directory import Run

LEVELS = (70, 80, 90)
MEASURES = ("val_success", "val_success_sampled", "val_spl", "val_spl_sampled")


def main(folders: list[str]) -> None:
    results = {Path(folder).name: arms(Run.open(folder)) for folder in folders}
    print(table(results), file=sys.stderr)
    report({"runs": results})


def arms(run: Run) -> dict[str, Any]:
    """Return the measures of a run's arms."""
    seconds = {row["step"]: row for row in run.times()}
    found = {}
    for arm in run.config.arms:
        course: dict[int, list[dict[str, Any]]] = {}
        for row in run.log():
            if row["arm"] == arm and "val_success" in row:
                course.setdefault(row["step"], []).append(row)
        found[arm] = {name: interval([100 * row[name] for row in course[max(course)]]) for name in MEASURES}
        found[arm] |= {"seeds": run.config.seeds, "policies": run.config.seeds * len(run.config.arms)}
        for level in LEVELS:
            reached = [
                step for step, rows in course.items() if 100 * np.mean([r["val_success"] for r in rows]) >= level
            ]
            first = min(reached, default=None)
            found[arm][f"to_{level}"] = (
                None
                if first is None
                else (
                    {"env_steps": course[first][0]["env_steps"]}
                    | {name: seconds[first][name] for name in ("cpu_s", "wall_s")}
                )
            )
        found[arm]["whole"] = {name: seconds[max(seconds)][name] for name in ("cpu_s", "wall_s")}
    return found


def interval(values: list[float]) -> list[float | None]:
    """Return the mean and its 95 % interval; without bounds for one value."""
    mean = float(np.mean(values))
    if len(values) == 1:
        return [round(mean, 1), None, None]
    half = float(t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5)
    return [round(bound, 1) for bound in (mean, mean - half, mean + half)]


def table(results: dict[str, Any]) -> str:
    """Return the results in Markdown."""
    lines = [
        "| run | SR best | SR sampled | SPL best | SPL sampled |" + "".join(f" to {level} % |" for level in LEVELS)
    ]
    lines.append("| --- |" + " ---: |" * (4 + len(LEVELS)))
    for name, by_arm in results.items():
        for arm, row in by_arm.items():
            cells = [cell(row[measure]) for measure in MEASURES]
            cells += [reached(row[f"to_{level}"], row["policies"]) for level in LEVELS]
            lines.append(f"| {name}, {arm} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(values: list[float | None]) -> str:
    mean, low, high = values
    return f"{mean:.1f}" if low is None else f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def reached(first: dict[str, float] | None, policies: int) -> str:
    if first is None:
        return "not reached"
    return f"{first['env_steps'] / 1e6:.2f} M, {first['cpu_s'] / policies:.0f} CPU s a policy, {first['wall_s']:.0f} s"


if __name__ == "__main__":
    main(sys.argv[1:])
