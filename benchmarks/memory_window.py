"""What the moving window of the spatial memory changes in large homes.

`python benchmarks/memory_window.py RUN [RUN ...] [--split val] [--episodes 1000] [--min-cells 54]` evaluates runs
twice with best actions on equal episodes in homes longer than `--min-cells` cells: with the spatial memory as it is, a
window that forgets cells beyond half its size, and with a torus that never forgets, on which cells that are 64 cells
apart coincide. The view is ten cells deep, so in shorter homes both are alike.

Runs are folds of one study, so their episodes are joined. Intervals are over floor plans and training seeds. The result
goes to stdout as JSON.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence

import jax
import numpy as np
from _common import print_report

from jaxnav.errors import InputError
from jaxnav.evaluation.grid import episode_metrics
from jaxnav.evaluation.statistics import mean_interval, paired_difference, scene_clusters
from jaxnav.evaluation.variants import table_row
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.runs.evaluate import evaluate_rows
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.scenes.scene import CELL_SIZE, Scene, scene_size

METRICS = ("sr", "spl")


def main(run_dirs: Sequence[str], split: str, num_episodes: int, min_cells: int) -> None:
    values: dict[str, dict[str, list[np.ndarray]]] = {}
    floor_plans: list[np.ndarray] = []
    for run_dir in run_dirs:
        run = Run.open(run_dir)
        policies = run.policies(("layout",))
        compiled_world = compile_evaluation_world(run.config, split, None, None, PlainConsole(stderr=True))
        home_sizes = {scene.name: longest_side(scene) for scene in compiled_world.scenes}
        row = table_row("layout", None, None, "argmax")
        assert policies.spec.spatial_memory is not None
        torus = TorusMemory(**dataclasses.asdict(policies.spec.spatial_memory))
        torus_policies = policies._replace(spec=dataclasses.replace(policies.spec, spatial_memory=torus))
        for memory_name, memory_policies in (("window", policies), ("torus", torus_policies)):
            episode_lists, outcome, _ = evaluate_rows([row], memory_policies, compiled_world, num_episodes, 0)
            [episodes] = episode_lists
            metrics = episode_metrics(outcome, episodes.best_length, ())

            # Keep the episodes in long homes.
            is_long = np.array([home_sizes[name] > min_cells for name in episodes.scenes])[episodes.scene]
            for metric in METRICS:
                metric_values = 100.0 * np.asarray(metrics[metric])[0][:, is_long]
                values.setdefault(memory_name, {}).setdefault(metric, []).append(metric_values)
        floor_plans.append(episodes.floor_plans[is_long])

    plans = np.concatenate(floor_plans)
    print_report({"split": split, "min_cells": min_cells, "episodes": len(plans)} | summarize(values, plans))


class TorusMemory(SpatialMemory):
    """Spatial memory that forgets nothing, as before version 0.4."""

    def _forget_left_cells(self, cells: jax.Array, position: jax.Array, step: jax.Array) -> jax.Array:
        """Keep all cells."""
        return cells


def longest_side(scene: Scene) -> float:
    """Longest side of a home in cells."""
    return float(scene_size(scene).max() / CELL_SIZE)


def summarize(values: dict[str, dict[str, list[np.ndarray]]], floor_plans: np.ndarray) -> dict[str, dict[str, str]]:
    """Means of both memories and the gain of the window over the torus, with intervals, in percentage points."""
    # Homes have no room types, so floor plans form one stratum.
    clusters = scene_clusters(floor_plans, np.zeros(len(floor_plans), int))
    table: dict[str, dict[str, str]] = {"window": {}, "torus": {}, "window - torus": {}}
    for metric in METRICS:
        joined = {name: np.concatenate(parts[metric], axis=1) for name, parts in values.items()}
        for name, joined_values in joined.items():
            table[name][metric] = f"{mean_interval(joined_values, clusters):.1f}"
        difference = paired_difference(joined["torus"], joined["window"], clusters, same_runs=True)
        table["window - torus"][metric] = f"{difference:+.1f}"
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--split", default="val")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--min-cells", type=int, default=54)
    options = parser.parse_args()
    try:
        main(options.runs, options.split, options.episodes, options.min_cells)
    except InputError as error:
        sys.exit(f"error: {error}")
