"""The document of a comparison, in Markdown."""

import itertools
from collections.abc import Iterable, Mapping, Sequence

from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.report_tables import COLUMNS
from jaxnav.policies.spec import Deciding
from jaxnav.study.compare_config import CompareConfig, Entry, entries, left_out
from jaxnav.study.compare_pairs import LABELS, VARIANTS, TableRow, chooses_actions, comparisons, run_label
from jaxnav.study.compare_report import SCALE, Line, Scores
from jaxnav.study.document import reading_section, write_lines
from jaxnav.study.tables import markdown

DECODINGS: Mapping[Decoding, str] = {"argmax": "best actions", "sample": "sampled actions"}
REFERENCE_TITLES = {"random": "Random", "frontier": "Frontier search", "oracle": "Shortest path"}
#: Results of a world's runs, by method and decision.
Parts = Mapping[tuple[str, Deciding], Scores]


def frontier_name(world: str) -> str:
    """Return the name of the results of frontier search."""
    return f"{world}-frontier"


def write_comparison(config: CompareConfig, found: Mapping[str, Scores]) -> None:
    """Write the document from the results that are there.

    What stands between the two lines `<!-- reading -->` of the document is kept: it is written by hand.

    Raises:
      InputError: the document is another one.
    """
    runs = entries(config)
    lines = [*_head(config, runs, found), *reading_section(config.document)]
    for world in config.worlds:
        there = [entry for entry in runs if entry.world == world and entry.name in found]
        parts: Parts = {(entry.method, entry.decision): found[entry.name] for entry in there}
        lines += _world(config, world, parts, found.get(frontier_name(world)))
    write_lines(config.document, lines)


def _head(config: CompareConfig, runs: Sequence[Entry], found: Mapping[str, Scores]) -> list[str]:
    """Return the title and what holds for all tables."""
    learning = [entry for entry in runs if entry.method not in config.unlearned]
    steps = {entry.world: entry.run.total_updates * entry.run.update_steps for entry in learning}
    text = [
        f"{config.base.seeds} seeds of each policy. Environment steps of each, imitation included: "
        + ", ".join(f"{number:,} in {world}" for world, number in steps.items())
        + f". {config.episodes:,} episodes in each world, of the split `{config.split}` and the same for all rows.",
        "",
        *(f"* {line}" for line in _reading_help(config)),
        "",
        "Numbers are means over seeds and episodes with 95 % intervals over training runs and scenes "
        "(docs/statistics.md), not corrected for their number. Differences are paired on the episodes. DTS is better "
        "where it is lower. Each policy is the best of several that its training passed through, by other episodes in "
        "scenes of `val`.",
        "",
    ]
    for world, never in itertools.groupby(left_out(config), lambda entry: entry.world):
        names = "; ".join(run_label(entry.method, entry.decision) for entry in never)
        text += [f"Left out in {world}, for what they would take: {names}.", ""]
    if left := [entry.name for entry in runs if entry.name not in found]:
        text += [f"**Not finished:** {len(left)} of {len(runs)} runs are missing.", ""]
    return [f"# {config.title}", "", *text]


def _reading_help(config: CompareConfig) -> list[str]:
    """Return what the names of the rows mean."""
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


def _world(config: CompareConfig, world: str, parts: Parts, frontier: Scores | None) -> list[str]:
    """Return all sections of one world."""
    if not parts:
        return []
    # Where a policy chooses no actions, random choices are no random actions.
    one = next((part for run, part in parts.items() if chooses_actions(run[0])), next(iter(parts.values())))
    untrained = [one, *([frontier] if frontier else [])]
    lines = [f"## {world}: {len(one.scenes)} scenes, {sum(one.episodes):,} episodes", ""]
    for decoding, name in DECODINGS.items():
        lines += [f"### Success, {name}", "", *_metrics_table(config, untrained, parts, decoding), ""]
    for decoding, name in DECODINGS.items():
        if improved := _improvements(config, parts, decoding):
            header = ("", "SR (points)", "SPL (points)", "DTS (m)")
            lines += [f"### Improvements, {name}", "", *markdown(header, improved), ""]
    return [*lines, "### What the runs took", "", *_training_table(parts), "", *_notes(parts), ""]


def _searches(config: CompareConfig, method: str) -> bool:
    """Return whether random choices are another agent than Random."""
    return method in config.methods and not chooses_actions(method)


def _metrics_table(config: CompareConfig, untrained: Iterable[Scores], parts: Parts, decoding: Decoding) -> list[str]:
    """Return SR, SPL and DTS of every agent."""
    rows = [
        (title, part, line)
        for (variant, title), part in itertools.product(REFERENCE_TITLES.items(), untrained)
        if (line := part.line(variant, decoding)) and (variant != "random" or any(chooses_actions(m) for m, _ in parts))
    ]
    rows += [
        (str(TableRow(*run, variant)), part, line)
        for (run, part), variant in itertools.product(parts.items(), LABELS)
        if (line := part.line(variant, decoding)) and (variant in VARIANTS or _searches(config, run[0]))
    ]
    cells = [
        (title, *(f"{part.summary(line, metric):.{COLUMNS[metric][1]}f}" for metric in SCALE))
        for title, part, line in rows
    ]
    return markdown(("", *(COLUMNS[metric][0] for metric in SCALE)), cells)


def _improvements(config: CompareConfig, parts: Parts, decoding: Decoding) -> list[tuple[str, ...]]:
    """Return the paired differences between agents, as cells."""

    def line(agent: TableRow) -> tuple[Scores, Line] | None:
        part = parts.get((agent.method, agent.decision))
        found = part and part.line(agent.variant, decoding)
        return (part, found) if part and found else None

    cells = []
    for agent, reference in comparisons(config):
        if (one := line(agent)) and (other := line(reference)):
            differences = (one[0].difference(one[1], *other, metric) for metric in SCALE)
            values = (f"{each:+z.{COLUMNS[metric][1]}f}" for metric, each in zip(SCALE, differences, strict=True))
            cells.append((f"{agent} over {reference}", *values))
    return cells


def _training_table(parts: Parts) -> list[str]:
    """Return the steps, the time and the last course of every run."""
    rows = []
    for run, part in parts.items():
        if training := part.training:
            steps = (f"{training.budget[name]:,}" for name in ("exploration", "imitation", "learning"))
            course = "{:.1f} → {:.1f}".format(*training.course) if training.course else "-"
            rows.append((run_label(*run), *steps, f"{training.wall_s / 60:,.1f}", course))
    return markdown(
        ("run", "exploration (steps)", "imitation (steps)", "learning (steps)", "wall time (min)", "val SR (%)"),
        rows,
    )


def _notes(parts: Parts) -> list[str]:
    """Return what the tables' reader must be told."""
    told: dict[str, list[str]] = {}
    for run, part in parts.items():
        for note in part.training.notes if part.training else ():
            told.setdefault(note, []).append(run_label(*run))
    minutes = sum(part.training.wall_s for part in parts.values() if part.training) / 60
    return [
        "Exploration, imitation and learning are the environment steps behind each policy; exploration serves the "
        "layout's priors and the graph of `sp`. What else methods know before training they read from the training "
        "scenes themselves (docs/methods.md). The wall time is that of "
        f"the whole run, all its seeds, without and with w, side by side; all runs together took {minutes:,.0f} "
        "minutes of training. Val SR is that of best actions, the mean of "
        "all policies, before the last quarter of training and at its end: where it rises, longer training pays.",
        "",
        *(f"* {'; '.join(runs) if len(runs) < len(parts) else 'All runs'}: {note}" for note, runs in told.items()),
    ]
