"""Does every method still learn? Success after a short training, against a stored band.

`python benchmarks/regression.py [METHOD ...]` trains each method (all unless some are named) in rooms for `TOTAL_STEPS`
with the seeds `CHECK_SEEDS`, prints mean success in val scenes beside its band, and ends with code 1 if a mean leaves
it. `--record` measures bands: five other seeds give mean and standard deviation, and the band is the interval in which
the mean of the checked seeds lies with a probability of 99 % if nothing has changed.

Success is that of sampled actions in 1,000 episodes. Bands are stored one by one in `results/regression.json`, so an
interrupted recording goes on with the next method. The method `belief` is fitted to searches and has checks of its own
(`tests/policies`).
"""

import argparse
import json
import math
import statistics
import sys
import tempfile
from pathlib import Path

from _common import ROOT
from scipy.stats import t

import jaxnav
from jaxnav.policies.methods import METHODS
from jaxnav.runs.config import RunConfig

TOTAL_STEPS = 400_000
BAND_SEEDS = (0, 1, 2, 3, 4)
CHECK_SEEDS = (5, 6)
CONFIDENCE = 0.99
BANDS_FILE = ROOT / "results" / "regression.json"
#: Methods of this package that PPO trains, and the variant of EOTP that adapts.
CHECKED_METHODS = (
    *(name for name, method in METHODS.items() if method.fit is None),
    "jaxnav.policies.methods.eotp:ADAPTED",
)


def main() -> bool:
    """Check or record bands, and return whether all methods are within theirs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("methods", nargs="*", metavar="METHOD")
    parser.add_argument("--record", action="store_true", help="measure and store bands that are not stored yet")
    options = parser.parse_args()
    methods = options.methods or CHECKED_METHODS

    bands = json.loads(BANDS_FILE.read_text()) if BANDS_FILE.exists() else {}
    if options.record:
        record_bands(methods, bands)
        return True

    all_within = True
    print("| method | success | band | |\n| --- | ---: | ---: | --- |")
    for name in methods:
        if name not in bands:
            print(f"{name}: no band; record one by --record {name}", file=sys.stderr)
            all_within = False
            continue
        success = statistics.mean(measure_success(name, seed) for seed in CHECK_SEEDS)
        low, high = bands[name]["band"]
        is_within = low <= success <= high
        all_within = all_within and is_within
        verdict = "" if is_within else "outside"
        print(f"| {name} | {success:.1f} | {low:.1f} to {high:.1f} | {verdict} |", flush=True)
    return all_within


def record_bands(methods: list[str] | tuple[str, ...], bands: dict) -> None:
    """Measure the bands that are not stored yet, and store each at once."""
    for name in methods:
        if name in bands:
            continue
        successes = [measure_success(name, seed) for seed in BAND_SEEDS]
        bands[name] = {"success": successes, "band": compute_band(successes)}
        print(name, bands[name], file=sys.stderr, flush=True)
        BANDS_FILE.write_text(json.dumps(bands, indent=2) + "\n")


def compute_band(successes: list[float]) -> list[float]:
    """Return the prediction interval of the mean of further runs, within 0 to 100 %."""
    mean = statistics.mean(successes)
    deviation = statistics.stdev(successes)
    quantile = float(t.ppf(0.5 + CONFIDENCE / 2, len(successes) - 1))
    half_width = quantile * deviation * math.sqrt(1 / len(successes) + 1 / len(CHECK_SEEDS))
    return [round(max(0.0, mean - half_width), 2), round(min(100.0, mean + half_width), 2)]


def measure_success(name: str, seed: int) -> float:
    """Return the success in val scenes, in percent, of one policy after a short training."""
    with tempfile.TemporaryDirectory() as folder:
        run = jaxnav.train(
            RunConfig(
                method=name,
                arms=("baseline",),
                seeds=1,
                seed=seed,
                total_steps=TOTAL_STEPS,
                validations=1,
                val_episodes=1000,
                run_dir=Path(folder) / "run",
            )
        )
        return round(100 * run.log()[-1]["val_success_sampled"], 2)


if __name__ == "__main__":
    sys.exit(not main())
