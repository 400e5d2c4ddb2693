"""Write docs/leaderboard.md from the scores in results/leaderboard: `python docs/write_leaderboard.py`.

Every score file is that of `jaxnav eval SUBJECT --benchmark NAME`, with the name of the agent as its file name.
"""

import json
from pathlib import Path
from typing import Any

from jaxnav.evaluation.report import UNTRAINED_VARIANTS
from jaxnav.evaluation.statistics import Interval
from jaxnav.runs.benchmark import load_benchmark, score_label, shift_title

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "results" / "leaderboard"
#: The text above the tables ends with this line.
MARK = "<!-- scores -->"


def read_lines(benchmark: str) -> list[tuple[str, dict[str, Any]]]:
    """Read the scores of all agents: the name of each line of the tables, and its row."""
    lines = []
    seen_references = set()
    for path in sorted((FOLDER / benchmark).glob("*.json")):
        for row in json.loads(path.read_text(encoding="utf-8"))["rows"]:
            # Best actions of policies; references are the same in all files.
            if row["decoding"] == "sample":
                continue
            label = score_label({**row, "method": path.stem})
            if row["variant"] in UNTRAINED_VARIANTS:
                if (label, row["track"], row["shift"]) in seen_references:
                    continue
                seen_references.add((label, row["track"], row["shift"]))
            name = f"{path.stem} {label}" if label.startswith("+") else label
            lines.append((name, row))
    return lines


def write_table(track: str, lines: list[tuple[str, dict[str, Any]]]) -> str:
    """Table of a track, sorted by the mixed SR."""
    rows_by_name: dict[str, dict[Any, dict[str, Any]]] = {}
    for name, row in lines:
        if row["track"] == track:
            rows_by_name.setdefault(name, {})[row["shift"]] = row
    if not rows_by_name:
        return "No scores yet.\n"
    shifts = list(next(iter(rows_by_name.values())))
    titles = [f"{metric}, {shift_title(shift)}" for metric in ("SR", "SPL") for shift in shifts]
    table = [f"| agent | {' | '.join(titles)} |", f"| --- |{' ---: |' * len(titles)}"]
    for name in sorted(rows_by_name, key=lambda name: -rows_by_name[name]["mixed"]["sr"]["mean"]):
        cells = []
        for metric in ("sr", "spl"):
            cells += [f"{Interval.from_json(rows_by_name[name][shift][metric]):.1f}" for shift in shifts]
        table.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(table) + "\n"


def write_page() -> str:
    """Text of the page."""
    text, _, _ = (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8").partition(MARK)
    lines = read_lines("v2")
    sections = [text + MARK + "\n"]
    for track in load_benchmark("v2").tracks:
        sections.append(f"\n## {track.name.capitalize()}\n\n{write_table(track.name, lines)}")
    return "".join(sections)


if __name__ == "__main__":
    page = write_page()
    (ROOT / "docs" / "leaderboard.md").write_text(page, encoding="utf-8")
