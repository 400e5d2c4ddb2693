"""Search for a recipe of training by successive halving.

`python benchmarks/recipe.py SEARCH.yaml [FOLDER]` trains every candidate of the file for the steps of the first rung,
selects those with the highest val success (best actions, mean over seeds, of the policies that would be exported), and
continues with these in the next rung. The candidates that remain after the last rung, and those that `also` names, are
trained with seeds that no rung has used: quote these figures, since the selection biases those of the rungs. Runs are
stored in FOLDER, by default a temporary one; an interrupted search continues there. The result goes to stdout as JSON,
the tables to stderr.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from _common import print_report, run_in_folder

import jaxnav
from jaxnav.runs.config_files import apply_values

#: Heading of each measure of the selected policies, by its name in the log.
MEASURES = {
    "val_success": "SR best",
    "val_success_sampled": "SR sampled",
    "val_spl": "SPL best",
    "val_timeout": "time-out",
    "val_wrong_done": "wrong Done",
}


def main(search_file: Path, folder: Path) -> None:
    search = yaml.safe_load(search_file.read_text())
    base = apply_values(jaxnav.RunConfig(), search["base"], search_file)
    candidates = {name: apply_values(base, changes, search_file) for name, changes in search["candidates"].items()}

    # The confirmation is a last rung that selects nothing.
    remaining = candidates
    tables = {}
    for number, rung in enumerate([*search["rungs"], search["confirm"]], start=1):
        num_selected = rung.get("keep")
        remaining = remaining | {name: candidates[name] for name in rung.get("also", [])}
        settings = {name: value for name, value in rung.items() if name not in ("keep", "also")}
        stage = "confirm" if num_selected is None else f"rung {number}"

        rows = {}
        for name, config in remaining.items():
            run_dir = folder / f"{stage}-{name}"
            rows[name] = train_and_measure(dataclasses.replace(config, **settings, run_dir=run_dir))
        ranked_names = sorted(rows, key=lambda name: -rows[name]["val_success"])
        tables[stage] = {name: rows[name] for name in ranked_names}
        print(format_table(stage, tables[stage]), file=sys.stderr, flush=True)
        remaining = {name: remaining[name] for name in ranked_names[:num_selected]}
    print_report({"search": search, "tables": tables})


def train_and_measure(config: jaxnav.RunConfig) -> dict[str, float]:
    """Train, and return the mean measures of the policies that would be exported, in percent."""
    run = jaxnav.train(config)
    measurements = [row for row in run.log() if "val_success" in row]
    best_rows = []
    for seed in range(config.seeds):
        seed_rows = [row for row in measurements if row["seed"] == seed]
        best_rows.append(max(seed_rows, key=rank_measurement))

    means = {}
    for name in MEASURES:
        means[name] = round(100 * float(np.mean([row[name] for row in best_rows])), 1)
    deviation = float(np.std([row["val_success"] for row in best_rows], ddof=1))
    cpu_s = run.times()[-1]["cpu_s"] / config.seeds
    print(config.run_dir.name, means, f"{cpu_s:.0f} s", file=sys.stderr, flush=True)
    return means | {"sd": round(100 * deviation, 1), "cpu_s": cpu_s}


def rank_measurement(row: dict[str, Any]) -> tuple[float, int]:
    """Return a sort key that orders measurements as training does: a later one wins a tie."""
    return row["val_success"], row["step"]


def format_table(stage: str, rows: dict[str, dict[str, float]]) -> str:
    """Return the results of a stage in Markdown."""
    lines = [f"| {stage} | {' | '.join(MEASURES.values())} | CPU s a policy |", "| --- |" + " ---: |" * 6]
    for name, row in rows.items():
        cells = " | ".join(f"{row[measure]:.1f}" for measure in MEASURES)
        lines.append(f"| {name} | {cells} | {row['cpu_s']:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    run_in_folder(main)
