"""The sections of a page, from what was measured."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxnav.evaluation.accounting import accounting_table
from jaxnav.evaluation.report_tables import console_table, difference_table, label
from jaxnav.report.charts import (
    differences_chart,
    gap_chart,
    leads_chart,
    learning_chart,
    similarity_chart,
    thresholds_chart,
)
from jaxnav.report.content import Section, Table, as_texts
from jaxnav.report.gather import Measured
from jaxnav.runs.directory import Run
from jaxnav.study.curves import GapCourse, GapLine, GapPanel
from jaxnav.study.gap_course import BELIEFS, shortest
from jaxnav.study.gap_statistics import mean_by_step

RESULTS = (
    "SR is the share of episodes that end with Done where it succeeds, SPL weighs success by the shortest path, DTS is "
    "the distance to the goal at the end. Brackets are 95 % intervals over training runs and scenes. At "
    "shift 1 all categories have exchanged their places."
)
ACCOUNT = (
    "The lead over agents that cannot know any layout, on the same episodes. Where the layout holds it is the value of "
    "experience; where it is shifted, a negative lead is its cost. “Left” is the share of a lead that a removal "
    "leaves."
)
LEARNING = "Success while training, in training scenes and in val scenes, and of the exported policies."
THRESHOLDS = (
    "sTDE removes experience where the layout gap exceeds the threshold ε. From ε = 1 on nothing is removed. Best "
    "actions; bands are 95 % intervals."
)
GAP = (
    "The gap D after each action, over the episodes that still run, with the belief updated by what is seen, "
    "and frozen at the prior. Sampled actions; nothing is removed."
)
SIMILARITY = (
    "Success of {row} against the similarity of the goal's surroundings to those in training: the cosine of its "
    "expected co-occurrence in the scene and in the prior."
)


def make_sections(run: Run, by_shift: Mapping[float, Measured], threshold: float) -> list[Section]:
    """Return the sections of a page that there are numbers for.

    Args:
      run: the run.
      by_shift: what was measured.
      threshold: of sTDE in the tables.
    """
    reports = {shift: each.results.report for shift, each in by_shift.items()}
    removes = any(row["variant"] == "stde" for row in next(iter(reports.values()))["rows"])
    made = [_results(reports, threshold), _account(by_shift, threshold)]
    made.append(Section("Learning", LEARNING, (learning_chart(run),)) if run.log() else None)
    made.append(Section("Thresholds", THRESHOLDS, (thresholds_chart(reports),)) if removes else None)
    made += [_gap(run, by_shift), _similarity(by_shift)]
    return [section for section in made if section is not None]


def _results(reports: Mapping[float, dict[str, Any]], threshold: float) -> Section:
    tables, folded, notes = [], [], []
    for shift, report in reports.items():
        short = _at(report, threshold)
        tables.append(as_texts(f"Shift {shift:g}", console_table(short)))
        if short["differences"]:
            folded.append(as_texts(f"Shift {shift:g}, paired differences", difference_table(short)))
        if len(short["rows"]) < len(report["rows"]):
            folded.append(as_texts(f"Shift {shift:g}, every threshold", console_table(report)))
        notes += report["notes"]
    charts = (differences_chart({s: _at(r, threshold) for s, r in reports.items()}),) if _compared(reports) else ()
    return Section("Results", RESULTS, charts, tuple(tables), tuple(folded), tuple(dict.fromkeys(notes)))


def _compared(reports: Mapping[float, dict[str, Any]]) -> bool:
    return all(report["differences"] for report in reports.values())


def _at(report: dict[str, Any], threshold: float) -> dict[str, Any]:
    """Return a report with one threshold of sTDE alone."""
    return report | {
        name: [entry for entry in report[name] if entry["epsilon"] in (None, threshold)]
        for name in ("rows", "differences")
    }


def _account(by_shift: Mapping[float, Measured], threshold: float) -> Section | None:
    accounts = {}
    for shift, each in by_shift.items():
        if each.account is None:
            return None
        names = {label(row) for row in _at(each.results.report, threshold)["rows"]}
        accounts[shift] = [entry for entry in each.account if entry.variant in names]
    tables: tuple[Table, ...] = tuple(as_texts(f"Shift {s:g}", accounting_table(e)) for s, e in accounts.items())
    return Section("What experience is worth", ACCOUNT, (leads_chart(accounts),), tables)


def _gap(run: Run, by_shift: Mapping[float, Measured]) -> Section | None:
    traces = [each.gaps for each in by_shift.values() if each.gaps is not None]
    if not traces:
        return None
    traces = shortest(traces)
    lines = [
        GapLine(shift, belief, mean.line(0, which))
        for shift, mean in zip(by_shift, map(mean_by_step, traces), strict=True)
        for belief, which in BELIEFS.items()
    ]
    running = np.stack([trace.running.mean(axis=(0, 1)) for trace in traces])
    panel = GapPanel(run.config.layout.setting, tuple(lines))
    return Section("The gap", GAP, (gap_chart(GapCourse(tuple(range(running.shape[1])), running, (panel,), ())),))


def _similarity(by_shift: Mapping[float, Measured]) -> Section | None:
    points = {shift: each.similarity for shift, each in by_shift.items() if each.similarity is not None}
    if not points:
        return None
    row = label(next(iter(by_shift.values())).results.report["rows"][0])
    return Section("Success and similarity", SIMILARITY.format(row=row), (similarity_chart(points),))
