"""Search for a recipe of training by successive halving.

`python benchmarks/recipe.py SEARCH.yaml [FOLDER]` trains every candidate of the file for the steps of the first rung,
keeps those with the highest val success (best actions, mean over seeds, of the policies that would be exported), and
goes on with these in the next rung. What is left, and what `also` names, is trained with seeds that no rung has used:
these figures are the ones to quote, since the others were looked at to choose. Runs are kept in FOLDER, by default a
temporary one; an interrupted search goes on there. The result goes to stdout as JSON, the tables to stderr.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from _common import in_folder, report

import jaxnav
from jaxnav.runs.overlay import apply_values

#: Of the measurement that chooses: name in the log to heading.
MEASURES = {
    "val_success": "SR best",
    "val_success_sampled": "SR sampled",
    "val_spl": "SPL best",
    "val_timeout": "time-out",
    "val_wrong_done": "wrong Done",
}


def main(search: Path, folder: Path) -> None:
    given = yaml.safe_load(search.read_text())
    base = apply_values(jaxnav.RunConfig(), given["base"], search)
    candidates = {name: apply_values(base, changes, search) for name, changes in given["candidates"].items()}
    left, tables = candidates, {}
    for number, rung in enumerate([*given["rungs"], given["confirm"]]):
        keep, also = rung.get("keep"), rung.get("also", [])
        settings = {name: value for name, value in rung.items() if name not in ("keep", "also")}
        left = left | {name: candidates[name] for name in also}
        stage = "confirm" if keep is None else f"rung {number + 1}"
        rows = {
            name: measured(dataclasses.replace(config, **settings, run_dir=folder / f"{stage}-{name}"))
            for name, config in left.items()
        }
        ranked = sorted(rows, key=lambda name: -rows[name]["val_success"])
        tables[stage] = {name: rows[name] for name in ranked}
        print(table(stage, tables[stage]), file=sys.stderr, flush=True)
        left = {name: left[name] for name in ranked[:keep]}
    report({"search": given, "tables": tables})


def measured(config: jaxnav.RunConfig) -> dict[str, float]:
    """Train and return the measures of the kept policies, in percent."""
    run = jaxnav.train(config)
    rows = [row for row in run.log() if "val_success" in row]
    chosen = [max((row for row in rows if row["seed"] == seed), key=order) for seed in range(config.seeds)]
    means = {name: round(100 * float(np.mean([row[name] for row in chosen])), 1) for name in MEASURES}
    cpu = run.times()[-1]["cpu_s"] / config.seeds
    print(config.run_dir.name, means, f"{cpu:.0f} s", file=sys.stderr, flush=True)
    return means | {"sd": round(100 * float(np.std([row["val_success"] for row in chosen], ddof=1)), 1), "cpu_s": cpu}


def order(row: dict[str, Any]) -> tuple[float, int]:
    """Order the measurements as training does: a later one wins a tie."""
    return row["val_success"], row["step"]


def table(stage: str, rows: dict[str, dict[str, float]]) -> str:
    """Return the results of a stage in Markdown."""
    lines = [f"| {stage} | {' | '.join(MEASURES.values())} | CPU s a policy |", "| --- |" + " ---: |" * 6]
    for name, row in rows.items():
        cells = " | ".join(f"{row[measure]:.1f}" for measure in MEASURES)
        lines.append(f"| {name} | {cells} | {row['cpu_s']:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    in_folder(main)
