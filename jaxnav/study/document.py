"""The study's document: Markdown tables and sections, written from the result files.

`write_study_document` reads the results on `val` and `test` and writes the whole page; only the summary between two
`<!-- reading -->` marks is written by hand and preserved. The comparison of methods uses the same helpers for its own
pages (`table_lines`, `reading_section`, `write_markdown`).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from jaxnav.errors import InputError
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.statistics import Interval
from jaxnav.runs.policies import GapName
from jaxnav.store.files import write_atomic
from jaxnav.study.claims import study_claims
from jaxnav.study.records import (
    STDE_OPTIONS,
    Condition,
    GapCurves,
    InstrumentReport,
    MixtureReport,
    StdeOptions,
    Trial,
    TrialControl,
    TrialRow,
    instrument_verdicts,
    measure_rows,
)
from jaxnav.study.results import StudyResults, load_study_results

READING_MARK = "<!-- reading -->"
FIGURE_CAPTIONS = {
    "fig4": "Fig. 4: success of the baseline against similarity of the layout, a point per category and scene",
    "fig5": "Fig. 5: gain of + w + sTDE (epsilon 0.5) over the baseline, per category",
    "fig6a": "Fig. 6a: SR, SPL and DTS over epsilon",
    "fig6b": "Fig. 6b: mean gap per step, updated and frozen",
    "auc": "AUC of the gap per step, last shift against the first",
    "effects": "Differences of SR to the layout's weights",
}
#: Controls of sTDE, as printed after its name.
CONTROL_LABELS: Mapping[TrialControl | None, str] = {
    None: "",
    "constant": ", weight constant, of equal mean",
    "shuffled": ", weight of the next episode",
    "noise": ", noise taken out",
    "random": ", random intervention",
    "zeros": ", zeros taken out, sampled actions",
}
#: Controls of a removal in a mixed population, by the gap that replaces its own; others are clocks.
GAP_CONTROL_LABELS = {
    "shuffled": "the gap of another episode",
    "course": "the mean gap of all episodes at the time",
}
#: Gaps of Table 1 and of the controls.
GAP_LABELS: Mapping[GapName, str] = {"novelty": "", "evidence": ", `evidence`"}
#: Steps in the table of the gap's AUC.
AUC_STEPS = (0, 1, 5, 10, 20, 40, 80)


# The document


def check_document(document: Path) -> None:
    """Refuse to overwrite another document.

    Raises:
      InputError: the file exists and does not hold two reading marks.
    """
    if document.exists() and document.read_text(encoding="utf-8").count(READING_MARK) != 2:
        raise InputError(f"{document}: is there, without two lines {READING_MARK}; give another --document")


def write_study_document(results_folder: Path, document: Path) -> None:
    """Write the document from the results on `val` and `test`.

    The text between the two lines `<!-- reading -->` of the document is written by hand and preserved.

    Raises:
      InputError: there are no results on `val`, or see `check_document`.
    """
    val_results = load_study_results(results_folder / "val")
    test_results = load_study_results(results_folder / "test")
    if val_results is None:
        raise InputError(f"{results_folder / 'val'}: holds no results; run the study first")

    lines = _head_section(val_results, reading_section(document))
    for world in val_results.worlds:
        lines += _world_sections(val_results, world)

    if test_results is not None:
        lines += ["## Test, touched once", ""]
        lines += ["Epsilon (of the residual form) was chosen on `val`, at the first shift.", ""]
        for world_results in test_results.worlds.values():
            lines += [*metrics_table(world_results.conditions, "argmax"), ""]
    write_markdown(document, lines)


def reading_section(document: Path) -> list[str]:
    """Lines of the summary, whose text is written by hand and preserved.

    Raises:
      InputError: see `check_document`.
    """
    check_document(document)
    summary = "\n\n"
    if document.exists():
        summary = document.read_text(encoding="utf-8").split(READING_MARK)[1]
    return ["## Summary", "", READING_MARK + summary + READING_MARK, ""]


def write_markdown(document: Path, lines: Sequence[str]) -> None:
    """Write the lines of a document atomically."""
    write_atomic(document, ("\n".join(lines).rstrip() + "\n").encode())


def table_lines(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; all columns but the first are right-aligned."""
    alignment = ["---"] + ["---:"] * (len(header) - 1)
    return [f"| {' | '.join(cells)} |" for cells in (header, alignment, *rows)]


def _head_section(results: StudyResults, reading: Sequence[str]) -> list[str]:
    return [
        "# The study: the paper's claims put to the test",
        "",
        f"{results.seeds} seeds, {results.total_steps:,} steps a policy, {results.episodes:,} episodes at each shift, "
        "split `val`. Intervals are of 95 %, over training runs and scenes (statistics.md), not corrected for their "
        "number. `least` is the least effect that would matter. All but the summary is written by `jaxnav study`, from "
        "the results.",
        "",
        *reading,
    ]


