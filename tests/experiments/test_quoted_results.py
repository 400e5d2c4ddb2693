"""Every interval that the texts quote is one of the stored results."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from jaxnav.experiments.pages import READING_MARK

ROOT = Path(__file__).parents[2]
#: A mean with its interval, such as `3.2 [1.4, 5.1]`, `81 [64, 97]`, `39.4 % [35.0, 43.8]` or `+0.1 [-1.5, +1.6]`.
INTERVAL = re.compile(r"(?<![\w.])([-+]?[\d.]+)(?: ?%)?(?: points)? \[([-+]?[\d.]+), ([-+]?[\d.]+)\]")
#: Texts whose numbers are results, beside the texts that people write on the pages of experiments.
SUMMARIES = ("README.md", "docs/results.md")

Quote = tuple[int, float, float, float]


def quoted_intervals(text: str) -> Iterator[Quote]:
    """Number of decimals, mean and bounds of each interval in a text."""
    for match in INTERVAL.finditer(" ".join(text.split())):
        digits = max(len(number.partition(".")[2]) for number in match.groups())
        mean, low, high = map(float, match.groups())
        yield digits, mean, low, high


def with_either_sign(quote: Quote) -> tuple[Quote, Quote]:
    """An effect of -4.6 [-7.9, -1.2] is a loss of 4.6 [1.2, 7.9]."""
    digits, mean, low, high = quote
    return quote, (digits, -mean, -high, -low)


def stored_intervals(value) -> Iterator[tuple[float, float, float]]:
    """All intervals of a JSON value, those of curves included."""
    if isinstance(value, dict):
        if {"mean", "low", "high"} <= value.keys():
            columns = [value["mean"], value["low"], value["high"]]
            if not isinstance(columns[0], list):
                columns = [[column] for column in columns]
            yield from (row for row in zip(*columns, strict=True) if None not in row)
        for child in value.values():
            yield from stored_intervals(child)
    elif isinstance(value, list):
        for child in value:
            yield from stored_intervals(child)


@pytest.fixture(scope="module")
def known_quotes() -> set[Quote]:
    """All that a text may quote: stored intervals, rounded, and the generated tables of pages."""
    quotes = set()
    for path in (ROOT / "results").rglob("*.json*"):
        for line in path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]:
            for interval in stored_intervals(json.loads(line)):
                for digits in (0, 1, 2):
                    mean, low, high = (round(number, digits) for number in interval)
                    quotes.add((digits, mean, low, high))
    for path in (ROOT / "docs").glob("*.md"):
        if f"docs/{path.name}" in SUMMARIES:
            continue
        generated_text = "".join(path.read_text().split(READING_MARK)[::2])
        for line in generated_text.splitlines():
            if line.startswith("|"):
                quotes |= set(quoted_intervals(line))
    return quotes


def written_texts() -> dict[str, str]:
    """What people wrote, by file; rows of `make run` are of no stored result."""
    texts = {}
    for name in SUMMARIES:
        lines = (ROOT / name).read_text().splitlines()
        texts[name] = "\n".join(line for line in lines if "`make run`" not in line)
    for path in sorted((ROOT / "docs").glob("*.md")):
        parts = path.read_text().split(READING_MARK)
        if len(parts) == 3:
            texts[f"docs/{path.name}"] = parts[1]
    return texts


@pytest.mark.parametrize("name", written_texts())
def test_quoted_intervals_are_results(name, known_quotes):
    for quote in quoted_intervals(written_texts()[name]):
        assert known_quotes.intersection(with_either_sign(quote)), quote


def test_a_wrong_digit_is_noticed(known_quotes):
    # Among so many results, a wrong number is sometimes another result.
    quotes = [quote for text in written_texts().values() for quote in quoted_intervals(text)]
    assert len(quotes) > 300
    num_noticed = 0
    for digits, mean, low, high in quotes:
        wrong_quote = (digits, round(mean + 10.0**-digits, digits), low, high)
        num_noticed += not known_quotes.intersection(with_either_sign(wrong_quote))
    assert num_noticed > 0.9 * len(quotes)
