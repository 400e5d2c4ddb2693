"""What a layout is worth to a planner: the same search with and without a prior.

`python benchmarks/layout_value.py [WORLD or SCENE FILE ...] [--scenes 48] [--episodes 320] [--shift 0]
[--goals CATEGORY ...]` searches in the
scenes of generated worlds (all three without arguments) and of scene files. Every scene is searched with a prior fitted
to the others: the scenes are divided into folds by floor plan, within room types. The detector makes no errors. Rows:

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
from typing import Any, NamedTuple

import numpy as np
from _common import report

from jaxnav.baselines.layout_model import Glimpse, LayoutModel, detection_counts, detection_rates, fit, flat
from jaxnav.baselines.planner import Home, Search, search
from jaxnav.baselines.sites import find_sites
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.statistics import Clusters, Interval, paired_difference, scene_clusters, summary
from jaxnav.scenes.lattice import successors
from jaxnav.scenes.scene import Scene, floor_plan
from jaxnav.scenes.tables.compile import Bank, compile_scene, join
from jaxnav.scenes.tables.detector import PERFECT
from jaxnav.scenes.worlds import WORLDS, World, from_file, generated, shifted, world_named

FOLDS = 4
PAIRS = (("flat", "layout"), ("places", "layout"))


class Place(NamedTuple):
    """Hold the scenes of a world, ready to be searched."""

    world: World
    bank: Bank
    homes: list[Home]
    fold: np.ndarray  # int [S]
    episodes: EpisodeList


def main(sources: Sequence[str], scenes: int, episodes: int, shift: float, goals: Sequence[str]) -> None:
    results = {}
    for source in sources:
        results[Path(source).name] = values = measured(prepared(source, scenes, episodes, shift, goals))
        print(table(Path(source).name, values), file=sys.stderr, flush=True)
    report({"shift": shift, "goals": list(goals), "worlds": results})


def prepared(source: str, most: int, episodes: int, shift: float, goals: Sequence[str]) -> Place:
    """Compile at most so many scenes, evenly spread over a file.

    Without goals, those of the world are searched for.
    """
    every = generated(source, "train", most) if source in WORLDS else from_file(source, None)
    world = WORLDS[source if source in WORLDS else world_named(every[0].world)]
    task = dataclasses.replace(world.task, detector=PERFECT, goals=tuple(goals) or world.task.goals)
    scenes = shifted(every, task, shift)
    chosen = [scenes[int(i)] for i in np.unique(np.linspace(0, len(scenes) - 1, most).astype(int))]
    tables = [compile_scene(scene, task) for scene in chosen]
    bank, kept = join(tables, task), [i for i, table in enumerate(tables) if (table.best_length > 0).any()]
    homes = [
        Home(
            find_sites(chosen[i], task, tables[i].rows),
            successors(tables[i].ahead, task.rules),
            tables[i].best_length,
        )
        for i in kept
    ]
    return Place(world, bank, homes, folds([chosen[i] for i in kept]), episode_list(bank, episodes))


def folds(scenes: Sequence[Scene]) -> np.ndarray:
    """Deal floor plans out to the folds, within room types."""
    dealt: dict[str, dict[str, int]] = {}
    for scene in scenes:
        plans = dealt.setdefault(scene.room_type, {})
        plans.setdefault(floor_plan(scene.name), len(plans) % FOLDS)
    return np.array([dealt[scene.room_type][floor_plan(scene.name)] for scene in scenes])


def measured(place: Place) -> dict[str, Any]:
    """Search with each prior, and compare."""
    counts = np.stack([detection_counts(home.sites) for home in place.homes])
    rates = [detection_rates(counts[place.fold != fold].sum(axis=0)) for fold in range(FOLDS)]
    blank = flat(len(place.bank.task.categories))
    searches = {"flat": searched(place, rates, [blank] * FOLDS)}
    scene, clusters = place.episodes.scene, place.episodes.clusters()
    glimpses = [
        [glimpse for i in np.flatnonzero(place.fold[scene] != fold) for glimpse in searches["flat"][i].glimpses]
        for fold in range(FOLDS)
    ]
    bits = {}
    for name, relations in (("places", False), ("layout", True)):
        models = [fit(glimpses[fold], rates[fold], relations=relations) for fold in range(FOLDS)]
        searches[name] = searched(place, rates, models)
        bits[name] = [
            gained(models[fold], rates[fold], glimpse)
            for fold, one in zip(place.fold[scene], searches["flat"], strict=True)
            for glimpse in one.glimpses
        ]
    measures = {name: measures_of(place, outcomes) for name, outcomes in searches.items()}

    def over_scenes(values: np.ndarray, clusters: Clusters) -> dict[str, Any]:
        return summary(values[None], clusters, trained=False).to_json()

    of = np.repeat(np.arange(len(scene)), [len(one.glimpses) for one in searches["flat"]])
    told_in = scene_clusters(place.episodes.plan[of], place.episodes.room[of])

    return {
        "scenes": len(place.homes),
        "floor_plans": len(set(place.episodes.plan.tolist())),
        "episodes": len(scene),
        "best_length": float(place.episodes.best_length.mean()),
        "variants": {
            name: {measure: over_scenes(values, clusters) for measure, values in row.items()}
            for name, row in measures.items()
        },
        "bits": {name: over_scenes(np.array(told), told_in) for name, told in bits.items()},
        "differences": {
            f"{b} - {a}": {
                measure: paired_difference(
                    measures[a][measure][None], measures[b][measure][None], clusters, trained=False
                ).to_json()
                for measure in measures[a]
            }
            for a, b in PAIRS
        },
    }


def searched(place: Place, rates: Sequence[np.ndarray], models: Sequence[LayoutModel]) -> list[Search]:
    """Search in every episode with the model of its scene's fold."""
    episodes, world, bank = place.episodes, place.world, place.bank
    first = bank.first_cell * bank.task.rules.poses_per_cell
    found = []
    starts = zip(*(part.tolist() for part in (episodes.scene, episodes.goal, episodes.pose)), strict=True)
    for scene, goal, pose in starts:
        fold = int(place.fold[scene])
        limit = world.large_step_limit if bank.room_types[scene] == "living_room" else world.step_limit
        found.append(search(place.homes[scene], rates[fold], models[fold], goal, pose - int(first[scene]), limit))
    return found


