"""The instrument's table and verdicts name every measure and shift."""

import dataclasses

from support import study_results

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.records import MEASURES, MeasureChange, instrument_console_table, instrument_verdicts


def test_the_table_has_a_column_for_each_shift():
    table = instrument_console_table(study_results.instrument())
    assert [column.header for column in table.columns] == ["Layout shift", "0", "1"]
    cells = [str(cell) for cell in table.columns[2].cells]
    assert cells[:3] == ["80", "1000", "11.00 [10.50, 11.50]"]
    assert len(cells) == 2 + len(MEASURES)


def test_the_verdicts_name_every_change():
    changes = (
        MeasureChange("random_sr", 0.0, 0.5, Interval(100.0, 100.0, 100.0), holds=False),
        MeasureChange("random_sr", 0.0, 1.0, Interval(0.0, 0.0, 0.0), holds=True),
    )
    blind = (MeasureChange("without_argmax_sr", 0.0, 1.0, Interval(1.0, 0.5, 1.5), holds=True),)
    categories = (MeasureChange("goal_detected", 0.0, 1.0, Interval(6.0, 5.5, 6.5), holds=False),)
    report = dataclasses.replace(study_results.instrument(), matched=changes)
    lines = instrument_verdicts(report)
    assert instrument_verdicts(dataclasses.replace(report, categories=categories, without=blind)) == [
        *lines[:3],
        "Categories matched (change at most 5 points in the mean over categories)?",
        "  NO   Goal detected where it is in view (%), shift 1: 6.0 [5.5, 6.5] points",
        *lines[3:],
        "No loss without experience (fewer than 2 points)?",
        "  yes  SR without experience, argmax (%), shift 0 to 1: 1.0 [0.5, 1.5] points lost",
    ]
    assert lines == [
        "Difficulty matched (within 5 % of shift 0)?",
        "  NO   Random SR (%), shift 0.5: +100.0 [+100.0, +100.0] %",
        "  yes  Random SR (%), shift 1: +0.0 [+0.0, +0.0] %",
        "Discriminating (at least 8 points lost, the interval clear of 0)?",
        "  yes  Baseline SR, argmax (%), shift 0 to 1: 9.0 [8.0, 10.0] points lost",
        "  yes  Baseline SR, sampled (%), shift 0 to 1: 12.0 [11.0, 13.0] points lost",
    ]
