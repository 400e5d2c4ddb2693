"""Value of experience to the search by belief, its cost under a layout shift, and the effect of removal.

`python benchmarks/belief_search.py RUN [RUN ...] [--split val] [--episodes 240] [--shift 0 1] [--shift-by context]
[--gap surprise] [--rows layout sTDE mixture] [--ablations] [--perfect-detector]` evaluates runs of the method `belief`,
or of a method with another predictor, with best actions on equal episodes. Rows of each run:

  nearest  the local policy alone, which walks to the nearest unexplored cell
  flat     all squares are equally likely, except for looks in vain
  places   complete removal of experience (eq. 1): the search by places alone
  layout   the complete belief
  sTDE     removal by eq. 2 in the paper's form with epsilon 0, weighed by the gap of `--gap`
  mixture  the mixture of both beliefs (`--form mixture`), weighed by the same gap

With `--ablations` also the complete belief without some of its parts, which are not fitted anew: `no looks`, without
looks in vain; `no R m weights`, without the weights of one radius of `LogLinear`; and `no categories`, with the floor
alone by goal. `plan for every action` is the complete belief with a new target after each action. With
`--perfect-detector`, all rows are evaluated with a detector that makes no errors; the fits stay.

Intervals are over floor plans and fits; those of differences are also given for these fits alone, `(these fits)`. The
result goes to stdout as JSON, the tables to stderr.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report

from jaxnav.choices import EstimatorName, ShiftKind
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import join_episode_lists
from jaxnav.evaluation.grid import Evaluator, episode_metrics
from jaxnav.evaluation.statistics import Clusters, Interval, mean_interval, paired_difference
from jaxnav.evaluation.variants import EvaluationRow, table_row
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.methods.belief import TargetControl
from jaxnav.policies.methods.belief_map import RADII
from jaxnav.policies.methods.map_tracker import SQUARE_CELLS
from jaxnav.runs.evaluate import evaluate_rows
from jaxnav.runs.policies import Policies
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR

#: (base, variant) pairs whose difference is reported; those of ablations follow.
PAIRS = (
    ("nearest", "layout"),
    ("flat", "layout"),
    ("flat", "places"),
    ("places", "layout"),
    ("layout", "sTDE"),
    ("places", "sTDE"),
    ("layout", "mixture"),
    ("sTDE", "mixture"),
)
BUDGETS = (50, 150)
#: Rows of the complete belief and of its removals, by name.
BELIEF_ROWS = {
    "places": table_row("tde", None, None, "argmax"),
    "layout": table_row("layout", None, None, "argmax"),
    "sTDE": table_row("stde", 0.0, "paper", "argmax"),
    "mixture": table_row("stde", 0.0, "mixture", "argmax"),
}
ROW_NAMES = ("nearest", "flat", *BELIEF_ROWS)
#: Metrics [S, E] by name.
Metrics = dict[str, np.ndarray]


def main(
    run_dirs: Sequence[str],
    split: str,
    num_episodes: int,
    shifts: Sequence[float],
    shift_by: ShiftKind,
    gap: EstimatorName,
    row_names: Sequence[str],
    has_ablations: bool,
    has_perfect_detector: bool,
) -> None:
    results = []
    for run_dir in run_dirs:
        run = Run.open(run_dir)
        policies = run.policies(("layout",)).with_estimator(gap)
        for shift in shifts:
            console = PlainConsole(stderr=True)
            config = run.config
            if has_perfect_detector:
                config = dataclasses.replace(config, detector=PERFECT_DETECTOR)
            compiled_world = compile_evaluation_world(config, split, None, shift, console, shift_by=shift_by)
            result = measure_run(policies, compiled_world, num_episodes, row_names, has_ablations)
            result |= {"run": Path(run_dir).name, "method": run.config.method, "shift": shift}
            print(format_table(result), file=sys.stderr, flush=True)
            results.append(result)
    settings = {"split": split, "episodes": num_episodes, "shift_by": shift_by, "gap": gap, "rows": list(row_names)}
    settings["perfect_detector"] = has_perfect_detector
    print_report(settings | {"results": results})


def measure_run(
    policies: Policies, compiled_world: CompiledWorld, num_episodes: int, row_names: Sequence[str], has_ablations: bool
) -> dict[str, Any]:
    """Measure rows of a run in one world.

    Args:
      policies: policies of the arm `layout`, one for each fit.
      compiled_world: compiled scenes.
      num_episodes: number of episodes.
      row_names: rows to measure, among `ROW_NAMES`; `layout` is always measured.
      has_ablations: whether the search without some of its parts is measured too.
    """
    layout_row = BELIEF_ROWS["layout"]
    evaluator = Evaluator(policies.make_agent_loop(compiled_world), has_controls=False)
    metrics: dict[str, Metrics] = {}

    # The nearest frontier does not depend on the fit.
    if "nearest" in row_names:
        nearest_policies = with_control(policies, use_nearest_frontier=True)
        nearest_policies = nearest_policies._replace(params=jax.tree.map(lambda leaf: leaf[:1], policies.params))
        nearest_metrics, _ = measure_rows({"nearest": layout_row}, nearest_policies, compiled_world, num_episodes)
        metrics["nearest"] = {}
        for metric, values in nearest_metrics["nearest"].items():
            metrics["nearest"][metric] = np.repeat(values, policies.num_seeds, axis=0)

    # Rows of other parameters share the compilation.
    if "flat" in row_names:
        flat_policies = with_zeros(policies, "places", "method")
        metrics |= measure_rows({"flat": layout_row}, flat_policies, compiled_world, num_episodes, evaluator)[0]
    belief_rows = {name: row for name, row in BELIEF_ROWS.items() if name == "layout" or name in row_names}
    belief_metrics, clusters = measure_rows(belief_rows, policies, compiled_world, num_episodes, evaluator)
    metrics |= belief_metrics
    pairs = [pair for pair in PAIRS if set(pair) <= set(metrics)]
    if has_ablations:
        for name, ablated_policies in ablate(policies).items():
            metrics |= measure_rows({name: layout_row}, ablated_policies, compiled_world, num_episodes, evaluator)[0]
            pairs.append(("layout", name))
        name = "plan for every action"
        metrics |= measure_rows({name: layout_row}, with_control(policies, interval=1), compiled_world, num_episodes)[0]
        pairs.append(("layout", name))
    return summarize(metrics, clusters, pairs)


def measure_rows(
    rows: Mapping[str, EvaluationRow],
    policies: Policies,
    compiled_world: CompiledWorld,
    num_episodes: int,
    evaluator: Evaluator | None = None,
) -> tuple[dict[str, Metrics], Clusters]:
    """Run rows by name; returns their metrics in percent, and the clusters of the episodes."""
    episode_lists, outcome, _ = evaluate_rows(list(rows.values()), policies, compiled_world, num_episodes, 0, evaluator)
    episodes = join_episode_lists(episode_lists)
    metrics = episode_metrics(outcome, episodes.best_length, BUDGETS)
    metrics_by_row = {}
    for index, name in enumerate(rows):
        row_metrics = {}
        for metric in ("spl", "sr", *(f"sr@{budget}" for budget in BUDGETS)):
            row_metrics[metric] = 100.0 * metrics[metric][index]
        metrics_by_row[name] = row_metrics
    return metrics_by_row, episodes.clusters()


def with_zeros(policies: Policies, *groups: str) -> Policies:
    """Policies whose parameters in some groups are zero."""
    zeros = {group: jax.tree.map(jnp.zeros_like, policies.params[group]) for group in groups}
    return policies._replace(params=policies.params | zeros)


def ablate(policies: Policies) -> dict[str, Policies]:
    """Policies without some of their parts, by name."""
    ablated_policies = {"no looks": with_zeros(policies, "detection_rates")}
    predictor_params = policies.params["method"]
    if "relations" in predictor_params:  # those of `LogLinear`, [S, K, R, K]
        relations = predictor_params["relations"]
        for radius_index, radius in enumerate(RADII):
            radius_m = radius * SQUARE_CELLS * CELL_SIZE
            without_radius = relations.at[:, :, radius_index].set(0.0)
            ablated_policies[f"no {radius_m:g} m weights"] = _with_relations(policies, without_radius)
        ablated_policies["no categories"] = _with_relations(policies, jnp.zeros_like(relations))
    return ablated_policies


def _with_relations(policies: Policies, relations: jax.Array) -> Policies:
    """Policies with other weights of the categories nearby."""
    predictor_params = policies.params["method"] | {"relations": relations}
    return policies._replace(params=policies.params | {"method": predictor_params})


def with_control(policies: Policies, **settings: Any) -> Policies:
    """Policies whose local policy has other settings."""
    method = dataclasses.replace(policies.spec.method, control=TargetControl(**settings))
    return policies._replace(spec=dataclasses.replace(policies.spec, method=method))


def summarize(metrics: Mapping[str, Metrics], clusters: Clusters, pairs: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Means of all rows, and differences of (base, variant) pairs, with intervals."""
    rows: dict[str, Any] = {}
    for name, row_metrics in metrics.items():
        rows[name] = {}
        for metric, values in row_metrics.items():
            rows[name][metric] = mean_interval(values, clusters).to_json()
    differences: dict[str, Any] = {}
    fixed_differences: dict[str, Any] = {}
    for base, variant in pairs:
        label = f"{variant} - {base}"
        differences[label] = {}
        fixed_differences[f"{label} (these fits)"] = {}
        for metric in metrics[base]:
            pair = metrics[base][metric], metrics[variant][metric]
            over_fits = paired_difference(*pair, clusters, same_runs=True)
            these_fits = paired_difference(*pair, clusters, trained=False)
            differences[label][metric] = over_fits.to_json()
            fixed_differences[f"{label} (these fits)"][metric] = these_fits.to_json()
    return {"rows": rows, "differences": differences | fixed_differences}


