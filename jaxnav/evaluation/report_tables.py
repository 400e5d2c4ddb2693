"""The evaluation report as tables for a terminal and in Markdown."""

from typing import Any

from rich.table import Table

from jaxnav.evaluation.statistics import Interval

#: Titles and decimal places of the metrics.
COLUMNS = {"sr": ("SR (%)", 1), "spl": ("SPL (%)", 1), "dts": ("DTS (m)", 2)}
#: How episodes fail: means without intervals, beside the columns.
_FAILURES = {"timeout": "Time-out (%)", "wrong_done": "Wrong Done (%)"}


def console_table(report: dict[str, Any]) -> Table:
    """Make the table for a terminal.

    A line per row, `mean [95 % interval]`, under a header per world, split and decoding.
    """
    table = Table("Variant", *_titles(report))
    for heading, lines in _groups(report).items():
        table.add_section()
        table.add_row(heading, style="bold")
        for cells in lines:
            table.add_row(*cells)
    return table


def difference_table(report: dict[str, Any]) -> Table:
    """Make the table of the paired differences.

    A line per comparison and decoding, `mean [95 % interval]`.
    """
    lines: dict[tuple[str, str], list[str]] = {}
    for entry in report["differences"]:
        _, digits = COLUMNS[entry["metric"]]
        cell = f"{Interval.from_json(entry):+.{digits}f}"
        lines.setdefault((difference_label(entry), entry["decoding"]), []).append(cell)
    table = Table("Difference, paired on episodes", "decoding", *(title for title, _ in COLUMNS.values()))
    for names, cells in lines.items():
        table.add_row(*names, *cells)
    return table


def markdown_table(report: dict[str, Any]) -> str:
    """Make the table in Markdown, with its notes, ending with a newline."""
    titles = _titles(report)
    lines = [("Variant", *titles), ("---", *("---:" for _ in titles))]
    for heading, group in _groups(report).items():
        lines += [(f"**{heading}**", *("" for _ in titles)), *group]
    table = "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
    return table + "".join(f"\n{note}\n" for note in report.get("notes", ()))  # version 0.1 had none


def _titles(report: dict[str, Any]) -> list[str]:
    """Return the headings beside the first."""
    titles = [title for title, _ in COLUMNS.values()]
    if budgets := _budgets(report):
        titles.append(f"SR within {', '.join(map(str, budgets))} (%)")
    return [*titles, *_FAILURES.values()]


def _budgets(report: dict[str, Any]) -> list[int]:
    """Return the numbers of actions within which success was counted; none before 0.2."""
    return sorted(int(name.removeprefix("sr@")) for name in report["rows"][0] if name.startswith("sr@"))


def _groups(report: dict[str, Any]) -> dict[str, list[tuple[str, ...]]]:
    """Group the cells of lines by heading, in order."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    budgets = _budgets(report)
    for row in report["rows"]:
        heading = f"{row['world']} {row['split']}, {row['decoding']} decoding"
        cells = (
            label(row),
            *(f"{Interval.from_json(row[metric]):.{digits}f}" for metric, (_, digits) in COLUMNS.items()),
            *([", ".join(f"{row[f'sr@{budget}']['mean']:.1f}" for budget in budgets)] if budgets else ()),
            *(f"{row[metric]['mean']:.1f}" if metric in row else "" for metric in _FAILURES),  # version 0.2 had none
        )
        groups.setdefault(heading, []).append(cells)
    return groups


def label(row: dict[str, Any]) -> str:
    """Return the name of a row of a report."""
    match row["variant"]:
        case "oracle":
            label = "Shortest path (oracle)"
        case "random":
            label = "Random"
        case "baseline":
            label = f"{row['method']} (baseline)"
        case "layout":
            label = "+ w (layout)"
        case "tde":
            label = "+ w + TDE"
        case _:
            label = f"+ w + sTDE (eps={row['epsilon']:g})"
    forms = {"paper": ", paper form", "switch": ", switch"}
    return label + (forms.get(row["form"], "") if row["variant"] == "stde" else "")


def difference_label(entry: dict[str, Any]) -> str:
    """Return the name of a paired difference of a report."""
    compared = label({**entry, "variant": entry["to"], "method": ""})
    return f"{compared} - {'+ w' if entry['from'] == 'layout' else entry['from']}"
