"""Scores of agents and their paired differences: the measurements `evaluation`, `frontier`, `account` and `groups`.

The numbers are those of `jaxnav eval`: baseline, layout weights (`layout`), hard TDE (`tde`) and sTDE (`stde`) with
best and with sampled actions, Random and the shortest path, all on the same episodes. A row with a `reference` is the
difference to another variant of the same run, or to the variant `AGENT/VARIANT` of another run.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxnav.baselines.frontier import run_frontier_search
from jaxnav.choices import DECODINGS, Decoding
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import episode_metrics
from jaxnav.evaluation.notes import last_quarter_success
from jaxnav.evaluation.report import METRIC_COLUMNS, UNTRAINED_VARIANTS, to_report_units
from jaxnav.evaluation.statistics import Interval, mean_interval, paired_difference
from jaxnav.evaluation.variants import EvaluationRow, share_networks
from jaxnav.experiments.bench import Bench, Scores
from jaxnav.experiments.config import AgentRun
from jaxnav.experiments.table import ResultRow
from jaxnav.runs.evaluate import has_same_episodes, measure_leads
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import draw_episode_lists

#: Comparisons within a run: a variant and its reference.
VARIANT_COMPARISONS = (("layout", "baseline"), ("stde", "layout"), ("stde", "baseline"), ("tde", "layout"))
#: Variants that act by trained policies.
TRAINED_VARIANTS = ("baseline", "layout", "stde", "tde")


def measure_evaluation(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Score every variant of a run at every shift, and compare it with its references."""
    for shift in bench.config.shifts:
        scores = bench.evaluate(run, shift)
        yield from value_rows(run, shift, scores)

        # Every agent that the run is compared with meets the same episodes.
        references = {}
        for reference in run.against:
            reference_run = bench.find_run(run.world, reference.partition("/")[0])
            if reference_run is not None:
                references[reference] = bench.evaluate(reference_run, shift)
        yield from difference_rows(run, shift, scores, references)
        yield from share_rows(run, shift, scores)
    yield from training_rows(run)


def value_rows(run: AgentRun, shift: float, scores: Scores) -> Iterator[ResultRow]:
    """Score the variants of a run."""
    clusters = scores.episodes.clusters()
    for row, metrics in scores.metrics.items():
        is_trained = row.variant not in UNTRAINED_VARIANTS
        for metric in METRIC_COLUMNS:
            interval = mean_interval(metrics[metric], clusters, trained=is_trained)
            yield ResultRow(
                **row_fields(run, shift, row), metric=metric, value=interval, scenes=scores.episodes.num_drawn_scenes
            )


def share_rows(run: AgentRun, shift: float, scores: Scores) -> Iterator[ResultRow]:
    """List the decision shares of an evaluation with the differences between partners and the costs."""
    for entry in scores.results.report["decision_shares"]:
        fields = {"world": run.world, "run": run.agent, "shift": shift}
        fields |= {"variant": entry["variant"], "decoding": entry["decoding"]}
        measured = {"share": entry["share"], "partner difference": entry["partner_difference"]}
        if entry["cost"] is not None:
            measured |= {"cost in spl": entry["cost"]["spl"], "cost in sr": entry["cost"]["sr"]}

        # Only parts of partner episodes have a difference between partners.
        for name, interval in measured.items():
            if interval is not None:
                metric = f"{name} of {entry['part']}"
                yield ResultRow(
                    **fields, metric=metric, value=Interval.from_json(interval), scenes=scores.episodes.num_drawn_scenes
                )


def difference_rows(
    run: AgentRun, shift: float, scores: Scores, references: Mapping[str, Scores]
) -> Iterator[ResultRow]:
    """Compare the variants of a run with each other, with random choices, and with those of other agents.

    Args:
      run: the run.
      shift: layout shift.
      scores: scores of the run.
      references: scores of other agents by entry of `against`; see `list_comparisons`.
    """
    for decoding in DECODINGS:
        # Within the run; random choices have no networks of their own.
        variants = variants_by_name(scores, decoding)
        for variant, reference in VARIANT_COMPARISONS:
            if variant in variants and reference in variants:
                same_runs = share_networks(variant, reference)
                yield from _compare(run, shift, variants[variant], variants[reference], reference, same_runs=same_runs)
        for variant in TRAINED_VARIANTS:
            if variant in variants:
                yield _compare_with_chance(run, shift, variants[variant], variants["random"])
                if not run.config.policy_method.chooses_actions:
                    yield from _compare(run, shift, variants[variant], variants["random"], "random", same_runs=True)

        for name, reference_scores in references.items():
            other_variants = variants_by_name(reference_scores, decoding)
            for variant, other_variant, reference_name in list_comparisons(run, name):
                if variant in variants and other_variant in other_variants:
                    reference = other_variants[other_variant]
                    same_runs = other_variant in UNTRAINED_VARIANTS  # which have no networks of their own
                    yield from _compare(run, shift, variants[variant], reference, reference_name, same_runs=same_runs)


class Comparison(NamedTuple):
    """A variant of an agent and the variant of another agent with which it is compared, named AGENT/VARIANT."""

    variant: str
    other_variant: str
    reference: str


