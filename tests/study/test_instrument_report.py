"""The instrument's table and verdicts name every measure and shift."""

import dataclasses

from support import study_results

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.instrument_report import Change, console_table, verdicts


def test_the_table_has_a_column_for_each_shift():
    table = console_table(study_results.instrument())
    assert [column.header for column in table.columns] == ["Layout shift", "0", "1"]
    cells = [str(cell) for cell in table.columns[2].cells]
    assert cells[:3] == ["80", "1000", "11.00 [10.50, 11.50]"]
    assert len(cells) == 2 + 8


def test_the_verdicts_name_every_change():
    changes = (
        Change("random_sr", 0.0, 0.5, Interval(100.0, 100.0, 100.0), holds=False),
        Change("random_sr", 0.0, 1.0, Interval(0.0, 0.0, 0.0), holds=True),
    )
    lines = verdicts(dataclasses.replace(study_results.instrument(), matched=changes))
    assert lines == [
        "Difficulty matched (within 5 % of shift 0)?",
        "  NO   Random SR (%), shift 0.5: +100.0 [+100.0, +100.0] %",
        "  yes  Random SR (%), shift 1: +0.0 [+0.0, +0.0] %",
        "Discriminating (at least 8 points lost, the interval clear of 0)?",
        "  yes  Baseline SR, argmax (%), shift 0 to 1: 9.0 [8.0, 10.0] points lost",
        "  yes  Baseline SR, sampled (%), shift 0 to 1: 12.0 [11.0, 13.0] points lost",
    ]
