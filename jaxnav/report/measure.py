"""Measurements for the report: evaluates finished runs at one layout shift and replays some of their episodes."""

from typing import NamedTuple

import jax
import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.report import ExperienceLead, row_label
from jaxnav.evaluation.similarity import cooccurrence_counts
from jaxnav.experiments.gap_traces import GapTraces, trace_gaps
from jaxnav.experiments.similarity import SuccessBySimilarity, compute_similarity_points, relate_success_to_similarity
from jaxnav.plain_console import PlainConsole
from jaxnav.progress import show_activity
from jaxnav.report.config import ReportConfig
from jaxnav.report.replays import ReplayAgent, Replays, TrainedLayout, make_replays
from jaxnav.runs.evaluate import evaluate, measure_leads
from jaxnav.runs.policies import Policies
from jaxnav.runs.results import Results
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world
from jaxnav.training.calibration import layout_priors

#: Length of the curves of the gap, steps.
GAP_STEPS = 40


class ShiftMeasurements(NamedTuple):
    """Measurements at one layout shift.

    Attributes:
      results: evaluation of the run.
      account: leads of the run over layout-blind agents; None without a run of such agents.
      similarity: success by layout similarity; None if scenes are streamed.
      gaps: layout gap along the episodes; None if scenes are streamed, or without the layout.
      replays: episodes, step by step.
      compiled_world: compiled scenes.
    """

    results: Results
    account: list[ExperienceLead] | None
    similarity: SuccessBySimilarity | None
    gaps: GapTraces | None
    replays: Replays
    compiled_world: CompiledWorld


def measure_shift(
    run: Run,
    reference_run: Run | None,
    shift: float,
    config: ReportConfig,
    console: PlainConsole,
    trained_layout: TrainedLayout | None = None,
) -> ShiftMeasurements:
    """Measure a run at one layout shift.

    Args:
      run: a finished run.
      reference_run: a finished run of layout-blind agents in the same world; None for none.
      shift: layout shift.
      config: options of the measurements.
      console: receives messages about the progress.
      trained_layout: layout of training, in which the replayed episodes are played, too; None for none.

    Raises:
      InputError: no finished run, an impossible option, or runs that cannot be compared.
    """
    # Evaluate the run.
    compiled_world = compile_evaluation_world(run.config, config.split, None, shift, console, shift_by=config.shift_by)
    results = _evaluate(run, shift, compiled_world, config, console)
    policies = run.policies()
    agents = _select_agents(results, policies, compiled_world, config.threshold)

    # Compare with layout-blind agents, and replay them with best actions, too.
    account = None
    if reference_run is not None:
        quiet_console = PlainConsole(quiet=True)
        with show_activity(console, f"evaluating the reference run at shift {shift:g}"):
            reference_world = compile_evaluation_world(
                reference_run.config, config.split, None, shift, quiet_console, shift_by=config.shift_by
            )
            reference_results = _evaluate(reference_run, shift, reference_world, config, quiet_console)
        account = measure_leads(results, reference_results)

        # Among the replays these agents have a role of their own.
        reference_policies = reference_run.policies()
        for agent in _select_agents(reference_results, reference_policies, reference_world, config.threshold):
            if agent.role == "baseline":
                agents.append(agent._replace(role="reference"))

    # Similarity and gap need all scenes in one bank.
    episodes = _episodes_of_first_bank(results.episodes, compiled_world)
    has_one_bank = len(compiled_world.banks) == 1
    similarity = _measure_similarity(results, policies, compiled_world) if has_one_bank else None
    gap_traces = None
    if has_one_bank and policies.estimator_config is not None:
        with show_activity(console, f"measuring the layout gap at shift {shift:g}"):
            gap_traces = trace_gaps(
                policies.arm_params("layout"),
                episodes,
                compiled_world.make_env_params(0),
                policies.make_agent_loop(compiled_world),
                policies.knowledge,
                estimators=[policies.estimator_config],
                priors=layout_priors(policies.prior_counts, policies.estimator_config)[None],
                num_steps=GAP_STEPS,
                key=jax.random.key(config.seed),
            )

    # The number of replays is that of the whole page.
    replays_per_shift = config.replays // len(set(config.shift))
    with show_activity(console, f"playing episodes for the replays at shift {shift:g}"):
        replays = make_replays(agents, episodes, replays_per_shift, shift, config.split, trained_layout)
    return ShiftMeasurements(results, account, similarity, gap_traces, replays, compiled_world)


def _evaluate(
    run: Run, shift: float, compiled_world: CompiledWorld, config: ReportConfig, console: PlainConsole
) -> Results:
    """Evaluate a run at a shift, as `jaxnav eval` does."""
    return evaluate(
        run,
        split=config.split,
        shift=shift,
        shift_by=config.shift_by,
        episodes=config.episodes,
        epsilon=sorted({*config.epsilon, config.threshold}),
        seed=config.seed,
        compiled=compiled_world,
        console=console,
    )


def _select_agents(
    results: Results, policies: Policies, compiled_world: CompiledWorld, threshold: float
) -> list[ReplayAgent]:
    """Return the agents whose episodes are replayed: those with best actions, and sTDE at the threshold."""
    num_episodes = len(_episodes_of_first_bank(results.episodes, compiled_world).goal)

    # Rows of the oracle and of TDE have no place among the pairs that the page compares.
    agents = []
    for row_index, row in enumerate(results.rows):
        if row.decoding != "argmax" or row.variant in ("oracle", "tde") or row.epsilon not in (None, threshold):
            continue
        # Results of the first seed: [rows, seeds, E].
        episode_success = np.asarray(results.outcome.success)[row_index, 0, :num_episodes]
        episode_length = np.asarray(results.outcome.length)[row_index, 0, :num_episodes]
        agent_name = row_label(results.report["rows"][row_index])
        agents.append(
            ReplayAgent(row.variant, agent_name, policies, compiled_world, row, episode_success, episode_length)
        )
    return agents


def _episodes_of_first_bank(episodes: EpisodeList, compiled_world: CompiledWorld) -> EpisodeList:
    """Return the episodes of the first bank; all banks have equally many."""
    return episodes.take(np.arange(len(episodes.goal) // len(compiled_world.banks)))


def _measure_similarity(results: Results, policies: Policies, compiled_world: CompiledWorld) -> SuccessBySimilarity:
    """Relate the success of the first row to layout similarity."""
    # Counts of the prior for each scene's type of room, [scenes, K, K].
    bank = compiled_world.banks[0]
    room_of_scene = np.asarray(compiled_world.make_env_params(0).room)[: len(bank.names)]
    prior_counts = np.asarray(policies.prior_counts, np.float64)[room_of_scene]

    # One point for each scene and goal, with the success of the episodes that belong to it.
    similarity_points = compute_similarity_points(results.episodes, cooccurrence_counts(bank), prior_counts)
    return relate_success_to_similarity(similarity_points, np.asarray(results.outcome.success)[0])
