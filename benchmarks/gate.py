"""Fail if the environment has become much slower than a bare gather of its rows.

`python benchmarks/environment.py | python benchmarks/gate.py STORED` compares the ratios of a new report with those of
a stored one. Both rates of a ratio are timed in turns in one process, so that the machine and its load matter little;
`MIN_SHARE` leaves room for the rest.
"""

import json
import sys
from pathlib import Path

#: Least share of the stored ratio.
MIN_SHARE = 0.5


def main(stored_report: Path) -> bool:
    """Print every ratio and return whether all are high enough."""
    stored_ratios = json.loads(stored_report.read_text())["over_gather"]
    new_ratios = json.load(sys.stdin)["over_gather"]

    all_passed = True
    for name, stored_ratio in stored_ratios.items():
        new_median = new_ratios[name]["median"]
        share = new_median / stored_ratio["median"]
        passed = share >= MIN_SHARE
        all_passed = all_passed and passed
        verdict = "ok" if passed else "TOO SLOW"
        print(f"{name}: {new_median:.3f} of a gather, {share:.2f} of what is stored: {verdict}")
    return all_passed


if __name__ == "__main__":
    sys.exit(not main(Path(sys.argv[1])))
