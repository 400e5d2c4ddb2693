"""Value of the layout to a planner: the same search with and without a prior.

`python benchmarks/layout_value.py [WORLD or SCENE FILE ...] [--scenes 48] [--episodes 320] [--shift 0]
[--shift-by size] [--random-exchanges 0] [--goals CATEGORY ...]` searches in the scenes of generated worlds (all three
without arguments) and of scene files. Every scene is searched with a prior fitted to other scenes, without a shift: the
scenes are divided into folds by floor plan, within room types. An exchange by context is fitted to the other folds too.
With `--random-exchanges N`, the searches are repeated with N random exchanges of the same categories, in homes. The
detector makes no errors. Rows:

  flat    all sites are equally likely
  places  knows where objects stand at all (on furniture, at walls), but tells no category from another
  layout  knows what stands where and near what

Intervals are over floor plans. The result goes to stdout as JSON, the tables to stderr.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from _common import print_report

from jaxnav.baselines.layout_model import (
    LayoutModel,
    PlannerSnapshot,
    detection_counts,
    estimate_detection_rates,
    fit_layout_model,
    uniform_layout_model,
)
from jaxnav.baselines.planner import PlannerScene, SearchResult, search_for_goal
from jaxnav.baselines.sites import find_sites
from jaxnav.choices import ShiftKind
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.statistics import Clusters, Interval, mean_interval, paired_difference, scene_clusters
from jaxnav.scenes.context_exchange import ContextExchange, draw_exchange, fit_context_exchange
from jaxnav.scenes.lattice import pose_successors
from jaxnav.scenes.layout_shift import exchange_places
from jaxnav.scenes.scene import Scene, floor_plan_name
from jaxnav.scenes.tables.compile import Bank, compile_scene, join_scenes
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, World, load_scenes, make_generated_scenes, world_name_of_origin

NUM_FOLDS = 4
#: (base, variant) pairs whose difference is reported.
PAIRS = (("flat", "layout"), ("places", "layout"))


class SearchWorld(NamedTuple):
    """Compiled scenes of a world with a list of episodes.

    Attributes:
      world: definition of the world, with its step limits and budgets.
      bank: tables of the scenes.
      scenes: the S scenes.
      planner_scenes: the S scenes as the planner needs them.
      fold: int [S], fold of each scene.
      episodes: the E episodes.
    """

    world: World
    bank: Bank
    scenes: list[Scene]
    planner_scenes: list[PlannerScene]
    fold: np.ndarray
    episodes: EpisodeList


def main(
    sources: Sequence[str],
    num_scenes: int,
    num_episodes: int,
    shift: float,
    shift_by: ShiftKind,
    num_random_exchanges: int,
    goals: Sequence[str],
) -> None:
    results = {}
    for source in sources:
        name = Path(source).name
        training_world = compile_search_world(source, num_scenes, num_episodes, goals)
        priors = fit_priors(training_world)
        search_world = shift_search_world(training_world, shift, shift_by, num_episodes)
        results[name] = compare_priors(priors, search_world)
        print(format_table(name, results[name]), file=sys.stderr, flush=True)

        # Random exchanges are measured beside the one of `--shift-by`.
        random_results = []
        for seed in range(num_random_exchanges):
            exchange = draw_exchange(training_world.scenes, training_world.bank.task, seed)
            random_world = exchange_search_world(training_world, [exchange] * NUM_FOLDS, shift, num_episodes)
            random_results.append(compare_priors(priors, random_world)["differences"])
            print(format_differences(f"random exchange {seed}", random_results[-1]), file=sys.stderr, flush=True)
        if random_results:
            results[name]["random_exchanges"] = random_results
    print_report({"shift": shift, "shift_by": shift_by, "goals": list(goals), "worlds": results})


# Scenes


def compile_search_world(source: str, max_scenes: int, num_episodes: int, goals: Sequence[str]) -> SearchWorld:
    """Compile scenes without a shift and draw episodes.

    Args:
      source: name of a generated world, or scene file.
      max_scenes: number of scenes, evenly spread over a file.
      num_episodes: E.
      goals: categories to search for; those of the world if empty.
    """
    if source in WORLDS:
        all_scenes = make_generated_scenes(source, "train", max_scenes)
        world = WORLDS[source]
    else:
        all_scenes = load_scenes(source, None)
        world = WORLDS[world_name_of_origin(all_scenes[0].world)]
    task = dataclasses.replace(world.task, detector=PERFECT_DETECTOR, goals=tuple(goals) or world.task.goals)
    indices = np.unique(np.linspace(0, len(all_scenes) - 1, max_scenes).astype(int))
    scenes = [all_scenes[int(index)] for index in indices]
    return prepare_search(scenes, world, task, assign_folds(scenes), num_episodes)


def shift_search_world(
    training_world: SearchWorld, shift: float, shift_by: ShiftKind, num_episodes: int
) -> SearchWorld:
    """Shift the layout of the scenes and draw episodes anew; without a shift, the world itself."""
    if shift == 0.0:
        return training_world

    # The exchange of a fold is fitted to the scenes of all other folds.
    exchanges: list[ContextExchange | None] = [None] * NUM_FOLDS
    if shift_by == "context":
        for fold in range(NUM_FOLDS):
            other_indices = np.flatnonzero(training_world.fold != fold)
            other_scenes = (training_world.scenes[index] for index in other_indices)
            exchanges[fold] = fit_context_exchange(other_scenes, training_world.bank.task)
    return exchange_search_world(training_world, exchanges, shift, num_episodes)


def exchange_search_world(
    training_world: SearchWorld, exchanges: Sequence[ContextExchange | None], shift: float, num_episodes: int
) -> SearchWorld:
    """Shift every scene by the exchange of its fold, None for the exchange by size, and draw episodes anew."""
    task = training_world.bank.task
    shifted_scenes = []
    for scene, fold in zip(training_world.scenes, training_world.fold.tolist(), strict=True):
        shifted_scenes.append(exchange_places(scene, task, shift, 0, exchanges[fold]))
    return prepare_search(shifted_scenes, training_world.world, task, training_world.fold, num_episodes)


def prepare_search(
    scenes: Sequence[Scene], world: World, task: Task, fold: np.ndarray, num_episodes: int
) -> SearchWorld:
    """Compile scenes and draw episodes; `fold` is that of each scene."""
    tables = [compile_scene(scene, task) for scene in scenes]
    bank = join_scenes(tables, task)

    # As in the bank, scenes without any reachable goal are left out.
    searchable_scenes = []
    planner_scenes = []
    searchable_fold = []
    for scene, table, scene_fold in zip(scenes, tables, fold.tolist(), strict=True):
        if (table.best_length > 0).any():
            sites = find_sites(scene, task, table.rows)
            successors = pose_successors(table.ahead, task.rules)
            searchable_scenes.append(scene)
            searchable_fold.append(scene_fold)
            planner_scenes.append(PlannerScene(sites, successors, table.best_length))
    episodes = draw_episodes(bank, num_episodes)
    return SearchWorld(world, bank, searchable_scenes, planner_scenes, np.array(searchable_fold), episodes)


def assign_folds(scenes: Sequence[Scene]) -> np.ndarray:
    """Return the fold of every scene, int [S]: floor plans are dealt out to the folds within each room type."""
    fold_by_plan: dict[str, dict[str, int]] = {}
    for scene in scenes:
        plans = fold_by_plan.setdefault(scene.room_type, {})
        plans.setdefault(floor_plan_name(scene.name), len(plans) % NUM_FOLDS)
    return np.array([fold_by_plan[scene.room_type][floor_plan_name(scene.name)] for scene in scenes])


# Searches


class FittedPriors(NamedTuple):
    """Priors fitted to the training world, by fold: those of a fold come from the scenes of all other folds.

    Attributes:
      rates: detection rates of each fold.
      models: layout models by variant, one for each fold.
    """

    rates: list[np.ndarray]
    models: dict[str, list[LayoutModel]]


def fit_priors(training_world: SearchWorld) -> FittedPriors:
    """Fit the priors of all variants."""
    # Detection rates of each fold come from the scenes of the other folds.
    counts = np.stack([detection_counts(planner_scene.sites) for planner_scene in training_world.planner_scenes])
    rates = []
    for fold in range(NUM_FOLDS):
        rates.append(estimate_detection_rates(counts[training_world.fold != fold].sum(axis=0)))

    # Searches with a flat belief give the snapshots to which the models of the other folds are fitted.
    uniform_models = [uniform_layout_model(len(training_world.bank.task.categories))] * NUM_FOLDS
    training_searches = run_searches(training_world, rates, uniform_models)
    training_fold = training_world.fold[training_world.episodes.scene]
    snapshots_by_fold = []
    for fold in range(NUM_FOLDS):
        snapshots = []
        for episode_index in np.flatnonzero(training_fold != fold):
            snapshots += training_searches[episode_index].snapshots
        snapshots_by_fold.append(snapshots)

    models = {"flat": uniform_models}
    for name, use_relations in (("places", False), ("layout", True)):
        models[name] = []
        for fold in range(NUM_FOLDS):
            models[name].append(fit_layout_model(snapshots_by_fold[fold], rates[fold], use_relations=use_relations))
    return FittedPriors(rates, models)


def compare_priors(priors: FittedPriors, search_world: SearchWorld) -> dict[str, Any]:
    """Search with each prior, and return means and differences with intervals."""
    rates = priors.rates
    searches = {name: run_searches(search_world, rates, models) for name, models in priors.models.items()}

    # Information in the priors, at the snapshots of the flat searches.
    episodes = search_world.episodes
    episode_fold = search_world.fold[episodes.scene]
    flat_searches = searches["flat"]
    bits: dict[str, list[float]] = {"places": [], "layout": []}
    for name in bits:
        models = priors.models[name]
        for fold, search in zip(episode_fold, flat_searches, strict=True):
            for snapshot in search.snapshots:
                bits[name].append(information_gain(models[fold], rates[fold], snapshot))

    # Intervals are over floor plans, for episodes and for the snapshots in them.
    clusters = episodes.clusters()
    num_snapshots = [len(search.snapshots) for search in flat_searches]
    snapshot_episode = np.repeat(np.arange(len(episodes.scene)), num_snapshots)
    snapshot_clusters = scene_clusters(episodes.floor_plans[snapshot_episode], episodes.room[snapshot_episode])

    def interval_json(values: np.ndarray, clusters: Clusters) -> dict[str, Any]:
        return mean_interval(values[None], clusters, trained=False).to_json()

    measures = {name: compute_measures(search_world, results) for name, results in searches.items()}
    variants = {}
    for name, values_by_measure in measures.items():
        variants[name] = {measure: interval_json(values, clusters) for measure, values in values_by_measure.items()}

    differences = {}
    for base, variant in PAIRS:
        row = {}
        for measure in measures[base]:
            base_values = measures[base][measure][None]
            variant_values = measures[variant][measure][None]
            row[measure] = paired_difference(base_values, variant_values, clusters, trained=False).to_json()
        differences[f"{variant} - {base}"] = row

    return {
        "scenes": len(search_world.planner_scenes),
        "floor_plans": len(set(episodes.floor_plans.tolist())),
        "episodes": len(episodes.scene),
        "best_length": float(episodes.best_length.mean()),
        "variants": variants,
        "bits": {name: interval_json(np.array(values), snapshot_clusters) for name, values in bits.items()},
        "differences": differences,
    }


def run_searches(
    search_world: SearchWorld, rates: Sequence[np.ndarray], models: Sequence[LayoutModel]
) -> list[SearchResult]:
    """Search in every episode with the rates and the model of its scene's fold."""
    world = search_world.world
    bank = search_world.bank
    episodes = search_world.episodes
    first_pose = bank.first_cell * bank.task.rules.poses_per_cell

    results = []
    for scene, goal, pose in zip(episodes.scene.tolist(), episodes.goal.tolist(), episodes.pose.tolist(), strict=True):
        fold = int(search_world.fold[scene])
        step_limit = world.large_step_limit if bank.room_types[scene] == "living_room" else world.step_limit
        start = pose - int(first_pose[scene])
        planner_scene = search_world.planner_scenes[scene]
        results.append(search_for_goal(planner_scene, rates[fold], models[fold], goal, start, step_limit))
    return results