def _world_sections(results: StudyResults, world: str) -> list[str]:
    """Lines of all sections of one world."""
    world_results = results.worlds[world]
    conditions = world_results.conditions
    is_generated = world == "main"

    # Claims and instrument.
    title = f"Generated {conditions[0].world}" if is_generated else "Scenes of the file"
    lines = [f"## {title}: {conditions[0].scenes} scenes", ""]
    lines += ["### Claims", "", *claims_table(results, world), ""]
    lines += ["### Is it an instrument?", "", *instrument_table(world_results.instrument), ""]

    # Metrics of all variants.
    lines += [
        "### Table 1",
        "",
        "SR and SPL in percent, DTS in metres; ± is over seeds. `to +w` is the difference of",
        "SR to the layout's weights, paired (for `+ w`: to the baseline). Weight: mean of what is taken out.",
        "",
    ]
    lines += ["Best actions:", "", *metrics_table(conditions, "argmax"), ""]
    lines += ["Sampled actions:", "", *metrics_table(conditions, "sample"), ""]
    if is_generated and results.mixtures:
        lines += mixture_sections(results.mixtures)

    # Controls, and the other training runs, which exist for generated rooms only.
    lines += ["### Controls", "", *controls_table(conditions), ""]
    goal_conditions = results.runs.get("goal")
    if is_generated and goal_conditions:
        title = "### Controls where the direct pathway sees the goal's detection alone"
        lines += [title, "", *controls_table(goal_conditions), ""]
    if is_generated:
        title = "### How the parts are made: settings, counterfactual branch, one factor at a time"
        lines += [title, "", *runs_table(results), ""]

    # The gap by step, and the figures.
    lines += ["### Does the gap track the layout?", "", *gap_auc_tables(world_results.gap_curves), ""]
    lines += ["### Figures", ""]
    for figure_name, caption in FIGURE_CAPTIONS.items():
        lines.append(f"![{caption}](images/study/{world}-{figure_name}.png)\n\n*{caption}*\n")
    lines.append("")
    return lines


# Tables of one world


def claims_table(results: StudyResults, world: str) -> list[str]:
    """Table of the claims with their effects and verdicts."""
    rows = []
    for claim in study_claims(results, world):
        digits = 1 if "points" in claim.unit else 2
        effect = f"{claim.effect:+.{digits}f}"
        rows.append((claim.text, effect, f"{claim.min_effect:g} {claim.unit}", claim.verdict))
    return table_lines(("claim", "effect", "least", "verdict"), rows)


def instrument_table(report: InstrumentReport) -> list[str]:
    """Table of the measures at each shift, and the verdicts."""
    header = ("shift", *(f"{column.shift:g}" for column in report.shifts))
    return [*table_lines(header, measure_rows(report)), "", "```", *instrument_verdicts(report), "```"]


def table_1_rows(condition: Condition, decoding: Decoding = "argmax") -> list[tuple[str, TrialRow]]:
    """Names and rows of Table 1 at one shift."""
    rows = [
        ("baseline", condition.row(Trial("baseline", decoding))),
        ("+ w", condition.row(Trial("layout", decoding))),
        ("+ w + TDE", condition.row(Trial("tde", decoding))),
    ]

    # sTDE with every gap and, with best actions, its random intervention.
    for stde_label, options in STDE_OPTIONS.items():
        for gap, gap_label in GAP_LABELS.items():
            row = condition.row(Trial("stde", decoding, *options), gap)
            rows.append((f"+ w + {stde_label}{gap_label}", row))
        if decoding == "argmax":
            row = condition.row(Trial("stde", decoding, *options, "random"))
            rows.append((f"+ w + {stde_label}, random intervention", row))

    # On `test`, the epsilon that was chosen on `val`.
    if condition.chosen is not None and decoding == "argmax":
        row = condition.row(Trial("stde", decoding, condition.chosen, "residual"))
        rows.append((f"+ w + sTDE (eps {condition.chosen:g}, chosen)", row))
    return rows


def metrics_table(conditions: Sequence[Condition], decoding: Decoding) -> list[str]:
    """Table 1 at all shifts."""
    rows = []
    for condition in conditions:
        rows.append((f"**shift {condition.shift:g}**", "", "", "", "", ""))
        for name, row in table_1_rows(condition, decoding):
            metrics = (_mean_and_std(row.sr), _mean_and_std(row.spl), _mean_and_std(row.dts, 2))
            difference = f"{row.difference.sr:+.1f}" if row.difference else ""
            rows.append((name, *metrics, difference, f"{row.mean_weight:.3f}"))
    return table_lines(("", "SR", "SPL", "DTS", "to + w", "weight"), rows)


