"""The evaluation report, its tables, and the accounting of experience.

A report is a plain dictionary that JSON represents exactly; SR, SPL and SAE are in percent (0-100), DTS in metres.
`build_report` assembles a report from `build_row` and `build_difference`; `results_table`, `difference_table` and
`markdown_table` print it.

The accounting compares an agent with a layout-blind agent on the same episodes. The lead of the agent is
the difference of their results. If the layout matches training, the lead is the value of experience; under a layout
shift, a negative lead is its cost. `remaining_share` is the part of the lead that remains after a removal.
"""

import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxnav.choices import Form, RowDecoding, Variant
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import (
    Clusters,
    Interval,
    interquartile_mean,
    jackknife_interval,
    mean_interval,
    paired_difference,
    probability_of_improvement,
    run_clusters,
    scene_clusters,
)
from jaxnav.store.files import WRITTEN_BY_0_1, installed_versions, write_atomic

#: Version of the JSON layout.
REPORT_FORMAT = 1

#: Variants without training, whose seeds are repetitions.
UNTRAINED_VARIANTS: tuple[Variant, ...] = ("oracle", "frontier", "random")
#: Smallest L* of the episodes in each bucket.
_LENGTH_BUCKETS = {"L>=1": 1, "L>=5": 5}


def build_row(
    *,
    variant: Variant,
    method: str,
    world: str,
    split: str,
    epsilon: float | None,
    decoding: RowDecoding,
    form: Form | None,
    metrics: dict[str, np.ndarray],
    episodes: EpisodeList,
    trained: bool = True,
) -> dict[str, Any]:
    """Build one row: the metrics of a variant, over all episodes and by bucket (L* >= 1, L* >= 5).

    Every episode has L* >= 1, so the overall metrics are those of the first bucket. A bucket without episodes holds
    `"episodes": 0` and no metrics.

    Args:
      variant: the evaluated variant; with `method`, `world` and `split` it identifies the row.
      method: name of the method as printed, for example `ORG`.
      world: world of the episodes.
      split: `train`, `val` or `test`.
      epsilon: threshold of sTDE; None for other variants.
      decoding: rule that turns logits into actions.
      form: how counterfactual logits are combined; None for variants without counterfactual.
      metrics: metrics of `episode_metrics` by name, each [S, E].
      episodes: the E episodes.
      trained: True to generalize to other training runs; False for the interval of these agents in other scenes.

    Raises:
      InputError: results not finite or out of range.
    """
    scaled_metrics = {}
    for metric_name, metric_values in metrics.items():
        scaled_metrics[metric_name] = to_report_units(metric_name, metric_values)

    # Each metric with its interval, bucket by bucket.
    is_trained = trained and variant not in UNTRAINED_VARIANTS
    buckets: dict[str, dict[str, Any]] = {}
    for bucket_name, min_length in _LENGTH_BUCKETS.items():
        in_bucket = episodes.best_length >= min_length
        buckets[bucket_name] = {"episodes": int(in_bucket.sum())}
        if in_bucket.any():
            clusters = scene_clusters(episodes.floor_plans[in_bucket], episodes.room[in_bucket])
            for metric_name, metric_values in scaled_metrics.items():
                interval = mean_interval(metric_values[:, in_bucket], clusters, trained=is_trained)
                buckets[bucket_name][metric_name] = interval.to_json()

    # The interquartile mean of all episodes, which a few very good or bad homes do not decide.
    interquartile_means = {}
    for metric_name in ("sr", "spl"):
        interval = interquartile_mean(scaled_metrics[metric_name], episodes.clusters(), trained=is_trained)
        interquartile_means[metric_name] = interval.to_json()

    # The overall metrics stand in the row itself, next to all buckets.
    return {
        "variant": variant,
        "method": method,
        "world": world,
        "split": split,
        "epsilon": epsilon,
        "decoding": decoding,
        "form": form,
        "seeds": len(metrics["sr"]),
        **buckets["L>=1"],
        "interquartile_mean": interquartile_means,
        "buckets": buckets,
    }