def gained(model: LayoutModel, rates: np.ndarray, glimpse: Glimpse) -> float:
    """Return the bits that a model tells of where a goal is.

    They are those beyond the flat belief, in the mean over the categories that have not been detected; 0 without any.
    """
    there, told = glimpse.sites.objects, []
    for goal in np.flatnonzero(there.any(axis=1) & ~glimpse.detected):
        missed = np.log1p(-rates[goal]) @ glimpse.looks
        with_model = missed + model.scores(int(goal), glimpse.features, glimpse.sites)
        told.append(share(with_model, there[goal]) - share(missed, there[goal]))
    return float(np.mean(told)) / np.log(2) if told else 0.0


def share(scores: np.ndarray, there: np.ndarray) -> float:
    """Return the log probability that scores give to some sites."""
    return float(np.logaddexp.reduce(scores[there]) - np.logaddexp.reduce(scores))


def measures_of(place: Place, searches: Sequence[Search]) -> dict[str, np.ndarray]:
    """Return SPL, success within limit and budgets, and actions."""
    success = np.array([one.success for one in searches])
    length, best = np.array([one.length for one in searches]), place.episodes.best_length
    budgets = {f"sr_{budget}": 100.0 * (success & (length <= budget)) for budget in place.world.budgets}
    return {
        "spl": 100.0 * success * best / np.maximum(length, best),
        **budgets,
        "sr": 100.0 * success,
        "actions": length.astype(float),
    }


def table(name: str, values: dict[str, Any]) -> str:
    """Return the results of a world in Markdown."""
    measures = list(values["variants"]["flat"])
    heads = [measure.upper().replace("_", " within ").replace("ACTIONS", "actions") for measure in measures]
    about = f"{name}: {values['episodes']} episodes, {values['scenes']} scenes, L* {values['best_length']:.1f}"
    lines = [f"| {about} | {' | '.join(heads)} | bits |", "| --- |" + " ---: |" * (len(heads) + 1)]
    for label, row in (values["variants"] | values["differences"]).items():
        sign = "+.1f" if " - " in label else ".1f"
        told = values["bits"].get(label)
        cells = [f"{Interval.from_json(row[measure]):{sign}}" for measure in measures]
        lines.append(f"| {label} | {' | '.join(cells)} | {f'{Interval.from_json(told):+.2f}' if told else ''} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sources", nargs="*", default=list(WORLDS))
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--episodes", type=int, default=320)
    parser.add_argument("--shift", type=float, default=0.0)
    parser.add_argument("--goals", nargs="+", default=())
    given = parser.parse_args()
    try:
        main(given.sources, given.scenes, given.episodes, given.shift, given.goals)
    except InputError as error:
        sys.exit(f"error: {error}")
