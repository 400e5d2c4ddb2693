"""Effect of each factor in the difference between two agents.

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
from _common import print_report, run_in_folder

import jaxnav
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import Interval, mean_interval, paired_difference
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.runs.config_files import apply_values
from jaxnav.study.records import to_json

METRICS = ("sr", "spl")
DECODINGS = ("argmax", "sample")


class AgentScores(NamedTuple):
    """Results of one agent.

    Attributes:
      values: by metric and decoding, float64 [S, E] in percent.
      episodes: the E episodes.
    """

    values: dict[tuple[str, str], np.ndarray]
    episodes: EpisodeList


def main(factors_file: Path, folder: Path) -> None:
    settings = yaml.safe_load(factors_file.read_text())
    default_base = apply_values(jaxnav.RunConfig(), settings["base"], factors_file)

    results = {}
    for name, changes in settings.get("bases", {"base": {}}).items():
        base = apply_values(default_base, changes, factors_file)
        results[name] = measure_effects(base, settings["factors"], folder / name, factors_file)
        print("\n".join(format_table(name, results[name])), file=sys.stderr)
    print_report(to_json({"asked": settings, "bases": results}))


def measure_effects(
    base: jaxnav.RunConfig, factors: dict[str, Any], folder: Path, factors_file: Path
) -> dict[str, Any]:
    """Train and evaluate the agents whose differences are the effects of the factors on a base."""
    factor_names = list(factors)
    scores_by_config = dict[str, AgentScores]()

    def score_agent(*names: str) -> AgentScores:
        """Return the scores of the base with some factors; equal agents are trained once."""
        config = base
        for name in names:
            config = apply_values(config, factors[name], factors_file)
        config_text = repr(config)
        if config_text not in scores_by_config:
            scores_by_config[config_text] = train_and_score(config, folder / ("+".join(names) or "base"))
        return scores_by_config[config_text]

    # The ladder adds one factor after the other to the base.
    ladder = [score_agent(*factor_names[:count]) for count in range(len(factor_names) + 1)]
    effects = {}
    for index, name in enumerate(factor_names):
        all_others = score_agent(*(other for other in factor_names if other != name))
        effects[name] = {
            "alone": score_difference(ladder[0], score_agent(name)),
            "in turn": score_difference(ladder[index], ladder[index + 1]),
            "last": score_difference(all_others, ladder[-1]),
        }

    agents = {name: mean_scores(scores) for name, scores in zip(["base", *factor_names], ladder, strict=True)}
    return {"agents": agents, "effects": effects, "whole": score_difference(ladder[0], ladder[-1])}


def train_and_score(config: jaxnav.RunConfig, folder: Path) -> AgentScores:
    """Train and evaluate an agent: the run's last arm, which uses the layout if any does."""
    run = jaxnav.train(dataclasses.replace(config, run_dir=folder))
    results = jaxnav.evaluate(run)
    metrics = results.metrics()
    arm = config.arms[-1]

    values = {}
    for metric in METRICS:
        for decoding in DECODINGS:
            row_index = results.rows.index(EvaluationRow(arm, None, None, decoding))
            values[metric, decoding] = 100.0 * metrics[metric][row_index]
    means = {key: round(float(scores.mean()), 1) for key, scores in values.items()}
    print(folder.name, means, file=sys.stderr, flush=True)
    return AgentScores(values, results.episodes)


def score_difference(agent: AgentScores, better_agent: AgentScores) -> dict[str, Interval]:
    """Return the gain of the second agent over the first, by metric and decoding."""
    clusters = agent.episodes.clusters()
    differences = {}
    for key, values in agent.values.items():
        differences[" ".join(key)] = paired_difference(values, better_agent.values[key], clusters)
    return differences


def mean_scores(agent: AgentScores) -> dict[str, Interval]:
    """Return the mean results of an agent, by metric and decoding."""
    clusters = agent.episodes.clusters()
    return {" ".join(key): mean_interval(values, clusters) for key, values in agent.values.items()}


def format_table(name: str, results: dict[str, Any]) -> list[str]:
    """Return the effects on SR with best actions in Markdown."""
    key = "sr argmax"
    lines = [f"| {name} | alone | in turn | last |", "| --- | ---: | ---: | ---: |"]
    for factor, effect_by_order in results["effects"].items():
        cells = [f"{effect[key]:+.1f}" for effect in effect_by_order.values()]
        lines.append(f"| {factor} | {' | '.join(cells)} |")
    return [*lines, f"| all | | {results['whole'][key]:+.1f} | |"]


if __name__ == "__main__":
    run_in_folder(main)