def format_table(result: dict[str, Any]) -> str:
    """Return the results of a run in one world in Markdown."""
    names = list(next(iter(result["rows"].values())))
    title = f"{result['run']}, shift {result['shift']:g}"
    lines = [f"| {title} | {' | '.join(name.upper() for name in names)} |", "| --- |" + " ---: |" * len(names)]
    for label, row in (result["rows"] | result["differences"]).items():
        number_format = "+.1f" if " - " in label else ".1f"
        cells = [f"{Interval.from_json(row[name]):{number_format}}" for name in names]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--split", default="val")
    parser.add_argument("--episodes", type=int, default=240)
    parser.add_argument("--shift", type=float, nargs="+", default=[0.0, 1.0])
    parser.add_argument("--shift-by", choices=get_args(ShiftKind), default="context")
    parser.add_argument("--gap", choices=get_args(EstimatorName), default="surprise")
    parser.add_argument("--rows", choices=ROW_NAMES, nargs="+", default=list(ROW_NAMES), help="always with `layout`")
    parser.add_argument("--ablations", action="store_true")
    parser.add_argument("--perfect-detector", action="store_true")
    options = parser.parse_args()
    try:
        main(
            options.runs,
            options.split,
            options.episodes,
            options.shift,
            options.shift_by,
            options.gap,
            options.rows,
            options.ablations,
            options.perfect_detector,
        )
    except InputError as error:
        sys.exit(f"error: {error}")