def build_difference(
    metric: str,
    reference: tuple[str, np.ndarray],
    compared: tuple[str, np.ndarray],
    *,
    epsilon: float | None,
    form: Form | None,
    decoding: RowDecoding,
    episodes: EpisodeList,
    same_runs: bool = False,
    trained: bool = True,
) -> dict[str, Any]:
    """Build one paired difference, `compared - reference` over all episodes, in the report's units.

    Args:
      metric: a key of the metrics.
      reference: (name of the variant, its results [S, E] as given to `build_row`).
      compared: the variant compared with it, in the same form.
      epsilon: threshold of sTDE; None for other variants.
      form: how the compared variant combines counterfactual logits; None for variants without counterfactual.
      decoding: rule that turns logits into actions, equal for both variants.
      episodes: the E episodes.
      same_runs: True if equal seed indices are the same network (see `paired_difference`).
      trained: see `build_row`.

    Raises:
      InputError: results not finite or out of range.
    """
    reference_name, reference_results = reference
    compared_name, compared_results = compared

    # The difference is taken episode by episode, over all lengths L*.
    reference_values = to_report_units(metric, reference_results)
    compared_values = to_report_units(metric, compared_results)
    clusters = episodes.clusters()
    paired = paired_difference(reference_values, compared_values, clusters, same_runs=same_runs, trained=trained)

    # A distance is better if it is shorter.
    sign = -1.0 if metric == "dts" else 1.0
    improvement = probability_of_improvement(
        sign * reference_values, sign * compared_values, clusters, same_runs=same_runs, trained=trained
    )
    return {
        "metric": metric,
        "from": reference_name,
        "to": compared_name,
        "epsilon": epsilon,
        "form": form,
        "decoding": decoding,
        **paired.to_json(),
        "probability_of_improvement": improvement.to_json(),
    }


