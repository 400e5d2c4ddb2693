"""Tables of the performance document, from the benchmarks' results.

`python benchmarks/table.py [RESULTS [DOCUMENT]]` fills them. Between `<!-- table NAME -->` and `<!-- end -->` goes what
RESULTS/NAME.json holds, or with `NAME.key.key` a part of it; a result that is missing is named there. By default from
results/performance into docs/performance.md; a document that does not exist is made, with a table of every result.
Charts go to docs/images/performance, or beside such a document.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from _charts import draw

RESULTS, DOCUMENT, IMAGES = (Path(p) for p in ("results/performance", "docs/performance.md", "docs/images/performance"))
MARKED = re.compile(r"<!-- table (\S+) -->\n.*?<!-- end -->", re.DOTALL)


def main(results: Path = RESULTS, document: Path = DOCUMENT) -> None:
    if not document.exists():
        names = sorted(path.stem for path in results.glob("*.json"))
        parts = [f"## {name}\n\n<!-- table {name} -->\n<!-- end -->\n" for name in names]
        document.write_text("\n".join(["# Performance\n", *parts]))
    text = document.read_text()
    document.write_text(MARKED.sub(lambda mark: filled(mark[1], results), text))
    draw(results, IMAGES if document == DOCUMENT else document.parent)


def filled(name: str, results: Path) -> str:
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
        body = table(part)
    return f"<!-- table {name} -->\n{body}\n<!-- end -->"


def table(part: Any) -> str:
    """Return a Markdown table of a result.

    Entries that all have parts are rows with a column for each part, else an entry is a row.
    """
    rows = {str(i): row for i, row in enumerate(part, start=1)} if isinstance(part, list) else part
    if all(isinstance(row, Mapping) and not is_spread(row) for row in rows.values()):
        flat = {name: dict(leaves(row)) for name, row in rows.items()}
        columns = list(dict.fromkeys(column for row in flat.values() for column in row))
    else:
        flat = {name: {"value": value} for name, value in leaves(rows)}
        columns = ["value"]
    head = ["", *(column.replace("_", " ") for column in columns)]
    lines = [head, ["---"] + ["---:"] * len(columns)]
    for name, row in flat.items():
        lines.append([name.replace("_", " "), *(shown(row.get(column)) for column in columns)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def leaves(part: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield entries by path, spreads and lists as they are."""
    for name, value in part.items():
        if isinstance(value, Mapping) and not is_spread(value):
            yield from leaves(value, f"{before}{name}: ")
        else:
            yield f"{before}{name}", value


def is_spread(value: Any) -> bool:
    """Return whether this is a median with its bounds."""
    return isinstance(value, Mapping) and {"median", "min", "max"} <= set(value)


def shown(value: Any) -> str:
    """Return one cell; a spread as `median (least to greatest)`."""
    if is_spread(value):
        return f"{shown(value['median'])} ({shown(value['min'])} to {shown(value['max'])})"
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: ""}[value]
    if isinstance(value, list):
        return ", ".join(shown(item) for item in value)
    if isinstance(value, int | float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value).replace("|", "\\|")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))