def controls_table(conditions: Sequence[Condition]) -> list[str]:
    """Table of the effects of sTDE and of its controls at all shifts."""
    rows = []
    for stde_label, options in STDE_OPTIONS.items():
        for gap in GAP_LABELS:
            for control, control_label in CONTROL_LABELS.items():
                if control == "zeros" and options.form == "paper":
                    continue  # a - s 0 = a
                trial = _control_trial(options, control)
                name = f"{stde_label}, gap `{gap}`{control_label}"
                rows.append((name, *_effect_cells(conditions, trial, gap)))

        clock_cells = _effect_cells(conditions, Trial("stde", "argmax", *options), "clock")
        rows.append((f"{stde_label}, the released code's novelty clock", *clock_cells))

    header = ("SR to + w (mean weight)", *(f"shift {condition.shift:g}" for condition in conditions))
    return table_lines(header, rows)


def _control_trial(options: StdeOptions, control: TrialControl | None) -> Trial:
    """Trial of a control; zeros leave the best action as it is, and are therefore evaluated with sampled actions."""
    decoding: Decoding = "sample" if control == "zeros" else "argmax"
    return Trial("stde", decoding, *options, control)


def _effect_cells(conditions: Sequence[Condition], trial: Trial, gap: GapName) -> list[str]:
    """Effect on SR and mean weight of a trial, one cell per shift."""
    cells = []
    for condition in conditions:
        mean_weight = condition.row(trial, gap).mean_weight
        cells.append(f"{condition.sr_difference(trial, gap):+.1f} ({mean_weight:.2f})")
    return cells


def runs_table(results: StudyResults) -> list[str]:
    """Table of the effects in all runs on generated rooms, and their number of parameters."""
    trials = {"baseline": Trial("baseline"), "+ w": Trial("layout"), "TDE": Trial("tde")}
    for stde_label, options in STDE_OPTIONS.items():
        trials[stde_label] = Trial("stde", "argmax", *options)

    rows = []
    parameters = {}
    for run, conditions in results.runs.items():
        if run == "real":
            continue
        parameters[run] = conditions[0].parameters
        for title, trial in trials.items():
            if title == "baseline" and not conditions[0].has_row(trial):
                continue  # the run trains the layout arm alone
            cells = [_sr_with_difference(condition.row(trial)) for condition in conditions]
            rows.append((f"`{run}` {title}", *cells))

    sizes = set(parameters.values())
    size_note = f"All policies have {sizes.pop():,} parameters." if len(sizes) == 1 else f"Parameters: {parameters}."
    header = ("SR (to + w; + w: to the baseline)", *(f"shift {shift:g}" for shift in results.shifts))
    return [*table_lines(header, rows), "", size_note]


def gap_auc_tables(gap_curves: GapCurves) -> list[str]:
    """Tables of the gap's AUC at some steps, one per shift but the first."""
    steps = [step for step in AUC_STEPS if step < len(gap_curves.steps)]
    lines = []
    for panel in gap_curves.auc:
        rows = []
        for line in panel.lines:
            cells = [f"{line.curve.interval_at(step):.2f}" for step in steps]
            rows.append((f"`{line.setting}`", *cells))
        lines += [f"AUC of the gap, shift {panel.shift:g} against none, by step:", ""]
        lines += [*table_lines(("setting", *map(str, steps)), rows), ""]

    running_shares = ", ".join(f"{100 * gap_curves.running[0, step]:.0f}" for step in steps)
    lines.append(f"Episodes that still run at these steps, shift 0: {running_shares} %.")
    return lines


def _mean_and_std(metric: Interval, digits: int = 1) -> str:
    """Mean and, with several seeds, their standard deviation."""
    mean = f"{metric.mean:.{digits}f}"
    return mean if math.isnan(metric.std) else f"{mean} ± {metric.std:.{digits}f}"


def _sr_with_difference(row: TrialRow) -> str:
    sr_cell = _mean_and_std(row.sr)
    return f"{sr_cell} ({row.difference.sr:+.1f})" if row.difference else sr_cell


# Removal in a mixed population


def mixture_sections(mixtures: Sequence[MixtureReport]) -> list[str]:
    """Lines of the sections on the value of experience and on its removal.

    Args:
      mixtures: of one world, with the same agents without experience.
    """
    lines = [
        "### What experience is worth",
        "",
        "Half of the episodes are in scenes as trained, half in shifted ones; nobody is told which. Value (or cost) is "
        "the lead over agents that cannot know any layout, in percentage points.",
        "",
        *experience_value_table(mixtures),
        "",
    ]
    for mixture in mixtures:
        actions = "best" if mixture.decoding == "argmax" else "sampled"
        heir = "" if mixture.heir is None else f", which hands over to `{mixture.heir}`"
        lines += [f"### Removal from `{mixture.run}`{heir}, {actions} actions", ""]
        lines += ["Change against the same policies without removal:", "", *removal_table(mixture), ""]
        lines += ["What the gap knows, over the mixture:", "", *gap_controls_table(mixture), ""]
        lines += ["The order of time:", "", *timing_table(mixture), ""]

    first_mixture = mixtures[0]
    lengths = ", ".join(f"{length:.0f}" for length in first_mixture.length)
    return [*lines, f"Half of the episodes of `{first_mixture.run}` last longer than {lengths} steps.", ""]


