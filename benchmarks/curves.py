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

from _common import print_report
from scipy.stats import t

ARMS = ("baseline", "layout")


def main(run_before: Path, run_after: Path) -> None:
    curves = {"before": read_curves(run_before), "after": read_curves(run_after)}

    success = {}
    overlaps = []
    for arm in ARMS:
        success[arm] = {}
        for num_steps in sorted(curves["after"][arm]):
            # Interval of each version: low, mean, high.
            intervals = {}
            for version, curve in curves.items():
                mean, half_width = mean_and_half_width(curve[arm][num_steps])
                intervals[version] = [round(mean - half_width, 1), round(mean, 1), round(mean + half_width, 1)]
            low_before, _, high_before = intervals["before"]
            low_after, _, high_after = intervals["after"]
            overlap = low_before <= high_after and low_after <= high_before
            overlaps.append(overlap)
            success[arm][num_steps] = intervals | {"overlap": overlap}

    num_seeds = {version: len(next(iter(curve[ARMS[0]].values()))) for version, curve in curves.items()}
    print_report(
        {"seeds": num_seeds, "points": len(overlaps), "points_that_overlap": sum(overlaps), "success": success}
    )


def read_curves(run: Path) -> dict[str, dict[int, list[float]]]:
    """Return the success rates of all seeds in percent, by arm and environment steps."""
    curves: dict[str, dict[int, list[float]]] = {arm: defaultdict(list) for arm in ARMS}
    for line in (run / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        curves[row["arm"]][row["env_steps"]].append(100 * row["success"])
    return curves


def mean_and_half_width(values: list[float]) -> tuple[float, float]:
    """Return the mean and half the width of its 95 % interval."""
    standard_error = statistics.stdev(values) / len(values) ** 0.5
    return statistics.mean(values), float(t.ppf(0.975, len(values) - 1)) * standard_error


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:3]))