def list_comparisons(run: AgentRun, reference: str) -> list[Comparison]:
    """List the comparisons of a run with one entry of `against`.

    Args:
      run: the run.
      reference: AGENT, whose variants are compared with the same variants of the run, or AGENT/VARIANT, which is
        compared with the run's last arm.
    """
    agent, is_single, other_variant = reference.partition("/")
    if is_single:
        return [Comparison(run.config.arms[-1], other_variant, reference)]
    return [Comparison(variant, variant, f"{agent}/{variant}") for variant in TRAINED_VARIANTS]


class VariantScores(NamedTuple):
    """Scores of one variant of an agent: its row of the evaluation, metrics [S, E], and the episodes."""

    row: EvaluationRow
    metrics: Mapping[str, np.ndarray]
    episodes: EpisodeList


def variants_by_name(scores: Scores, decoding: Decoding) -> dict[str, VariantScores]:
    """Scores of every variant with a decoding; of sTDE, those at the first epsilon. Random has either decoding."""
    variants: dict[str, VariantScores] = {}
    for row, metrics in scores.metrics.items():
        if row.decoding == decoding or row.variant in UNTRAINED_VARIANTS:
            variants.setdefault(row.variant, VariantScores(row, metrics, scores.episodes))
    return variants


def _compare(
    run: AgentRun,
    shift: float,
    compared: VariantScores,
    reference: VariantScores,
    reference_name: str,
    *,
    same_runs: bool,
) -> Iterator[ResultRow]:
    """Compare two variants in every metric, paired on the episodes."""
    check_same_episodes(compared.episodes, reference.episodes)
    clusters = compared.episodes.clusters()
    for metric in METRIC_COLUMNS:
        difference = paired_difference(
            reference.metrics[metric], compared.metrics[metric], clusters, same_runs=same_runs
        )
        fields = row_fields(run, shift, compared.row)
        fields |= {"reference": reference_name, "scenes": compared.episodes.num_drawn_scenes}
        yield ResultRow(**fields, metric=metric, value=difference)


def _compare_with_chance(run: AgentRun, shift: float, compared: VariantScores, random: VariantScores) -> ResultRow:
    """Compare success with that of Random in other scenes, for these training runs."""
    clusters = compared.episodes.clusters()
    lead = paired_difference(random.metrics["sr"], compared.metrics["sr"], clusters, trained=False)
    fields = row_fields(run, shift, compared.row)
    return ResultRow(**fields, reference="chance", metric="sr", value=lead)


def row_fields(run: AgentRun, shift: float | None, row: EvaluationRow) -> dict[str, Any]:
    """Fields of a result that a row of an evaluation determines."""
    is_stde = row.variant == "stde"
    return {
        "world": run.world,
        "run": run.agent,
        "variant": row.variant,
        "decoding": "" if row.variant in UNTRAINED_VARIANTS else row.decoding,
        "shift": shift,
        "epsilon": row.epsilon,
        "form": (row.form or "") if is_stde else "",
    }


def training_rows(run: AgentRun) -> Iterator[ResultRow]:
    """Cost and convergence of a training run: environment steps by purpose, seconds, and success near its end."""
    # Exploration counts what the run really spent, which its policies know.
    trained_run = Run(run.config)
    budget = run.config.steps_by_purpose | {"exploration": trained_run.policies().prior_steps}
    values: dict[str, float] = {f"{purpose} (steps)": num_steps for purpose, num_steps in budget.items()}
    times = trained_run.times()
    if times:
        values["training (s)"] = times[-1]["wall_s"]

    last_quarter = last_quarter_success(trained_run.log())
    if last_quarter is not None:
        values["val sr before the last quarter"], values["val sr at the end"] = last_quarter
    for metric, value in values.items():
        yield ResultRow(world=run.world, run=run.agent, metric=metric, value=Interval(float(value)))


def check_same_episodes(episodes: EpisodeList, other: EpisodeList) -> None:
    """Check that two agents met the same episodes.

    Raises:
      InputError: they did not, or in other scenes.
    """
    if not has_same_episodes(episodes, other):
        raise InputError("the runs do not meet the same episodes; train both in one world, with equal rules")


# Frontier search


