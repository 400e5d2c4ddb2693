"""The document of a comparison of methods, in Markdown.

`write_comparison` writes the page from the results that exist so far: for each world the success of every agent, the
paired improvements between agents, and the cost of training.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence

from jaxnav.evaluation.report import METRIC_COLUMNS, Decoding
from jaxnav.policies.spec import DecisionKind
from jaxnav.study.compare_config import (
    ROW_LABELS,
    VARIANT_LABELS,
    CompareConfig,
    ComparedAgent,
    ComparedRun,
    agent_comparisons,
    chooses_actions,
    compared_runs,
    left_out_runs,
    run_label,
)
from jaxnav.study.document import reading_section, table_lines, write_markdown
from jaxnav.study.records import METRIC_SCALE, AgentResult, RunScores, find_result

DECODING_LABELS: Mapping[Decoding, str] = {"argmax": "best actions", "sample": "sampled actions"}
UNTRAINED_TITLES = {"random": "Random", "frontier": "Frontier search", "oracle": "Shortest path"}
BUDGET_PURPOSES = ("exploration", "imitation", "learning")
#: Results of the runs in one world, by method and decision.
WorldScores = Mapping[tuple[str, DecisionKind], RunScores]


def frontier_name(world: str) -> str:
    """Name of the results of frontier search in a world."""
    return f"{world}-frontier"


def write_comparison(config: CompareConfig, scores_by_name: Mapping[str, RunScores]) -> None:
    """Write the document from the results that exist.

    The text between the two lines `<!-- reading -->` of the document is written by hand and preserved.

    Args:
      config: of the comparison.
      scores_by_name: results of runs by `ComparedRun.name`, and of frontier search by `frontier_name`.

    Raises:
      InputError: the file is another document.
    """
    # All sections are rewritten, for those runs of each world that have results.
    runs = compared_runs(config)
    lines = [*_head_section(config, runs, scores_by_name), *reading_section(config.document)]
    for world in config.worlds:
        world_scores: WorldScores = {
            (run.method, run.decision): scores_by_name[run.name]
            for run in runs
            if run.world == world and run.name in scores_by_name
        }
        frontier = scores_by_name.get(frontier_name(world))
        if world_scores:
            lines += _world_sections(config, world, world_scores, frontier)
    write_markdown(config.document, lines)


def _head_section(
    config: CompareConfig, runs: Sequence[ComparedRun], scores_by_name: Mapping[str, RunScores]
) -> list[str]:
    """Lines of the title and of all that applies to every table."""
    steps_by_world = {}
    for run in runs:
        if run.method not in config.unlearned:
            steps_by_world[run.world] = run.run.total_updates * run.run.steps_per_update
    steps = ", ".join(f"{num_steps:,} in {world}" for world, num_steps in steps_by_world.items())

    lines = [
        f"# {config.title}",
        "",
        f"{config.base.seeds} seeds of each policy. Environment steps of each, imitation included: {steps}"
        f". {config.episodes:,} episodes in each world, of the split `{config.split}` and the same for all rows.",
        "",
        *(f"* {line}" for line in _row_explanations(config)),
        "",
        "Numbers are means over seeds and episodes with 95 % intervals over training runs and scenes "
        "(docs/statistics.md), not corrected for their number. Differences are paired on the episodes. DTS is better "
        "where it is lower. Each policy is the best of several that its training passed through, by other episodes in "
        "scenes of `val`.",
        "",
    ]

    # Runs that are excluded, and runs that are not finished yet.
    for world, left_out in itertools.groupby(left_out_runs(config), lambda run: run.world):
        names = "; ".join(run_label(run.method, run.decision) for run in left_out)
        lines += [f"Left out in {world}, for what they would take: {names}.", ""]
    num_missing = sum(run.name not in scores_by_name for run in runs)
    if num_missing:
        lines += [f"**Not finished:** {num_missing} of {len(runs)} runs are missing.", ""]
    return lines


def _row_explanations(config: CompareConfig) -> list[str]:
    """Explain the names of the rows."""
    lines = [
        "Random, frontier search (it explores without any prior) and the shortest path (it knows everything) are not "
        "trained; their rows are the same in all tables.",
        "A method's name alone: the host, without the layout. `anonymous` cannot know any layout: what a method leads "
        "it by is what its experience is worth.",
    ]
    if "layout" in config.base.arms:
        lines += [
            "`+ w`: the layout's weights multiply its experience (eq. 7).",
            "`+ w + sTDE`: the same policies, experience removed at inference (eq. 2); epsilon "
            f"{config.epsilon:g} and form `{config.form}` were given beforehand, not chosen by these results.",
        ]
    if "streams" in config.decisions:
        lines.append("`streams`: logits are the sum of two streams (docs/methods.md); else there is one core.")
    if config.ablations:
        lines.append("`method:NAME`: a variant of the method (docs/methods.md).")
    if config.unlearned:
        names = ", ".join(run_label(method, "fused") for method in config.unlearned)
        lines.append(f"{names} acts by nothing that is learned, and is trained for one chunk of updates only.")
    return lines


def _world_sections(
    config: CompareConfig, world: str, world_scores: WorldScores, frontier: RunScores | None
) -> list[str]:
    """Lines of all sections of one world."""
    # Agents without training are in the results of every run. Random choices are random actions only if the policy
    # chooses actions, so such a run is preferred.
    untrained_run = next(iter(world_scores.values()))
    for (method, _), run_scores in world_scores.items():
        if chooses_actions(method):
            untrained_run = run_scores
            break
    untrained = [untrained_run]
    if frontier:
        untrained.append(frontier)

    # Tables of success, of improvements and of the training.
    lines = [f"## {world}: {len(untrained_run.scenes)} scenes, {sum(untrained_run.episodes):,} episodes", ""]
    for decoding, label in DECODING_LABELS.items():
        lines += [f"### Success, {label}", "", *_success_table(config, untrained, world_scores, decoding), ""]
    for decoding, label in DECODING_LABELS.items():
        improvements = _improvement_rows(config, world_scores, decoding)
        if improvements:
            header = ("", "SR (points)", "SPL (points)", "DTS (m)")
            lines += [f"### Improvements, {label}", "", *table_lines(header, improvements), ""]
    lines += ["### What the runs took", "", *_training_table(world_scores), ""]
    return [*lines, *_training_notes(world_scores), ""]


def _success_table(
    config: CompareConfig, untrained: Iterable[RunScores], world_scores: WorldScores, decoding: Decoding
) -> list[str]:
    """Table of SR, SPL and DTS of every agent."""
    results: list[tuple[str, AgentResult]] = []

    # Agents without training.
    has_random_actions = any(chooses_actions(method) for method, _ in world_scores)
    for (variant, title), run_scores in itertools.product(UNTRAINED_TITLES.items(), untrained):
        result = find_result(run_scores, variant, decoding)
        if result and (variant != "random" or has_random_actions):
            results.append((title, result))

    # Variants of each run, and random choices where these differ from random actions.
    for (method, decision), run_scores in world_scores.items():
        has_random_choices = method in config.methods and not chooses_actions(method)
        for variant in ROW_LABELS:
            result = find_result(run_scores, variant, decoding)
            if result and (variant in VARIANT_LABELS or has_random_choices):
                results.append((str(ComparedAgent(method, decision, variant)), result))

    # One row per agent, with the decimals of each metric.
    rows = []
    for title, result in results:
        cells = [f"{result.interval(metric):.{METRIC_COLUMNS[metric][1]}f}" for metric in METRIC_SCALE]
        rows.append((title, *cells))
    return table_lines(("", *(METRIC_COLUMNS[metric][0] for metric in METRIC_SCALE)), rows)


def _improvement_rows(config: CompareConfig, world_scores: WorldScores, decoding: Decoding) -> list[tuple[str, ...]]:
    """Rows of the paired differences between agents."""
    rows = []
    for agent, reference in agent_comparisons(config):
        agent_scores = world_scores.get((agent.method, agent.decision))
        reference_scores = world_scores.get((reference.method, reference.decision))
        agent_result = find_result(agent_scores, agent.variant, decoding)
        reference_result = find_result(reference_scores, reference.variant, decoding)
        if not (agent_result and reference_result):
            continue

        cells = []
        for metric in METRIC_SCALE:
            _, digits = METRIC_COLUMNS[metric]
            cells.append(f"{agent_result.difference(reference_result, metric):+z.{digits}f}")
        rows.append((f"{agent} over {reference}", *cells))
    return rows


def _training_table(world_scores: WorldScores) -> list[str]:
    """Table of the steps, the time and the convergence of every run."""
    rows = []
    for (method, decision), run_scores in world_scores.items():
        training = run_scores.training
        if training is None:
            continue
        steps = [f"{training.budget[purpose]:,}" for purpose in BUDGET_PURPOSES]
        course = "{:.1f} → {:.1f}".format(*training.course) if training.course else "-"
        rows.append((run_label(method, decision), *steps, f"{training.wall_s / 60:,.1f}", course))

    step_titles = [f"{purpose} (steps)" for purpose in BUDGET_PURPOSES]
    return table_lines(("run", *step_titles, "wall time (min)", "val SR (%)"), rows)


def _training_notes(world_scores: WorldScores) -> list[str]:
    """Lines on how the table of trainings is read, and the notes of the runs."""
    seconds = []
    runs_by_note: dict[str, list[str]] = {}
    for (method, decision), run_scores in world_scores.items():
        if run_scores.training is None:
            continue
        seconds.append(run_scores.training.wall_s)
        for note in run_scores.training.notes:
            runs_by_note.setdefault(note, []).append(run_label(method, decision))
    minutes = sum(seconds) / 60

    lines = [
        "Exploration, imitation and learning are the environment steps behind each policy; exploration serves the "
        "layout's priors and the graph of `sp`. What else methods know before training they read from the training "
        "scenes themselves (docs/methods.md). The wall time is that of "
        f"the whole run, all its seeds, without and with w, side by side; all runs together took {minutes:,.0f} "
        "minutes of training. Val SR is that of best actions, the mean of "
        "all policies, before the last quarter of training and at its end: where it rises, longer training pays.",
        "",
    ]
    for note, runs in runs_by_note.items():
        subject = "; ".join(runs) if len(runs) < len(world_scores) else "All runs"
        lines.append(f"* {subject}: {note}")
    return lines
