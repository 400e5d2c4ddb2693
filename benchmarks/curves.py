"""Learning curves of two versions of the trainer.

Run with `python benchmarks/curves.py BEFORE_RUN AFTER_RUN`. Both are folders that `train.py` wrote with the same
settings. For every arm and chunk of updates: the training success rate in percent as mean over seeds, with its 95 %
interval (Student's t) in both, and whether the intervals overlap.
"""

import json
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from _common import report
from scipy.stats import t

ARMS = ("baseline", "layout")


def main(before: Path, after: Path) -> None:
    curves = {"before": curve(before), "after": curve(after)}
    success, overlaps = {}, []
    for arm in ARMS:
        for steps in sorted(curves["after"][arm]):
            low_high = {}
            for version, points in curves.items():
                mean, half = interval(points[arm][steps])
                low_high[version] = [round(mean - half, 1), round(mean, 1), round(mean + half, 1)]
            one, other = low_high.values()
            overlaps.append(one[0] <= other[2] and other[0] <= one[2])
            success.setdefault(arm, {})[steps] = low_high | {"overlap": overlaps[-1]}
    seeds = {version: len(next(iter(points[ARMS[0]].values()))) for version, points in curves.items()}
    report({"seeds": seeds, "points": len(overlaps), "points_that_overlap": sum(overlaps), "success": success})


def curve(run: Path) -> dict[str, dict[int, list[float]]]:
    """Return success in percent of seeds, by arm and steps."""
    points: dict[str, dict[int, list[float]]] = {arm: defaultdict(list) for arm in ARMS}
    for line in (run / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        points[row["arm"]][row["env_steps"]].append(100 * row["success"])
    return points


def interval(values: list[float]) -> tuple[float, float]:
    """Return mean and half its 95 % interval."""
    deviation = statistics.stdev(values) / len(values) ** 0.5
    return statistics.mean(values), float(t.ppf(0.975, len(values) - 1)) * deviation


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:3]))
