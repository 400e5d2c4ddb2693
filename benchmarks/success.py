"""Time to success of training runs.

`python benchmarks/success.py RUN [RUN ...]` reads the logs of finished runs. For every arm: val success and SPL of the
last measurement (best and sampled actions, mean over seeds with its 95 % interval by Student's t), and the environment
steps of a policy, CPU seconds and wall seconds of the whole run after which the mean success with best actions first
reached 70, 80 and 90 %. Seconds count everything since the command's start: scenes, compilation, measurements, and all
policies that were trained in parallel. The result goes to stdout as JSON, a table to stderr.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from _common import print_report
from scipy.stats import t

from jaxnav.runs.run import Run

LEVELS = (70, 80, 90)
MEASURES = ("val_success", "val_success_sampled", "val_spl", "val_spl_sampled")


def main(folders: list[str]) -> None:
    results = {Path(folder).name: measure_arms(Run.open(folder)) for folder in folders}
    print(format_table(results), file=sys.stderr)
    print_report({"runs": results})


def measure_arms(run: Run) -> dict[str, Any]:
    """Return the measures of a run's arms."""
    times_by_step = {row["step"]: row for row in run.times()}
    last_times = times_by_step[max(times_by_step)]

    results = {}
    for arm in run.config.arms:
        # Measurements of all seeds, by step of the log.
        rows_by_step: dict[int, list[dict[str, Any]]] = {}
        for row in run.log():
            if row["arm"] == arm and "val_success" in row:
                rows_by_step.setdefault(row["step"], []).append(row)

        last_rows = rows_by_step[max(rows_by_step)]
        measures: dict[str, Any] = {}
        for name in MEASURES:
            measures[name] = mean_with_interval([100 * row[name] for row in last_rows])
        measures["seeds"] = run.config.seeds
        measures["policies"] = run.config.seeds * len(run.config.arms)

        for level in LEVELS:
            first_step = find_first_step(rows_by_step, level)
            if first_step is None:
                measures[f"to_{level}"] = None
            else:
                measures[f"to_{level}"] = {
                    "env_steps": rows_by_step[first_step][0]["env_steps"],
                    "cpu_s": times_by_step[first_step]["cpu_s"],
                    "wall_s": times_by_step[first_step]["wall_s"],
                }
        measures["whole"] = {"cpu_s": last_times["cpu_s"], "wall_s": last_times["wall_s"]}
        results[arm] = measures
    return results


def find_first_step(rows_by_step: dict[int, list[dict[str, Any]]], level: float) -> int | None:
    """Return the first step at which the mean val success is at least `level` percent; None if it never is."""
    for step in sorted(rows_by_step):
        if 100 * np.mean([row["val_success"] for row in rows_by_step[step]]) >= level:
            return step
    return None


def mean_with_interval(values: list[float]) -> list[float | None]:
    """Return the mean and its 95 % interval; without bounds for one value."""
    mean = float(np.mean(values))
    if len(values) == 1:
        return [round(mean, 1), None, None]
    half_width = float(t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5)
    return [round(mean, 1), round(mean - half_width, 1), round(mean + half_width, 1)]


def format_table(results: dict[str, Any]) -> str:
    """Return the results in Markdown."""
    level_headings = "".join(f" to {level} % |" for level in LEVELS)
    lines = [
        "| run | SR best | SR sampled | SPL best | SPL sampled |" + level_headings,
        "| --- |" + " ---: |" * (4 + len(LEVELS)),
    ]
    for name, measures_by_arm in results.items():
        for arm, measures in measures_by_arm.items():
            cells = [format_interval(measures[measure]) for measure in MEASURES]
            cells += [format_reached(measures[f"to_{level}"], measures["policies"]) for level in LEVELS]
            lines.append(f"| {name}, {arm} | {' | '.join(cells)} |")
    return "\n".join(lines)


def format_interval(values: list[float | None]) -> str:
    mean, low, high = values
    return f"{mean:.1f}" if low is None else f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def format_reached(first_time: dict[str, float] | None, num_policies: int) -> str:
    if first_time is None:
        return "not reached"
    million_steps = first_time["env_steps"] / 1e6
    cpu_s = first_time["cpu_s"] / num_policies
    return f"{million_steps:.2f} M, {cpu_s:.0f} CPU s a policy, {first_time['wall_s']:.0f} s"


if __name__ == "__main__":
    main(sys.argv[1:])
