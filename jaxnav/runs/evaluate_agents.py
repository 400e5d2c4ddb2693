"""Evaluation of agents that act on observations, next to Random, frontier search and the shortest path."""

import time
import typing
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxnav.baselines.frontier import run_frontier_search
from jaxnav.baselines.shortest_path import run_oracle
from jaxnav.choices import ShiftKind, Variant
from jaxnav.evaluation.agents import RandomAgent, run_agent
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.notes import missing_interval_notes
from jaxnav.evaluation.report import build_difference, build_report
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.plain_console import PlainConsole
from jaxnav.progress import show_activity
from jaxnav.runs.config import RunConfig
from jaxnav.runs.results import Results, build_result_rows
from jaxnav.runs.subjects import AgentSubject
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, draw_episode_lists, prefetch_env_params
from jaxnav.scenes.worlds import WORLDS

#: World of agents that name none.
DEFAULT_WORLD = "rooms"


def evaluate_agents(
    subject: AgentSubject,
    *,
    split: str,
    scenes: Path | None,
    world: str | None,
    shift: float | None,
    shift_by: ShiftKind,
    num_episodes: int,
    seed: int,
    compiled: CompiledWorld | None,
    console: PlainConsole,
) -> Results:
    """Evaluate agents on the fixed episodes of a world; see `jaxnav.evaluate`."""
    # A world gives the task; a scene file replaces its scenes.
    config = RunConfig(world=typing.cast(Any, world or DEFAULT_WORLD), scenes=scenes)  # checked when it is compiled
    compiled = compiled or compile_evaluation_world(config, split, None, shift, console, shift_by=shift_by)
    episode_lists = draw_episode_lists(compiled, num_episodes, seed)
    key = jax.random.key(seed)

    # The agent of every training seed, each with random numbers of its own.
    start_time = time.perf_counter()
    outcomes = []
    for index, agent in enumerate(subject.agents):
        with show_activity(console, f"evaluating {subject.name} in {num_episodes:,} episodes"):
            banks = zip(episode_lists, prefetch_env_params(compiled, range(len(compiled.banks))), strict=True)
            outcomes.append(run_agent(agent, subject.name, compiled.env, banks, jax.random.fold_in(key, index)))
    agent_outcome = jax.tree.map(lambda *leaves: np.stack(leaves), *outcomes)  # [S, E]
    seconds = time.perf_counter() - start_time
    num_actions = int(agent_outcome.length.sum())
    console.print(f"{subject.name}: {num_actions:,} actions in {seconds:.1f} s, {num_actions / seconds:,.0f} a second")

    # The references act in the same episodes, once for all seeds.
    outcome_by_variant: dict[Variant, EpisodeOutcome] = {"agent": agent_outcome}
    with show_activity(console, "evaluating Random, frontier search and the shortest path"):
        outcome_by_variant |= _run_references(compiled, episode_lists, jax.random.fold_in(key, len(subject.agents)))
    rows = [EvaluationRow(variant, None, None, "own") for variant in outcome_by_variant]
    num_seeds = len(subject.agents)
    all_outcomes = []
    for outcome in outcome_by_variant.values():
        all_outcomes.append(jax.tree.map(lambda leaf: np.broadcast_to(leaf, (num_seeds, leaf.shape[-1])), outcome))
    outcome = jax.tree.map(lambda *leaves: np.stack(leaves), *all_outcomes)  # [R, S, E]

    results = Results(
        rows, outcome, join_episode_lists(episode_lists), compiled.env.categories, WORLDS[config.world].budgets, {}
    )
    names = {"method": subject.name, "world": compiled.scenes[0].world, "split": split}
    settings = {
        "subject": subject.name,
        "seeds": num_seeds,
        "world": config.world,
        "evaluation_source": str(scenes or config.world),
        "evaluation_shift": shift or 0.0,
        "evaluation_shift_by": shift_by,
        "evaluation_seed": seed,
    }
    has_runs = num_seeds > 1
    report = build_report(
        build_result_rows(results, names, trained=has_runs),
        _build_agent_differences(results, subject.name, trained=has_runs),
        missing_interval_notes(results.episodes),
        0,
        settings,
    )
    return results._replace(report=report)


def _run_references(
    compiled: CompiledWorld, episode_lists: list[EpisodeList], key: jax.Array
) -> dict[Variant, EpisodeOutcome]:
    """Run Random, frontier search and the shortest path over all episodes, leaves [E]."""
    bank_indices = range(len(compiled.banks))
    banks = zip(episode_lists, prefetch_env_params(compiled, bank_indices), strict=True)
    random_outcome = run_agent(RandomAgent(), "Random", compiled.env, banks, key)

    frontier_outcomes = []
    for bank, episodes in zip(compiled.banks, episode_lists, strict=True):
        frontier_outcomes.append(run_frontier_search(bank, episodes, compiled.scene_step_limits(bank)))
    frontier_outcome = jax.tree.map(lambda *leaves: np.concatenate(leaves), *frontier_outcomes)

    env_params = prefetch_env_params(compiled, bank_indices)
    oracle_outcome = run_oracle(compiled.banks, episode_lists, env_params, compiled.env)
    return {"random": random_outcome, "frontier": frontier_outcome, "oracle": oracle_outcome}


def _build_agent_differences(results: Results, name: str, *, trained: bool) -> list[dict[str, Any]]:
    """Paired differences of the agent to Random and to frontier search."""
    metrics = results.metrics()
    variants = [row.variant for row in results.rows]
    agent_index = variants.index("agent")
    differences = []
    for reference in ("random", "frontier"):
        for metric in ("sr", "spl", "dts"):
            difference = build_difference(
                metric,
                (reference, metrics[metric][variants.index(reference)]),
                ("agent", metrics[metric][agent_index]),
                epsilon=None,
                form=None,
                decoding="own",
                episodes=results.episodes,
                same_runs=True,  # the reference is no training run
                trained=trained,
            )
            differences.append(difference | {"method": name})
    return differences
