"""Decision shares of every method, with the settings of version 0.3 and with the default ones.

`python benchmarks/decision_shares.py [FOLDER] [--methods org ...] [--seeds N] [--total-steps N]` trains both arms of
every method in rooms and evaluates them on 400 episodes in val scenes. A row holds, for best actions, the percentage of
decisions that change when a part becomes that of another episode (`jaxnav.evaluation.decision_share`), and the points
of SPL that this costs, where it is measured.

Runs are stored in FOLDER, by default a temporary one, and a repeated command uses those that are finished. The result
goes to stdout as JSON, the table to stderr.
"""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path
from typing import Any

from _common import SEMEXP_PPO, print_report

import jaxnav
from jaxnav.training.config import PPOConfig

METHODS = ("rgb", "sp", "savn", "eotp", "org", "tpn", "vtnet", "hoz", "semexp")
#: Version 0.3: raw weights, every detection in the direct pathway; there was no guidance.
SETTINGS = ("0.3", "default")
NUM_EPISODES = 400
PARTS = ("other_categories", "experience", "prior_weights", "uniform_weights", "scene_and_goal", "memory")


def main(folder: Path, methods: list[str], seeds: int, total_steps: int) -> None:
    rows = []
    for method in methods:
        for setting in SETTINGS:
            run = jaxnav.train(make_config(folder, method, setting, seeds, total_steps))
            report = jaxnav.evaluate(run, episodes=NUM_EPISODES).report
            for row in collect_share_rows(report, method, setting):
                rows.append(row)
                print(format_row(row), file=sys.stderr, flush=True)
    print("\n".join([*format_header(), *map(format_row, rows)]), file=sys.stderr)
    print_report({"seeds": seeds, "total_steps": total_steps, "episodes": NUM_EPISODES, "rows": rows})


def make_config(folder: Path, method: str, setting: str, seeds: int, total_steps: int) -> jaxnav.RunConfig:
    """Return the settings of a run of a method."""
    config = jaxnav.RunConfig(
        run_dir=folder / f"{method}-{setting}",
        method=method,
        seeds=seeds,
        total_steps=total_steps,
        validations=1,
        ppo=SEMEXP_PPO if method == "semexp" else PPOConfig(),
    )
    if setting == "0.3":
        layout = dataclasses.replace(config.layout, weights="raw")
        ppo = dataclasses.replace(config.ppo, guidance=0.0)
        config = dataclasses.replace(config, direct="all", layout=layout, ppo=ppo)
    return config


def collect_share_rows(report: dict[str, Any], method: str, setting: str) -> list[dict[str, Any]]:
    """Return a row for each arm with best actions: success, and share, partner difference and cost of each part."""
    rows = []
    for table_row in report["rows"]:
        variant = table_row["variant"]
        if table_row["decoding"] != "argmax" or variant not in ("baseline", "layout"):
            continue
        row = {"method": method, "setting": setting, "variant": variant, "sr": table_row["sr"], "parts": {}}
        for entry in report["decision_shares"]:
            if (entry["variant"], entry["decoding"]) == (variant, "argmax"):
                row["parts"][entry["part"]] = {name: entry[name] for name in ("share", "partner_difference", "cost")}
        rows.append(row)
    return rows


def format_header() -> list[str]:
    """Return the first two lines of the table."""
    names = ["SR", *PARTS, "cost of other categories in SPL"]
    return [f"| method | settings | variant | {' | '.join(names)} |", "| --- | --- | --- |" + " ---: |" * len(names)]


def format_row(row: dict[str, Any]) -> str:
    """Return a line of the table in Markdown."""
    cells = [row["method"], row["setting"], row["variant"], f"{row['sr']['mean']:.1f}"]
    for part in PARTS:
        entry = row["parts"].get(part)
        cells.append("-" if entry is None else f"{entry['share']['mean']:.1f}")
    cost = row["parts"]["other_categories"]["cost"]["spl"]
    low, high = cost["ci95"]
    cells.append(f"{cost['mean']:+.1f} [{low:+.1f}, {high:+.1f}]")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--total-steps", type=int, default=600_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary_folder:
        main(options.folder or Path(temporary_folder), options.methods, options.seeds, options.total_steps)
