"""Tables of the performance document, from the benchmarks' results.

`python benchmarks/table.py [RESULTS [DOCUMENT]]` writes a table between each `<!-- table NAME -->` and `<!-- end -->`:
the contents of RESULTS/NAME.json, or with `NAME.key.key` a part of them; a missing result is named there. By default
results/performance is read and docs/performance.md written; a document that does not exist is created, with a table of
every result. Charts go to docs/images/performance, or beside such a document.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from _charts import draw_charts

RESULTS = Path("results/performance")
DOCUMENT = Path("docs/performance.md")
IMAGES = Path("docs/images/performance")
TABLE_MARKS = re.compile(r"<!-- table (\S+) -->\n.*?<!-- end -->", re.DOTALL)


def main(results: Path = RESULTS, document: Path = DOCUMENT) -> None:
    if not document.exists():
        names = sorted(path.stem for path in results.glob("*.json"))
        parts = [f"## {name}\n\n<!-- table {name} -->\n<!-- end -->\n" for name in names]
        document.write_text("\n".join(["# Performance\n", *parts]))
    text = document.read_text()
    document.write_text(TABLE_MARKS.sub(lambda match: fill_table(match[1], results), text))
    draw_charts(results, IMAGES if document == DOCUMENT else document.parent)


def fill_table(name: str, results: Path) -> str:
    """Return one table between its marks."""
    file, *keys = name.split(".")
    path = results / f"{file}.json"
    if not path.exists():
        body = f"*{path} is missing: this benchmark has not been run.*"
    else:
        part = json.loads(path.read_text())
        for key in keys:
            part = part[key]
        if not keys:
            part = {key: value for key, value in part.items() if key != "machine"}
        body = format_table(part)
    return f"<!-- table {name} -->\n{body}\n<!-- end -->"


def format_table(part: Any) -> str:
    """Return a Markdown table of a result.

    If all entries have parts, each is a row with a column for each part; otherwise each leaf is a row.
    """
    entries = {str(number): entry for number, entry in enumerate(part, start=1)} if isinstance(part, list) else part
    if all(isinstance(entry, Mapping) and not is_spread(entry) for entry in entries.values()):
        rows = {name: dict(iterate_leaves(entry)) for name, entry in entries.items()}
    else:
        rows = {name: {"value": value} for name, value in iterate_leaves(entries)}

    # Columns in the order in which they first occur; a row may lack some.
    columns = []
    for row in rows.values():
        columns += [column for column in row if column not in columns]

    lines = [["", *(column.replace("_", " ") for column in columns)], ["---"] + ["---:"] * len(columns)]
    for name, row in rows.items():
        lines.append([name.replace("_", " "), *(format_cell(row.get(column)) for column in columns)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def iterate_leaves(part: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and value of all leaves; spreads and lists are leaves."""
    for name, value in part.items():
        if isinstance(value, Mapping) and not is_spread(value):
            yield from iterate_leaves(value, f"{prefix}{name}: ")
        else:
            yield f"{prefix}{name}", value


def is_spread(value: Any) -> bool:
    """True for a median with its bounds."""
    return isinstance(value, Mapping) and {"median", "min", "max"} <= set(value)


def format_cell(value: Any) -> str:
    """Return one cell; a spread as `median (minimum to maximum)`."""
    if is_spread(value):
        return f"{format_cell(value['median'])} ({format_cell(value['min'])} to {format_cell(value['max'])})"
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: ""}[value]
    if isinstance(value, list):
        return ", ".join(format_cell(item) for item in value)
    if isinstance(value, int | float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value).replace("|", "\\|")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))