def experience_value_table(mixtures: Sequence[MixtureReport]) -> list[str]:
    """Table of the value or cost of experience in each run.

    Args:
      mixtures: of one world, with the same agents without experience.
    """
    first_mixture = mixtures[0]
    columns = _shift_columns(first_mixture, tuple(first_mixture.agent))
    header = ("", *(_column_title(first_mixture, column) for column in columns))

    rows = []
    for mixture in mixtures:
        actions = "best actions" if mixture.decoding == "argmax" else "sampled"
        for name, values, number_format in (
            (f"without experience, {actions}", mixture.without, ".1f"),
            (f"`{mixture.run}`, {actions}", mixture.agent, ".1f"),
            ("its value (or cost)", mixture.lead, "+.1f"),
        ):
            cells = [f"{values[metric][shift_index]:{number_format}}" for shift_index, metric in columns]
            rows.append((name, *cells))

    # Mixtures with the same decoding share the agents without experience, whose row is printed once.
    return table_lines(header, dict.fromkeys(rows))


def removal_table(mixture: MixtureReport) -> list[str]:
    """Table of the effect of every removal, at each shift and over the mixture."""
    metrics = (tuple(mixture.agent)[-1], "sr", "spl")
    share_metrics = metrics[:2]
    columns = _shift_columns(mixture, metrics)
    header = (
        "",
        "weight",
        *(_column_title(mixture, column) for column in columns),
        *(f"{_metric_title(metric)}, mixture" for metric in metrics),
        *(f"value kept, {_metric_title(metric)} (%)" for metric in share_metrics),
        *(f"cost recovered, {_metric_title(metric)} (%)" for metric in share_metrics),
    )

    # Experience has a value at the first shift and a cost at the last.
    rows = []
    for removal in mixture.removals:
        cells = [removal.name, _format_weights(removal.weight)]
        cells += [f"{removal.change[metric][shift_index]:+.1f}" for shift_index, metric in columns]
        cells += [f"{removal.mixture[metric]:+.1f}" for metric in metrics]
        cells += [f"{removal.left[metric][0]:.0f}" for metric in share_metrics]
        cells += [f"{100.0 - removal.left[metric][-1]:.0f}" for metric in share_metrics]
        rows.append(cells)
    return table_lines(header, rows)


def gap_controls_table(mixture: MixtureReport) -> list[str]:
    """Table of the gains of each gap over its controls, over the mixture."""
    metrics = (tuple(mixture.agent)[-1], "spl", "sr")
    rows = []
    for removal in mixture.removals:
        for control, comparison in (removal.compared or {}).items():
            control_label = GAP_CONTROL_LABELS.get(control, f"`{control}`, the best clock")
            rows.append(
                (
                    f"{removal.name} ({_format_weights(removal.weight)})",
                    f"{control_label} ({_format_weights(comparison.weight)})",
                    *(f"{comparison.gained[metric]:+.1f}" for metric in metrics),
                )
            )
    return table_lines(("gap (weights)", "less that of (weights)", *map(_metric_title, metrics)), rows)


def timing_table(mixture: MixtureReport) -> list[str]:
    """Table of the effects of early and of late removal."""
    columns = _shift_columns(mixture, tuple(mixture.agent))
    rows = []
    for removal in mixture.removals:
        if removal.name.startswith(("until", "after", "novelty", "overdue")):
            cells = [f"{removal.change[metric][shift_index]:+.1f}" for shift_index, metric in columns]
            rows.append((removal.name, *cells))
    return table_lines(("", *(_column_title(mixture, column) for column in columns)), rows)


def _shift_columns(mixture: MixtureReport, metrics: Sequence[str]) -> list[tuple[int, str]]:
    """Index of the shift and metric of each column, shift by shift."""
    return [(shift_index, metric) for shift_index in range(len(mixture.shifts)) for metric in metrics]


def _column_title(mixture: MixtureReport, column: tuple[int, str]) -> str:
    shift_index, metric = column
    return f"{_metric_title(metric)}, shift {mixture.shifts[shift_index]:g}"


def _metric_title(metric: str) -> str:
    name, _, budget = metric.partition("@")
    return f"{name.upper()} within {budget}" if budget else name.upper()


def _format_weights(weights: Sequence[float]) -> str:
    return ", ".join(f"{weight:.2f}" for weight in weights)