def information_gain(model: LayoutModel, rates: np.ndarray, snapshot: PlannerSnapshot) -> float:
    """Return the bits of information about a goal's sites that a model has beyond the flat belief.

    The mean is over the categories that have not been detected; 0 if there are none.
    """
    object_sites = snapshot.sites.object_sites
    gains = []
    for goal in np.flatnonzero(object_sites.any(axis=1) & ~snapshot.detected):
        flat_scores = np.log1p(-rates[goal]) @ snapshot.look_counts
        model_scores = flat_scores + model.scores(int(goal), snapshot.features, snapshot.sites)
        goal_sites = object_sites[goal]
        gains.append(log_probability(model_scores, goal_sites) - log_probability(flat_scores, goal_sites))
    return float(np.mean(gains)) / np.log(2) if gains else 0.0


def log_probability(scores: np.ndarray, sites: np.ndarray) -> float:
    """Return the log probability that scores give to some of the sites.

    Args:
      scores: unnormalized log probabilities, [sites].
      sites: bool [sites].
    """
    return float(np.logaddexp.reduce(scores[sites]) - np.logaddexp.reduce(scores))


def compute_measures(search_world: SearchWorld, results: Sequence[SearchResult]) -> dict[str, np.ndarray]:
    """Return SPL, success within budgets and limit in percent, and actions, each float [E]."""
    success = np.array([result.success for result in results])
    length = np.array([result.length for result in results])
    best_length = search_world.episodes.best_length

    measures: dict[str, np.ndarray] = {"spl": 100.0 * success * best_length / np.maximum(length, best_length)}
    for budget in search_world.world.budgets:
        measures[f"sr_{budget}"] = 100.0 * (success & (length <= budget))
    return measures | {"sr": 100.0 * success, "actions": length.astype(float)}


