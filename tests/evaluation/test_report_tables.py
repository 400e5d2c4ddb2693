"""The tables of the evaluation report, for a terminal and in Markdown."""

import io
from typing import get_args

import pytest
from rich.console import Console

from jaxnav.choices import Form
from jaxnav.evaluation import report as report_tables

IDENTITY = {"variant": "baseline", "method": "ORG", "world": "ithor", "split": "test"}
INFERENCE = {"epsilon": None, "decoding": "argmax", "form": None}


def fixed_row(**changes):
    """A report row with fixed metrics, and changes."""
    metrics = {
        "sr": {"mean": 66.48, "std": 0.22, "ci95": [63.5, 69.44]},
        "spl": {"mean": 38.42, "std": 0.39, "ci95": [36.0, 40.0]},
        "dts": {"mean": 0.541, "std": 0.01, "ci95": [0.5, 0.6]},
        "timeout": {"mean": 30.04, "std": 1.0, "ci95": [28.0, 32.0]},
        "wrong_done": {"mean": 3.48, "std": 1.0, "ci95": [2.0, 5.0]},
        "sr@20": {"mean": 21.04, "std": 1.0, "ci95": [20.0, 22.0]},
        "sr@100": {"mean": 55.5, "std": 1.0, "ci95": [50.0, 60.0]},
    }
    return IDENTITY | INFERENCE | metrics | changes


def fixed_report(*rows, notes=()):
    return {"rows": list(rows), "notes": list(notes)}


CELLS = ["66.5 [63.5, 69.4]", "38.4 [36.0, 40.0]", "0.54 [0.50, 0.60]", "21.0, 55.5", "30.0", "3.5"]


def markdown_cells(report):
    """The cells of each line of a report's Markdown table, after the heading and the rule."""
    table_lines = [line for line in report_tables.markdown_table(report).splitlines() if line.startswith("|")]
    rows = []
    for line in table_lines[2:]:
        rows.append([cell.strip() for cell in line.split("|")[1:-1]])
    return rows


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (fixed_row(variant="random", method="random"), ["Random"]),
        (fixed_row(), ["ORG", "baseline"]),
        (fixed_row(variant="layout"), ["+ w"]),
        (fixed_row(variant="tde", form="residual"), ["TDE"]),
        (fixed_row(variant="stde", form="residual", epsilon=0.5), ["sTDE", "0.5"]),
        (fixed_row(variant="stde", form="paper", epsilon=0.25), ["sTDE", "0.25", "paper"]),
    ],
)
def test_markdown_row_names_its_variant_and_rounds_its_metrics(row, words):
    _, (label, *cells) = markdown_cells(fixed_report(row))
    assert all(word in label for word in words)
    assert cells == CELLS


def test_markdown_table_is_followed_by_its_notes():
    table = report_tables.markdown_table(fixed_report(fixed_row(), notes=["One note.", "Another."]))
    paragraphs = table.strip().split("\n\n")
    assert paragraphs[1:] == ["One note.", "Another."]


def test_markdown_rows_are_grouped_by_decoding():
    report = fixed_report(fixed_row(), fixed_row(decoding="sample"), fixed_row(variant="layout"))
    labels = [label for label, *_ in markdown_cells(report)]
    assert ["argmax" in label for label in labels] == [True, False, False, False, False]
    assert ["sample" in label for label in labels] == [False, False, False, True, False]


def test_cell_without_an_interval_has_a_dash():
    metric = {"mean": 66.48, "std": None, "ci95": None}
    _, (_, *cells) = markdown_cells(fixed_report(fixed_row(sr=metric)))
    assert cells == ["66.5 [-]", *CELLS[1:]]


def test_console_table_shows_names_as_text():
    report = fixed_report(fixed_row(method="[bold]X[/bold]"))
    console = Console(width=160, record=True, file=io.StringIO(), markup=False)
    console.print(report_tables.results_table(report))
    printed = console.export_text()
    assert "[bold]X[/bold]" in printed  # names are text, never markup
    assert all(cell in printed for cell in CELLS)


def test_difference_table_has_a_line_per_comparison():
    entry = {"from": "layout", "to": "stde", "epsilon": 0.5, "form": "residual", "decoding": "argmax"}
    differences = []
    for name, mean, ci95 in [("sr", 25.0, [10.0, 40.0]), ("spl", -1.25, [-2.0, 0.5]), ("dts", -0.031, [-0.1, 0.0])]:
        differences.append({**entry, "metric": name, "mean": mean, "ci95": ci95})
    report = {"differences": differences}

    # The three metrics share a line. Reports of earlier versions lack the probability of improvement.
    table = report_tables.difference_table(report)
    label, *cells = (str(next(iter(column.cells))) for column in table.columns)
    assert table.row_count == 1
    assert "sTDE" in label
    assert cells == ["argmax", "+25.0 [+10.0, +40.0]", "-1.2 [-2.0, +0.5]", "-0.03 [-0.10, +0.00]", ""]

    # The last column shows the probability of improvement in SR.
    report["differences"][0]["probability_of_improvement"] = {"mean": 0.625, "ci95": [0.5, 0.75]}
    *_, column = report_tables.difference_table(report).columns
    assert list(column.cells) == ["0.62 [0.50, 0.75]"]


@pytest.mark.parametrize("variant", ["stde", "scde"])
def test_rows_of_different_forms_have_different_labels(variant):
    rows = [{"variant": variant, "epsilon": 0.5, "form": form} for form in get_args(Form)]
    assert len({report_tables.row_label(row) for row in rows}) == len(rows) == 4


def make_share(part, share, partner_difference, cost):
    """A decision share of the baseline, with means without intervals; None for a value that was not measured."""

    def interval_json(mean):
        return None if mean is None else {"mean": mean, "ci95": None}

    cost_entry = None
    if cost is not None:
        cost_entry = {"episodes": 10, "spl": interval_json(cost), "sr": interval_json(2 * cost)}
    return {
        "variant": "baseline",
        "decoding": "argmax",
        "part": part,
        "share": interval_json(share),
        "partner_difference": interval_json(partner_difference),
        "cost": cost_entry,
    }


def test_decision_shares_stand_below_the_table():
    decision_shares = [
        make_share("other_categories", 3.14, 2.0, 1.5),
        make_share("uniform_weights", 0.5, None, None),
    ]
    report = fixed_report(fixed_row()) | {"decision_shares": decision_shares}
    lines = report_tables.markdown_table(report).splitlines()
    assert "| ORG (baseline) | other categories in Z | argmax | 3.1 [-] | 2.0 | +1.5 [-] | +3.0 [-] |" in lines
    assert "| ORG (baseline) | w (uniform instead) | argmax | 0.5 [-] |  |  |  |" in lines
    assert report_tables.decision_share_table(report).row_count == 3  # two parts, and the heading of the agent

    # Without decisions, share and partner difference are undefined.
    entry = make_share("memory", 0.0, 0.0, None)
    for name in ("share", "partner_difference"):
        interval = entry[name]
        assert isinstance(interval, dict)
        interval["mean"] = None
    undefined_report = report | {"decision_shares": [entry]}
    assert "| ORG (baseline) | memory | argmax | - | - |  |  |" in report_tables.markdown_table(undefined_report)


def test_reports_of_earlier_versions_have_no_shares():
    report = fixed_report(fixed_row())
    assert "decision_shares" not in report
    assert not report_tables.has_decision_shares(report)
    assert "Part of the decision" not in report_tables.markdown_table(report)
