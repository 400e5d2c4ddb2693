"""What a difference between two agents is made of, factor by factor.

`python benchmarks/factors.py FACTORS.yaml [FOLDER]` trains agents with some of the factors of the file and evaluates
them on the same episodes. The effect of a factor is measured alone (on the base), in turn (on the base with all factors
before it) and last (on all others); where the file names several `bases`, on each of them. Runs are kept in FOLDER, by
default a temporary one; what was interrupted goes on there. The result goes to stdout as JSON, the table to stderr.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from _common import in_folder, report

import jaxnav
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import Interval, paired_difference, summary
from jaxnav.evaluation.variants import Row
from jaxnav.runs.overlay import apply_values
from jaxnav.study.codec import to_json

METRICS = ("sr", "spl")
DECODINGS = ("argmax", "sample")


class Scores(NamedTuple):
    """Hold the results of one agent, float64 [S, E] in percent, by decoding and metric."""

    values: dict[tuple[str, str], np.ndarray]
    episodes: EpisodeList


def main(given: Path, folder: Path) -> None:
    asked = yaml.safe_load(given.read_text())
    base = apply_values(jaxnav.RunConfig(), asked["base"], given)
    found = {}
    for name, changes in asked.get("bases", {"base": {}}).items():
        found[name] = effects(apply_values(base, changes, given), asked["factors"], folder / name, given)
        print("\n".join(table(name, found[name])), file=sys.stderr)
    report(to_json({"asked": asked, "bases": found}))


def effects(base: jaxnav.RunConfig, factors: dict[str, Any], folder: Path, given: Path) -> dict[str, Any]:
    """Train and evaluate what the factors' effects on a base are made of."""
    names, trained = list(factors), dict[str, Scores]()

    def agent(*chosen: str) -> Scores:
        config = base
        for name in chosen:
            config = apply_values(config, factors[name], given)
        if repr(config) not in trained:
            trained[repr(config)] = measured(config, folder / ("+".join(chosen) or "base"))
        return trained[repr(config)]

    ladder = [agent(*names[:number]) for number in range(len(names) + 1)]
    found = {}
    for number, name in enumerate(names):
        others = agent(*(other for other in names if other != name))
        found[name] = {
            "alone": difference(ladder[0], agent(name)),
            "in turn": difference(ladder[number], ladder[number + 1]),
            "last": difference(others, ladder[-1]),
        }
    agents = {name: means(each) for name, each in zip(["base", *names], ladder, strict=True)}
    return {"agents": agents, "effects": found, "whole": difference(ladder[0], ladder[-1])}


def measured(config: jaxnav.RunConfig, folder: Path) -> Scores:
    """Train an agent and evaluate it; the arm of the layout where there is one."""
    run = jaxnav.train(dataclasses.replace(config, run_dir=folder))
    results = jaxnav.evaluate(run)
    metrics, arm = results.metrics(), config.arms[-1]
    values = {
        (metric, decoding): 100.0 * metrics[metric][results.rows.index(Row(arm, None, None, decoding))]
        for metric in METRICS
        for decoding in DECODINGS
    }
    print(folder.name, {key: round(float(each.mean()), 1) for key, each in values.items()}, file=sys.stderr, flush=True)
    return Scores(values, results.episodes)


def difference(one: Scores, other: Scores) -> dict[str, Interval]:
    """Return what the other has more, by metric and decoding."""
    scenes = one.episodes.clusters()
    return {" ".join(key): paired_difference(one.values[key], other.values[key], scenes) for key in one.values}


def means(agent: Scores) -> dict[str, Interval]:
    """Return the results of an agent."""
    scenes = agent.episodes.clusters()
    return {" ".join(key): summary(values, scenes) for key, values in agent.values.items()}


def table(name: str, found: dict[str, Any]) -> list[str]:
    """Return the effects on SR with best actions in Markdown."""
    key = "sr argmax"
    lines = [f"| {name} | alone | in turn | last |", "| --- | ---: | ---: | ---: |"]
    for factor, by_order in found["effects"].items():
        lines.append(f"| {factor} | {' | '.join(f'{each[key]:+.1f}' for each in by_order.values())} |")
    return [*lines, f"| all | | {found['whole'][key]:+.1f} | |"]


if __name__ == "__main__":
    in_folder(main)