def format_table(name: str, results: dict[str, Any]) -> str:
    """Return the results of a world in Markdown."""
    measures = list(results["variants"]["flat"])
    headings = [measure.upper().replace("_", " within ").replace("ACTIONS", "actions") for measure in measures]
    title = f"{name}: {results['episodes']} episodes, {results['scenes']} scenes, L* {results['best_length']:.1f}"
    lines = [f"| {title} | {' | '.join(headings)} | bits |", "| --- |" + " ---: |" * (len(headings) + 1)]

    for label, row in (results["variants"] | results["differences"]).items():
        number_format = "+.1f" if " - " in label else ".1f"
        cells = [f"{Interval.from_json(row[measure]):{number_format}}" for measure in measures]
        bits = results["bits"].get(label)
        cells.append(f"{Interval.from_json(bits):+.2f}" if bits else "")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def format_differences(name: str, differences: dict[str, Any]) -> str:
    """Return the difference of the layout to the places, in one line."""
    row = differences["layout - places"]
    cells = [f"{measure} {Interval.from_json(row[measure]):+.1f}" for measure in row]
    return f"{name}: {', '.join(cells)}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sources", nargs="*", default=list(WORLDS))
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--episodes", type=int, default=320)
    parser.add_argument("--shift", type=float, default=0.0)
    parser.add_argument("--shift-by", choices=get_args(ShiftKind), default="size")
    parser.add_argument("--random-exchanges", type=int, default=0)
    parser.add_argument("--goals", nargs="+", default=())
    options = parser.parse_args()
    if options.random_exchanges and not options.shift:
        sys.exit(f"error: --random-exchanges {options.random_exchanges}: needs a --shift above 0")
    try:
        main(
            options.sources,
            options.scenes,
            options.episodes,
            options.shift,
            options.shift_by,
            options.random_exchanges,
            options.goals,
        )
    except InputError as error:
        sys.exit(f"error: {error}")
