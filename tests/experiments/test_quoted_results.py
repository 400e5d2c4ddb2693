"""Every interval that the texts quote is a stored result."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.processes import REPOSITORY

from jaxnav.experiments.pages import READING_MARK

#: A mean with its interval, such as `3.2 [1.4, 5.1]`, `81 [64, 97]`, `39.4 % [35.0, 43.8]` or `+0.1 [-1.5, +1.6]`.
INTERVAL = re.compile(r"(?<![\w.])([-+]?[\d.]+)(?: ?%)?(?: points)? \[([-+]?[\d.]+), ([-+]?[\d.]+)\]")
#: Texts that quote results, in addition to the summaries on the pages of experiments.
SUMMARIES = ("README.md", "docs/results.md")

Quote = tuple[int, float, float, float]


def quoted_intervals(text: str) -> Iterator[Quote]:
    """Yield the number of decimals, the mean and the bounds of each interval in a text."""
    for match in INTERVAL.finditer(" ".join(text.split())):
        digits = max(len(number.partition(".")[2]) for number in match.groups())
        mean, low, high = map(float, match.groups())
        yield digits, mean, low, high


def both_signs(quote: Quote) -> tuple[Quote, Quote]:
    """A quote as an effect and as a loss: an effect of -4.6 [-7.9, -1.2] is a loss of 4.6 [1.2, 7.9]."""
    digits, mean, low, high = quote
    return quote, (digits, -mean, -high, -low)


def stored_intervals(value) -> Iterator[tuple[float, float, float]]:
    """Yield all defined intervals of a JSON value, including those of curves."""
    if isinstance(value, dict):
        if {"mean", "low", "high"} <= value.keys():
            columns = [value["mean"], value["low"], value["high"]]
            if not isinstance(columns[0], list):
                columns = [[column] for column in columns]
            for interval in zip(*columns, strict=True):
                if None not in interval:
                    yield interval
        for child in value.values():
            yield from stored_intervals(child)
    elif isinstance(value, list):
        for child in value:
            yield from stored_intervals(child)


def json_texts(path: Path) -> list[str]:
    """JSON values of a file: its lines, or the file itself."""
    text = path.read_text()
    return text.splitlines() if path.suffix == ".jsonl" else [text]


@pytest.fixture(scope="module")
def known_quotes() -> set[Quote]:
    """All intervals that a text may quote: stored intervals, rounded, and the generated tables of pages."""
    quotes = set()
    for path in (REPOSITORY / "results").rglob("*.json*"):
        for json_text in json_texts(path):
            for mean, low, high in stored_intervals(json.loads(json_text)):
                for digits in (0, 1, 2):
                    quotes.add((digits, round(mean, digits), round(low, digits), round(high, digits)))

    # The tables of a page are outside the text between its marks.
    for path in (REPOSITORY / "docs").glob("*.md"):
        if f"docs/{path.name}" in SUMMARIES:
            continue
        generated_text = "".join(path.read_text().split(READING_MARK)[::2])
        for line in generated_text.splitlines():
            if line.startswith("|"):
                quotes |= set(quoted_intervals(line))
    return quotes


def written_texts() -> dict[str, str]:
    """Texts written by people, by file. Lines about `make run` are left out, because its results are not stored."""
    texts = {}
    for name in SUMMARIES:
        lines = (REPOSITORY / name).read_text().splitlines()
        texts[name] = "\n".join(line for line in lines if "`make run`" not in line)
    for path in sorted((REPOSITORY / "docs").glob("*.md")):
        parts = path.read_text().split(READING_MARK)
        if len(parts) == 3:
            texts[f"docs/{path.name}"] = parts[1]
    return texts


@pytest.mark.parametrize("name", written_texts())
def test_quoted_intervals_are_results(name, known_quotes):
    for quote in quoted_intervals(written_texts()[name]):
        assert known_quotes.intersection(both_signs(quote)), quote


def test_a_wrong_digit_is_noticed(known_quotes):
    quotes = []
    for text in written_texts().values():
        quotes += quoted_intervals(text)
    assert len(quotes) > 300

    # A wrong number is sometimes another one of the many results, so 90 % suffice.
    num_noticed = 0
    for digits, mean, low, high in quotes:
        wrong_quote = (digits, round(mean + 10.0**-digits, digits), low, high)
        num_noticed += not known_quotes.intersection(both_signs(wrong_quote))
    assert num_noticed > 0.9 * len(quotes)