def measure_frontier(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Score frontier search, which needs no training, on the episodes of a run."""
    for shift in bench.config.shifts:
        compiled_world = bench.compile_world(run, shift)
        episode_lists = draw_episode_lists(compiled_world, bench.config.episodes, bench.config.seed)
        outcomes = []
        for bank, bank_episodes in zip(compiled_world.banks, episode_lists, strict=True):
            outcomes.append(run_frontier_search(bank, bank_episodes, compiled_world.scene_step_limits(bank)))

        # The search is deterministic, so it counts as a single run: leaves [1, E].
        outcome = jax.tree.map(lambda *leaves: np.concatenate(leaves)[None], *outcomes)
        episodes = join_episode_lists(episode_lists)
        metrics = episode_metrics(outcome, episodes.best_length)
        for metric in METRIC_COLUMNS:
            values = to_report_units(metric, metrics[metric])
            interval = mean_interval(values, episodes.clusters(), trained=False)
            yield ResultRow(
                world=run.world,
                run=run.agent,
                variant="frontier",
                shift=shift,
                metric=metric,
                value=interval,
                scenes=episodes.num_drawn_scenes,
            )


# Value and cost of experience


def measure_account(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Compare every variant of a run with the layout-blind agents, at every shift.

    The metric `sr remaining` is the share (%) of the lead that remains after a removal: of a value the share kept, of a
    cost 100 minus the share recovered.

    Raises:
      InputError: the experiment has no layout-blind agents, or they differ in world, goals or number of seeds.
    """
    layout_blind_run = require_layout_blind_run(bench, run)
    for shift in bench.config.shifts:
        scores = bench.evaluate(run, shift)
        layout_blind_scores = bench.evaluate(layout_blind_run, shift)
        for lead in measure_leads(scores.results, layout_blind_scores.results):
            fields = row_fields(run, shift, scores.results.rows[lead.row_index])
            fields |= {"reference": layout_blind_run.agent, "scenes": scores.episodes.num_drawn_scenes}
            yield ResultRow(**fields, metric=lead.metric, value=lead.lead)
            if lead.remaining is not None:
                yield ResultRow(**fields, metric=f"{lead.metric} remaining", value=lead.remaining)


def require_layout_blind_run(bench: Bench, run: AgentRun) -> AgentRun:
    """Return the run of layout-blind agents, in the world of a run.

    Raises:
      InputError: there is none, or it differs from the run in world, goals or number of seeds.
    """
    layout_blind_run = bench.layout_blind_run(run.world)
    if layout_blind_run is None:
        raise InputError(
            f"{run.name}: has no layout-blind agents to compare with; train a run of --method anonymous in the same "
            "world, and give its directory as --reference RUN"
        )
    for name in ("world", "scenes", "worlds", "task", "seeds"):
        if getattr(run.config, name) != getattr(layout_blind_run.config, name):
            directories = f"{run.config.run_dir} and {layout_blind_run.config.run_dir}"
            raise InputError(f"{directories} differ in {name}; train both alike")
    if "baseline" not in layout_blind_run.config.arms:
        run_dir = layout_blind_run.config.run_dir
        raise InputError(f"{run_dir}: has no arm `baseline`; train the layout-blind agents with --arms baseline")
    return layout_blind_run


# Groups of agents


def measure_groups(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Compare the mean of each group of agents with an agent, or with another variant of the group.

    Args:
      bench: evaluates the agents.
      run: any run of the world.
    """
    shift = bench.config.shifts[0]
    for name, group in bench.config.groups.items():
        variant, reference = group["variant"], group["against"]
        members = [member for member in _evaluate_agents(bench, run.world, group["agents"], shift) if variant in member]

        # The reference is AGENT/VARIANT, or a variant of the same agents.
        reference_agent, _, reference_variant = reference.rpartition("/")
        if reference_agent:
            reference_agents = _evaluate_agents(bench, run.world, [reference_agent], shift)
        else:
            # Agents without the reference variant are no members.
            members = [member for member in members if reference_variant in member]
            reference_agents = members
        references = [other[reference_variant] for other in reference_agents if reference_variant in other]
        if not members or not references:
            continue

        # The effect varies with the networks of both sides, unless they are the same or the reference has none. A group
        # uses the first S runs of each agent, S being the fewest runs of an agent.
        compared = [member[variant] for member in members]
        for other in (*compared[1:], *references):
            check_same_episodes(compared[0].episodes, other.episodes)
        clusters = compared[0].episodes.clusters()
        is_untrained = reference_variant in UNTRAINED_VARIANTS
        same_runs = is_untrained or (not reference_agent and share_networks(variant, reference_variant))
        num_compared = min(len(scores.metrics["sr"]) for scores in compared)
        num_references = min(len(scores.metrics["sr"]) for scores in references)
        if same_runs:
            num_compared = num_references = min(num_compared, num_references)
        fields = {"world": run.world, "run": name, "variant": variant, "decoding": "argmax", "shift": shift}
        fields |= {"reference": reference}
        for metric in ("sr", "spl"):
            effect = paired_difference(
                _mean_over_agents(references, metric, num_references),
                _mean_over_agents(compared, metric, num_compared),
                clusters,
                same_runs=same_runs,
            )
            yield ResultRow(**fields, metric=metric, value=effect)
        yield ResultRow(**fields, metric="agents", value=Interval(float(len(members))))


def _evaluate_agents(bench: Bench, world: str, agents: Sequence[str], shift: float) -> list[dict[str, VariantScores]]:
    """Scores of every variant with best actions, for each of the agents that has a run in a world."""
    evaluated = []
    for agent in agents:
        agent_run = bench.find_run(world, agent)
        if agent_run is not None:
            evaluated.append(variants_by_name(bench.evaluate(agent_run, shift), "argmax"))
    return evaluated


def _mean_over_agents(scores: Sequence[VariantScores], metric: str, num_runs: int) -> np.ndarray:
    """Average a metric over agents, run by run, [S, E], in the first S training runs."""
    return np.mean([variant.metrics[metric][:num_runs] for variant in scores], axis=0)
