"""The report's tables, for a terminal and in Markdown."""

import io

from rich.console import Console

from jaxnav.evaluation import report as report_tables

ROW = {"variant": "baseline", "method": "ORG", "world": "ithor", "split": "test"}
ROW |= {"epsilon": None, "decoding": "argmax", "form": None}


def fixed_row(**changes):
    """A row with numbers chosen by hand, for the tables."""
    metrics = {
        "sr": {"mean": 66.48, "std": 0.22, "ci95": [63.5, 69.44]},
        "spl": {"mean": 38.42, "std": 0.39, "ci95": [36.0, 40.0]},
        "dts": {"mean": 0.541, "std": 0.01, "ci95": [0.5, 0.6]},
        "timeout": {"mean": 30.04, "std": 1.0, "ci95": [28.0, 32.0]},
        "wrong_done": {"mean": 3.48, "std": 1.0, "ci95": [2.0, 5.0]},
        "sr@20": {"mean": 21.04, "std": 1.0, "ci95": [20.0, 22.0]},
        "sr@100": {"mean": 55.5, "std": 1.0, "ci95": [50.0, 60.0]},
    }
    return ROW | metrics | changes


def fixed_report(*rows, notes=()):
    return {"rows": list(rows), "notes": list(notes)}


CELLS = "66.5 [63.5, 69.4] | 38.4 [36.0, 40.0] | 0.54 [0.50, 0.60] | 21.0, 55.5 | 30.0 | 3.5"


def test_markdown_table_with_the_label_of_every_variant():
    report = fixed_report(
        fixed_row(variant="random", method="random"),
        fixed_row(),
        fixed_row(variant="layout"),
        fixed_row(variant="tde", form="residual"),
        fixed_row(variant="stde", form="residual", epsilon=0.5),
        fixed_row(variant="stde", form="paper", epsilon=0.25),
        notes=["One note.", "Another."],
    )
    assert report_tables.markdown_table(report) == (
        "| Variant | SR (%) | SPL (%) | DTS (m) | SR within 20, 100 (%) | Time-out (%) | Wrong Done (%) |\n"
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |\n"
        "| **ithor test, argmax decoding** |  |  |  |  |  |  |\n"
        f"| Random | {CELLS} |\n"
        f"| ORG (baseline) | {CELLS} |\n"
        f"| + w (layout) | {CELLS} |\n"
        f"| + w + TDE | {CELLS} |\n"
        f"| + w + sTDE (eps=0.5) | {CELLS} |\n"
        f"| + w + sTDE (eps=0.25), paper form | {CELLS} |\n"
        "\nOne note.\n"
        "\nAnother.\n"
    )


def test_rows_are_grouped_by_decoding():
    report = fixed_report(fixed_row(), fixed_row(decoding="sample"), fixed_row(variant="layout"))
    first_cells = [line.split(" | ")[0].strip("| ") for line in report_tables.markdown_table(report).splitlines()[2:]]
    assert first_cells == [
        "**ithor test, argmax decoding**",
        "ORG (baseline)",
        "+ w (layout)",
        "**ithor test, sample decoding**",
        "ORG (baseline)",
    ]


def test_a_cell_without_an_interval_says_so():
    unsure = {"mean": 66.48, "std": None, "ci95": None}
    cells = report_tables.markdown_table(fixed_report(fixed_row(sr=unsure))).splitlines()[3].split(" | ")
    assert cells[1:3] == ["66.5 [-]", "38.4 [36.0, 40.0]"]


def test_console_table():
    report = fixed_report(fixed_row(method="[bold]X[/bold]"), fixed_row(decoding="sample", method="VTNet"))
    console = Console(width=160, record=True, file=io.StringIO(), markup=False)
    console.print(report_tables.results_table(report))
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in console.export_text().splitlines()]
    assert [cells for cells in lines if cells] == [
        ["ithor test, argmax decoding", "", "", "", "", "", ""],
        ["[bold]X[/bold] (baseline)", *CELLS.split(" | ")],  # names are text, never markup
        ["ithor test, sample decoding", "", "", "", "", "", ""],
        ["VTNet (baseline)", *CELLS.split(" | ")],
    ]


def test_difference_table_has_a_line_per_comparison():
    entry = {"from": "layout", "to": "stde", "epsilon": 0.5, "form": "residual", "decoding": "argmax"}
    values = [("sr", 25.0, [10.0, 40.0]), ("spl", -1.25, [-2.0, 0.5]), ("dts", -0.031, [-0.1, 0.0])]
    report = {"differences": [{**entry, "metric": name, "mean": mean, "ci95": ci} for name, mean, ci in values]}
    table = report_tables.difference_table(report)
    cells = [str(next(iter(column.cells))) for column in table.columns]
    expected = [
        "+ w + sTDE (eps=0.5) - + w",
        "argmax",
        "+25.0 [+10.0, +40.0]",
        "-1.2 [-2.0, +0.5]",
        "-0.03 [-0.10, +0.00]",
    ]
    assert (cells, table.row_count) == (expected, 1)
