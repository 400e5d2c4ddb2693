"""The report of a run: measures the run, turns the measurements into sections, and renders the page.

`make_report` is the entry point. Below it stand the sections of the page, one function each.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.report import (
    accounting_table,
    decision_share_table,
    difference_table,
    has_decision_shares,
    results_table,
    row_label,
)
from jaxnav.experiments.figures import gap_figure, similarity_figure
from jaxnav.experiments.gap_traces import BELIEFS, mean_by_step, truncate_to_shortest
from jaxnav.experiments.table import Curve
from jaxnav.plain_console import PlainConsole, to_plain_console
from jaxnav.policies.methods import method_label
from jaxnav.progress import show_activity
from jaxnav.report.charts import (
    differences_chart,
    leads_chart,
    learning_chart,
    make_chart,
    shares_chart,
    thresholds_chart,
)
from jaxnav.report.config import ReportConfig
from jaxnav.report.headline import make_headline
from jaxnav.report.measure import ShiftMeasurements, measure_shift
from jaxnav.report.page import Section, render_report_page, to_text_table
from jaxnav.report.replays import TrainedLayout
from jaxnav.runs.run import Run

#: Report of an evaluation, as in JSON.
_Report = dict[str, Any]

_RESULTS_TEXT = (
    "SR is the success rate, SPL weights success by the shortest path, and DTS is the distance to success at the end. "
    "Brackets hold 95 % intervals over training runs and scenes. At layout shift 1 all categories of a scene have "
    "exchanged places. Words with a dotted line open their definition."
)
_ACCOUNT_TEXT = (
    "The lead of the run over layout-blind agents, on the same episodes. At shift 0 the lead is the value of "
    "experience; at shift 1 a negative lead is the cost of experience. A removal of experience leaves a share of the "
    "lead (“left”): the kept share of the value, or 100 % minus the recovered share of the cost."
)
_SHARES_TEXT = (
    "The share of decisions whose best action changes if one part of the decision is replaced by that of another "
    "episode. Experience reaches a decision through Z, which combines the detections of all categories with the layout "
    "weights. If few decisions depend on other categories in Z, neither w nor sTDE can change much. Bars are 95 % "
    "intervals."
)
_LEARNING_TEXT = (
    "Success during training, in training scenes and in val scenes, and success of the exported policies. Bands reach "
    "from the worst to the best training run in val scenes, with best actions."
)
_THRESHOLDS_TEXT = (
    "sTDE removes experience where the layout gap exceeds the threshold ε. For ε ≥ 1 no experience is removed. Best "
    "actions; bands are 95 % intervals."
)
_GAP_TEXT = (
    "The mean layout gap D after each action, over the episodes that still run. For one curve detections update the "
    "belief, for the other curve the belief stays at the prior. Sampled actions; no experience is removed."
)
_SIMILARITY_TEXT = (
    "Success of {row} against the layout similarity of scene and goal: the cosine similarity between the expected "
    "co-occurrences of the goal in the scene and in the prior from training."
)


def make_report(run: Run, reference_run: Run | None, config: ReportConfig, console: Console) -> str:
    """Measure a run and return its page as HTML.

    Args:
      run: a finished run.
      reference_run: a finished run of layout-blind agents in the same world; None for none.
      config: options of the measurements.
      console: receives messages about the progress.

    Raises:
      InputError: no finished run, an impossible option, or runs that cannot be compared.
    """
    console = to_plain_console(console)
    _check(run, reference_run, config)
    by_shift = measure_shifts(run, reference_run, config, console)

    # The header states facts that are equal at all shifts, so that the first report serves.
    report = next(iter(by_shift.values())).results.report
    first_row = report["rows"][0]
    run_facts = {
        "Run": run.config.run_dir.name,
        "Method": run.config.method,
        "Decision": run.config.decision,
        "World": f"{first_row['world']}, {config.split}",
        "Training runs": f"{run.config.seeds} of each arm",
        "Steps": f"{report['run']['steps_per_policy']:,} a policy",
        "Episodes": f"{first_row['episodes']:,} at each shift",
        "Made with": f"jaxnav {report['versions']['jaxnav']}, jax {report['versions']['jax']}",
    }

    # The sections compare the shifts; the replays, one player for each shift, follow the first section.
    page_title = f"{method_label(run.config.method)} in {first_row['world']}"
    replays_by_shift = [measurements.replays for measurements in by_shift.values()]
    with show_activity(console, "drawing the page"):
        reports = {}
        accounts = {}
        for shift, measurements in by_shift.items():
            reports[shift] = measurements.results.report
            accounts[shift] = measurements.account
        headline = make_headline(reports, accounts, config.threshold)
        sections = make_sections(run, by_shift, config.threshold)
        return render_report_page(page_title, headline, run_facts, sections, replays_by_shift)


def measure_shifts(
    run: Run, reference_run: Run | None, config: ReportConfig, console: PlainConsole
) -> dict[float, ShiftMeasurements]:
    """Measure at each shift once, and return the measurements in the order of the options."""
    # The layout of training comes first, so that replays of other layouts can show it, too.
    shifts = list(dict.fromkeys(config.shift))
    trained_shift = run.config.worlds.shift
    trained_layout = None
    measured: dict[float, ShiftMeasurements] = {}
    if trained_shift in shifts:
        measured[trained_shift] = measure_shift(run, reference_run, trained_shift, config, console)
        world = measured[trained_shift].compiled_world
        # Streamed scenes are divided otherwise at other shifts.
        if len(world.banks) == 1:
            trained_layout = TrainedLayout(trained_shift, world)

    for shift in shifts:
        if shift not in measured:
            measured[shift] = measure_shift(run, reference_run, shift, config, console, trained_layout)
    return {shift: measured[shift] for shift in shifts}


def _check(run: Run, reference_run: Run | None, config: ReportConfig) -> None:
    """Refuse within a second options and runs that would fail after minutes."""
    if not config.shift:
        raise InputError("--shift: give at least one number")
    if config.replays < len(config.shift):
        raise InputError(f"--replays {config.replays}: give at least {len(config.shift)}, one for each shift")

    # Loading the policies fails for unfinished runs.
    run.policies()
    if reference_run is not None:
        reference_run.policies()
        if reference_run.config.task != run.config.task:
            raise InputError("--reference: has another task or detector than the run; train both with equal settings")


def make_sections(run: Run, by_shift: Mapping[float, ShiftMeasurements], threshold: float) -> list[Section]:
    """Return the sections of the page for which there are measurements.

    Args:
      run: the run.
      by_shift: measurements by layout shift.
      threshold: threshold of sTDE in the tables.
    """
    # Sections without measurements are None.
    reports = {shift: measurements.results.report for shift, measurements in by_shift.items()}
    optional_sections = [
        _results_section(reports, threshold),
        _account_section(by_shift, threshold),
        _shares_section(reports),
        _learning_section(run),
        _thresholds_section(reports),
        _gap_section(run, by_shift),
        _similarity_section(by_shift),
    ]
    return [section for section in optional_sections if section is not None]


def _results_section(reports: Mapping[float, _Report], threshold: float) -> Section:
    # The tables show one threshold; those with every threshold are folded.
    short_reports: dict[float, _Report] = {}
    text_tables = []
    folded_tables = []
    shifts_by_note: dict[str, list[str]] = {}
    for shift, report in reports.items():
        short_report = _at_threshold(report, threshold)
        short_reports[shift] = short_report
        shift_title = f"Shift {shift:g}"
        text_tables.append(to_text_table(shift_title, results_table(short_report)))
        if short_report["differences"]:
            folded_tables.append(to_text_table(f"{shift_title}, paired differences", difference_table(short_report)))
        if len(short_report["rows"]) < len(report["rows"]):
            folded_tables.append(to_text_table(f"{shift_title}, every threshold", results_table(report)))
        for note in report["notes"]:
            shifts_by_note.setdefault(note, []).append(shift_title)

    # The chart compares shifts, so that all of them need paired differences.
    section_charts = ()
    if all(report["differences"] for report in reports.values()):
        section_charts = (differences_chart(short_reports),)

    # Evaluations of one run repeat most of their notes; the title of a note names the shifts if it is not that of all.
    notes = []
    for note, shift_titles in shifts_by_note.items():
        is_common = len(shift_titles) == len(reports)
        notes.append(note if is_common else f"{', '.join(shift_titles)}: {note}")
    return Section("Results", _RESULTS_TEXT, section_charts, tuple(text_tables), tuple(folded_tables), tuple(notes))


def _at_threshold(report: _Report, threshold: float) -> _Report:
    """Return a report with one threshold of sTDE alone."""
    # Entries without a threshold belong to variants other than sTDE, and stay.
    selected_entries: _Report = {"rows": [], "differences": []}
    for name, entries in selected_entries.items():
        for report_entry in report[name]:
            if report_entry["epsilon"] in (None, threshold):
                entries.append(report_entry)
    return report | selected_entries


def _account_section(by_shift: Mapping[float, ShiftMeasurements], threshold: float) -> Section | None:
    # The section needs a run of layout-blind agents, which was measured at all shifts or at none.
    accounts = {}
    text_tables = []
    for shift, measurements in by_shift.items():
        if measurements.account is None:
            return None
        # Keep the leads of rows that the tables show.
        short_report = _at_threshold(measurements.results.report, threshold)
        row_labels = set(map(row_label, short_report["rows"]))
        leads = [lead for lead in measurements.account if lead.variant in row_labels]
        accounts[shift] = leads
        text_tables.append(to_text_table(f"Shift {shift:g}", accounting_table(leads)))
    return Section("Value and cost of experience", _ACCOUNT_TEXT, (leads_chart(accounts),), tuple(text_tables))


def _shares_section(reports: Mapping[float, _Report]) -> Section | None:
    # Agents without learned decisions have no shares, at any shift.
    if not all(has_decision_shares(report) for report in reports.values()):
        return None
    tables = []
    for shift, report in reports.items():
        tables.append(to_text_table(f"Shift {shift:g}, all decision shares", decision_share_table(report)))
    return Section("Decision shares", _SHARES_TEXT, (shares_chart(reports),), folded=tuple(tables))


def _learning_section(run: Run) -> Section | None:
    log_rows = run.log()
    if not log_rows:
        return None
    chart = learning_chart(log_rows, run.success_by_budget(), method_label(run.config.method))
    return Section("Learning", _LEARNING_TEXT, (chart,))


def _thresholds_section(reports: Mapping[float, _Report]) -> Section | None:
    # Agents without layout weights have no threshold, at any shift.
    first_report = next(iter(reports.values()))
    if not any(table_row["variant"] == "stde" for table_row in first_report["rows"]):
        return None
    return Section("Thresholds", _THRESHOLDS_TEXT, (thresholds_chart(reports),))


def _gap_section(run: Run, by_shift: Mapping[float, ShiftMeasurements]) -> Section | None:
    # Streamed scenes and agents without the layout have no gap, at any shift.
    traces_by_shift = {}
    for shift, measurements in by_shift.items():
        if measurements.gaps is not None:
            traces_by_shift[shift] = measurements.gaps
    if not traces_by_shift:
        return None
    traces = truncate_to_shortest(list(traces_by_shift.values()))

    # A curve for each shift and each way of updating the belief.
    curve_by_line = {}
    for shift, gap_traces in zip(traces_by_shift, traces, strict=True):
        gap_bounds = mean_by_step(gap_traces)[:, 0]  # mean and bounds of the run's own estimator
        steps = np.arange(gap_bounds.shape[-1], dtype=np.float64)
        for belief, belief_index in BELIEFS.items():
            curve_by_line[shift, belief] = Curve(steps, *gap_bounds[:, belief_index])
    figure = gap_figure({run.config.layout.setting: curve_by_line})
    return Section("Layout gap", _GAP_TEXT, (make_chart(figure, "Mean layout gap by step."),))


def _similarity_section(by_shift: Mapping[float, ShiftMeasurements]) -> Section | None:
    # Streamed scenes have no similarity.
    similarity_by_shift = {}
    for shift, measurements in by_shift.items():
        if measurements.similarity is not None:
            similarity_by_shift[shift] = measurements.similarity
    if not similarity_by_shift:
        return None

    # The text names the row that the chart shows.
    first_report = next(iter(by_shift.values())).results.report
    section_text = _SIMILARITY_TEXT.format(row=row_label(first_report["rows"][0]))
    chart = make_chart(similarity_figure(similarity_by_shift), "Success against layout similarity.")
    return Section("Success and layout similarity", section_text, (chart,))
