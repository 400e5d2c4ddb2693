"""Fail where the environment has become much slower beside a bare gather of its rows.

`python benchmarks/environment.py | python benchmarks/gate.py STORED` compares the ratios of a new report with those of
a stored one. Both rates of a ratio are timed in turns in one process, so that the machine and its load matter little;
`LEAST` leaves room for the rest.
"""

import json
import sys
from pathlib import Path

LEAST = 0.5  # of the stored ratio


def main(stored: Path) -> bool:
    expected, found = (report["over_gather"] for report in (json.loads(stored.read_text()), json.load(sys.stdin)))
    kept = {name: found[name]["median"] / ratio["median"] for name, ratio in expected.items()}
    for name, share in kept.items():
        verdict = "ok" if share >= LEAST else "TOO SLOW"
        print(f"{name}: {found[name]['median']:.3f} of a gather, {share:.2f} of what is stored: {verdict}")
    return min(kept.values()) >= LEAST


if __name__ == "__main__":
    sys.exit(not main(Path(sys.argv[1])))