def build_report(
    rows: list[dict[str, Any]],
    differences: list[dict[str, Any]],
    notes: list[str],
    compilations: int,
    run: dict[str, Any],
    decision_shares: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Build the report.

    Args:
      rows: see `build_row`.
      differences: see `build_difference`.
      notes: see `jaxnav.evaluation.notes`.
      compilations: number of compilations of the evaluation.
      run: settings of the run.
      decision_shares: see `jaxnav.runs.share_report`; reports of versions before 0.4 have none.
    """
    return {
        "run": run,
        "rows": rows,
        "differences": differences,
        "decision_shares": list(decision_shares),
        "notes": notes,
        "compilations": compilations,
        "versions": package_versions(),
        "format": REPORT_FORMAT,
    }


def package_versions() -> dict[str, str]:
    """Look up the versions of Python and packages that influence results."""
    return installed_versions(("jaxnav", "jax", "flax", "numpy")) | {"python": platform.python_version()}


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write the report as JSON, replacing the file atomically.

    Raises:
      ValueError: the report holds NaN or an infinity; nothing is written.
    """
    write_atomic(path, (json.dumps(report, indent=2, allow_nan=False) + "\n").encode())


def to_report_units(metric: str, metric_values: np.ndarray) -> np.ndarray:
    """Check results and convert fractions to percent; `dts` stays in metres.

    Args:
      metric: name of a metric of `jaxnav.evaluation.grid.episode_metrics`.
      metric_values: its values, [...].

    Raises:
      InputError: a value is NaN or out of range.
    """
    # Only the distance to success is not a fraction of episodes.
    metric_values = np.asarray(metric_values, np.float64)
    is_distance = metric == "dts"
    upper_bound = np.inf if is_distance else 1.0

    # Comparisons with NaN are false; `isfinite` also refuses an infinite distance.
    if not ((metric_values >= 0) & (metric_values <= upper_bound) & np.isfinite(metric_values)).all():
        valid_range = "metres, at least 0" if is_distance else "fractions from 0 to 1"
        raise InputError(f"{metric} contains NaN or values out of range; give {valid_range}")
    return metric_values * (1.0 if is_distance else 100.0)


def read_report(path: Path) -> dict[str, Any]:
    """Read the report that an evaluation wrote.

    Raises:
      InputError: the file cannot be read, or is not a report of this format.
    """
    remedy = "give a JSON file that jaxnav eval wrote"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no evaluation can be read from it ({error}); {remedy}") from error
    if not isinstance(report, dict) or report.get("format") != REPORT_FORMAT or "compilations" not in report:
        raise InputError(f"{path}: is not an evaluation of format {REPORT_FORMAT}; {remedy}")
    # Reports have notes since version 0.2.
    if "notes" not in report:
        raise InputError(f"{path}: {WRITTEN_BY_0_1}")
    return report


#: Titles and decimal places of the metrics.
METRIC_COLUMNS = {"sr": ("SR (%)", 1), "spl": ("SPL (%)", 1), "dts": ("DTS (m)", 2)}
#: Titles of the failures, which are printed as means without intervals.
_FAILURE_COLUMNS = {"timeout": "Time-out (%)", "wrong_done": "Wrong Done (%)"}


def results_table(report: dict[str, Any]) -> Table:
    """Make the table of a report for a terminal.

    One line per row, `mean [95 % interval]`, under a heading per world, split and decoding.
    """
    table = Table("Variant", *_column_titles(report))
    for heading, table_lines in _lines_by_heading(report).items():
        table.add_section()
        table.add_row(heading, style="bold")
        for cells in table_lines:
            table.add_row(*cells)
    return table


def difference_table(report: dict[str, Any]) -> Table:
    """Make the table of the paired differences for a terminal.

    One line per comparison and decoding, `mean [95 % interval]`, and the probability of improvement in SR.
    """
    # A report lists one difference per metric; its metrics stand side by side in the table.
    cells_by_comparison: dict[tuple[str, str], list[str]] = {}
    improvement_by_comparison: dict[tuple[str, str], str] = {}
    for difference in report["differences"]:
        _, digits = METRIC_COLUMNS[difference["metric"]]
        cell = f"{Interval.from_json(difference):+.{digits}f}"
        comparison = (difference_label(difference), difference["decoding"])
        cells_by_comparison.setdefault(comparison, []).append(cell)
        # Reports of versions before 0.4 lack the probability.
        if difference["metric"] == "sr" and "probability_of_improvement" in difference:
            improvement = Interval.from_json(difference["probability_of_improvement"])
            improvement_by_comparison[comparison] = f"{improvement:.2f}"

    # The report lists the differences of a comparison in the order of these columns.
    table = Table("Difference, paired on episodes", "decoding", *_metric_titles(), "P(better SR)")
    for comparison, cells in cells_by_comparison.items():
        table.add_row(*comparison, *cells, improvement_by_comparison.get(comparison, ""))
    return table


#: Names of the parts of a decision, as printed in tables.
PART_LABELS = {
    "other_categories": "other categories in Z",
    "experience": "Z",
    "prior_weights": "w (prior instead)",
    "uniform_weights": "w (uniform instead)",
    "scene_and_goal": "scene and goal",
    "memory": "memory",
}
#: Titles of the columns of decision shares.
_SHARE_TITLES = ("share (%)", "partner difference (%)", "cost in SPL", "cost in SR")


def has_decision_shares(report: dict[str, Any]) -> bool:
    """True if a report has decision shares; those of versions before 0.4 have none."""
    return bool(report.get("decision_shares"))


def decision_share_table(report: dict[str, Any]) -> Table:
    """Make the table of the decision shares for a terminal.

    One line per row and part: how many decisions change when the part becomes that of another episode, how many differ
    between the parts of two other episodes (partners), and what the change costs throughout the episode.
    """
    table = Table("Part of the decision", "decoding", *_SHARE_TITLES)
    previous_variant = ""
    for entry in report["decision_shares"]:
        if entry["variant"] != previous_variant:
            table.add_section()
            table.add_row(_share_heading(report, entry), style="bold")
            previous_variant = entry["variant"]
        table.add_row(PART_LABELS[entry["part"]], entry["decoding"], *_share_cells(entry))
    return table


def _share_heading(report: dict[str, Any], entry: dict[str, Any]) -> str:
    """Name of the row whose decisions an entry is about."""
    for row in report["rows"]:
        if row["variant"] == entry["variant"]:
            return row_label(row)
    return entry["variant"]


def _share_cells(entry: dict[str, Any]) -> list[str]:
    """Cells of one entry: share, partner difference, cost in SPL, cost in SR; empty without a measurement."""
    partner_difference = entry["partner_difference"]
    cost = entry["cost"]
    cells = [
        f"{Interval.from_json(entry['share']):.1f}",
        "" if partner_difference is None else f"{Interval.from_json(partner_difference):.1f}".partition(" ")[0],
    ]
    for metric in ("spl", "sr"):
        cells.append("" if cost is None else f"{Interval.from_json(cost[metric]):+.1f}")
    return cells


def _share_markdown(report: dict[str, Any]) -> str:
    """Table of the decision shares in Markdown."""
    titles = ("Row", "Part of the decision", "decoding", *_SHARE_TITLES)
    lines = [titles, ("---", "---", "---", *["---:"] * len(_SHARE_TITLES))]
    for entry in report["decision_shares"]:
        heading = _share_heading(report, entry)
        lines.append((heading, PART_LABELS[entry["part"]], entry["decoding"], *_share_cells(entry)))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def markdown_table(report: dict[str, Any]) -> str:
    """Make the table of a report in Markdown, with its notes, ending with a newline."""
    # Title and alignment: text to the left, numbers to the right.
    column_titles = _column_titles(report)
    blank_cells = [""] * len(column_titles)
    table_lines: list[tuple[str, ...]] = [("Variant", *column_titles), ("---", *["---:"] * len(column_titles))]

    # Markdown has no sections, so a heading fills a line of its own.
    for heading, group_lines in _lines_by_heading(report).items():
        table_lines.append((f"**{heading}**", *blank_cells))
        table_lines.extend(group_lines)

    text_parts = []
    for cells in table_lines:
        text_parts.append(f"| {' | '.join(cells)} |\n")
    if has_decision_shares(report):
        text_parts.append("\n" + _share_markdown(report))
    for note in report["notes"]:
        text_parts.append(f"\n{note}\n")
    return "".join(text_parts)


def _metric_titles() -> list[str]:
    """Titles of the metrics with intervals."""
    return [title for title, _ in METRIC_COLUMNS.values()]


def _column_titles(report: dict[str, Any]) -> list[str]:
    """Titles of all columns after the first."""
    budgets = ", ".join(map(str, _action_budgets(report)))
    return [*_metric_titles(), f"SR within {budgets} (%)", *_FAILURE_COLUMNS.values()]


def _action_budgets(report: dict[str, Any]) -> list[int]:
    """Action budgets N of the metrics `sr@N`."""
    # All rows of a report have the same budgets.
    budgets = []
    for name in report["rows"][0]:
        if name.startswith("sr@"):
            budgets.append(int(name.removeprefix("sr@")))
    return sorted(budgets)


def _lines_by_heading(report: dict[str, Any]) -> dict[str, list[tuple[str, ...]]]:
    """Cells of the table's lines, grouped by heading and in order."""
    budgets = _action_budgets(report)
    table_lines: dict[str, list[tuple[str, ...]]] = {}
    for row in report["rows"]:
        # Metrics with intervals, then success within the budgets, together in one column, then failures.
        cells = [row_label(row)]
        for metric, (_, digits) in METRIC_COLUMNS.items():
            cells.append(f"{Interval.from_json(row[metric]):.{digits}f}")
        budget_cells = [f"{row[f'sr@{budget}']['mean']:.1f}" for budget in budgets]
        cells.append(", ".join(budget_cells))
        for metric in _FAILURE_COLUMNS:
            cells.append(f"{row[metric]['mean']:.1f}")

        # Rows are compared within one world, split and decoding only.
        heading = f"{row['world']} {row['split']}"
        if row["decoding"] != "own":
            heading += f", {row['decoding']} decoding"
        table_lines.setdefault(heading, []).append(tuple(cells))
    return table_lines


#: What the label of a row adds for its form of equation 2, unless that is the usual one of the variant.
FORM_SUFFIXES: dict[Form, str] = {
    "paper": ", paper form",
    "residual": ", residual form",
    "switch": ", switch",
    "mixture": ", mixture",
}


def row_label(row: dict[str, Any]) -> str:
    """Name of a report's row, as printed in tables."""
    match row["variant"]:
        case "oracle":
            return "Shortest path (oracle)"
        case "random":
            return "Random"
        case "frontier":
            return "Frontier search"
        case "agent":
            return row["method"]
        case "baseline":
            return f"{row['method']} (baseline)"
        case "layout":
            return "+ w (layout)"
        case "tde":
            return "+ w + TDE"
        case "cde":
            return "+ w + CDE"
        case "scde":
            form_suffix = "" if row["form"] == "paper" else FORM_SUFFIXES[row["form"]]
            return f"+ w + sCDE (eps={row['epsilon']:g}){form_suffix}"
        case _:
            form_suffix = "" if row["form"] == "residual" else FORM_SUFFIXES[row["form"]]
            return f"+ w + sTDE (eps={row['epsilon']:g}){form_suffix}"


def difference_label(difference: dict[str, Any]) -> str:
    """Name of a report's paired difference, as printed in tables."""
    compared = row_label({"method": "", **difference, "variant": difference["to"]})
    reference = {"layout": "+ w", "random": "Random", "frontier": "Frontier search"}.get(
        difference["from"], difference["from"]
    )
    return f"{compared} vs. {reference}"


class ExperienceLead(NamedTuple):
    """Lead of a row over the layout-blind agent, in one metric.

    Attributes:
      row_index: index of the row in the evaluation.
      variant: label of the row, as printed in tables.
      decoding: rule that turns logits into actions.
      metric: `sr`, `spl` or `sr@N`.
      lead: difference to the layout-blind agent, in percentage points.
      remaining: share of the lead that remains after removal, in percent; None for rows that remove nothing. Of a
        value of experience, this is the share kept; of a cost, 100 minus this share is recovered.
    """

    row_index: int
    variant: str
    decoding: RowDecoding
    metric: str
    lead: Interval
    remaining: Interval | None


def remaining_share(
    layout_blind: np.ndarray, agent: np.ndarray, removed: np.ndarray, scenes: Clusters, *, same_runs: bool = False
) -> Interval:
    """Compute the share of an agent's lead that remains after removal.

    The share is (removed - layout_blind) / (agent - layout_blind), of means over the same episodes.

    Args:
      layout_blind: bool, int or float [S, E], results of the layout-blind agent.
      agent: [S, E], results of the agent with experience.
      removed: [S, E], results of the policies of `agent`, with removal.
      scenes: clusters of the E episodes.
      same_runs: whether both agents are the same S training runs, or were trained separately.

    Returns:
      The share in percent, with its interval; NaN if the interval of the lead contains 0 or has no bounds.
    """
    # A share of a lead that may be 0 is meaningless.
    lead = paired_difference(layout_blind, agent, scenes, same_runs=same_runs)
    if not lead.has_bounds or lead.low <= 0.0 <= lead.high:
        return Interval(float("nan"))

    # Replicates leave out one run (of either agent, if they were trained separately), and one scene; numerator and
    # denominator leave out the same.
    runs = run_clusters(len(agent)) if same_runs else run_clusters(len(agent), len(agent))

    def lead_replicates(results: np.ndarray) -> np.ndarray:
        both_results = -np.asarray(layout_blind, np.float64), np.asarray(results, np.float64)
        signed_results = sum(both_results) if same_runs else np.concatenate(both_results)
        return runs.weights.T @ signed_results @ scenes.weights

    return jackknife_interval(100.0 * lead_replicates(removed) / lead_replicates(agent), scenes, runs)


def accounting_table(entries: Sequence[ExperienceLead]) -> Table:
    """Make the table of leads for a terminal.

    One line per row of the evaluation, `mean [95 % interval]`.
    """
    # Entries are one per metric; those of one row form a line.
    leads_by_row: dict[tuple[str, str], dict[str, ExperienceLead]] = {}
    for lead_entry in entries:
        leads_by_row.setdefault((lead_entry.variant, lead_entry.decoding), {})[lead_entry.metric] = lead_entry

    # Columns in the order in which the metrics first occur. Names are printed as text, without markup.
    metric_names = dict.fromkeys(lead_entry.metric for lead_entry in entries)
    table = Table("Variant", "decoding", *map(_lead_title, metric_names), "left of SR (%)")
    for row_name, lead_by_metric in leads_by_row.items():
        table.add_row(*map(Text, (*row_name, *_lead_cells(lead_by_metric))))
    return table


def _lead_cells(lead_by_metric: Mapping[str, ExperienceLead]) -> list[str]:
    """Cells of one line: the lead in each metric, then the remaining share of SR."""
    cells = []
    for lead_entry in lead_by_metric.values():
        cells.append(f"{lead_entry.lead:+.1f}")
    remaining = lead_by_metric["sr"].remaining
    return [*cells, "" if remaining is None else f"{remaining:.0f}"]


def _lead_title(metric: str) -> str:
    metric_name, _, budget = metric.partition("@")
    return f"{metric_name.upper()} within {budget}" if budget else metric_name.upper()
