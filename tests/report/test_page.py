"""The page: names are text, whatever they hold, and it is one file that loads nothing."""

import base64
import dataclasses
import hashlib
import json
import re
from html.parser import HTMLParser

import pytest
from rich.table import Table as ConsoleTable
from rich.text import Text
from support.report_page import page, replays

from jaxnav.report.page import to_text_table

HOSTILE = (
    "</script><!--<script>alert(1)</script><img src=x onerror='alert(1)'>\" onload=\"alert(1) &amp; ${x} $y \u2028"
)


class Reader(HTMLParser):
    """Collects tags with their attributes, and the texts of scripts and tables."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts, self.open = [], {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag):
        if tag in self.open:
            while self.open.pop() != tag:
                pass

    def handle_data(self, data):
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)


def count(reader):
    names = [tag for tag, _ in reader.tags]
    return {name: names.count(name) for name in set(names)}


@pytest.fixture(scope="module")
def hostile():
    return Reader(page(HOSTILE))


def test_hostile_names_make_no_tags_and_no_attributes(hostile):
    plain = Reader(page())
    assert count(hostile) == count(plain)
    attributes = [{name for _, attributes in reader.tags for name in attributes} for reader in (hostile, plain)]
    assert attributes[0] == attributes[1]
    assert not any(name.startswith("on") for name in attributes[0])


def test_hostile_names_are_still_read_as_they_are(hostile):
    for tag, text in (("h1", "title"), ("th", "row"), ("th", "group"), ("caption", "Shift 0"), ("dd", "run")):
        assert text + HOSTILE in hostile.texts[tag], tag
    assert {tag["aria-label"] for name, tag in hostile.tags if name == "figure"} == {"chart" + HOSTILE}


def test_the_data_is_what_was_given():
    text = page(HOSTILE)
    data = text.partition('id="data">')[2].partition("</script>")[0]
    assert not set("<>&") & set(data)
    assert json.loads(data) == json.loads(json.dumps([dataclasses.asdict(replays(HOSTILE))]))


def test_nothing_is_loaded_and_one_script_is_allowed():
    text = page()
    reader = Reader(text)
    assert not re.findall(r"(?:src|href)=\"(?!#)", text.partition("<script")[0])
    assert not {"link", "img", "iframe", "object", "embed", "base", "form"} & {tag for tag, _ in reader.tags}
    assert "@import" not in text
    assert "url(" not in text
    (policy,) = (tag["content"] for name, tag in reader.tags if tag.get("http-equiv") == "Content-Security-Policy")
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    script = reader.texts["script"][-1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert (rules["default-src"], rules["script-src"]) == ("'none'", f"'sha256-{digest}'")


def test_the_script_parses_no_names():
    script = Reader(page()).texts["script"][-1]
    assert "textContent" in script
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|Function\(|fetch\(", script)


def test_tables_are_there_without_a_script():
    reader = Reader(page())
    assert reader.texts["td"].count("50.0 [40.0, 60.0]") == 4  # two sections, open and folded
    assert any("need JavaScript" in text for text in reader.texts["p"])
    (player,) = (tag for _, tag in reader.tags if tag.get("id") == "player")
    assert "hidden" in player


def test_links_lead_to_sections():
    reader = Reader(page(HOSTILE))
    targets = {tag["href"].removeprefix("#") for name, tag in reader.tags if name == "a"}
    assert targets <= {tag["id"] for _, tag in reader.tags if "id" in tag}
    assert "replays" in targets


def test_cells_are_those_of_the_terminal():
    table = ConsoleTable("Variant", "SR (%)")
    table.add_row(Text("rooms val", style="bold"))
    table.add_row(Text("a [b]"), Text("1.0 [0.5, 1.5]"))
    assert to_text_table("t", table) == ("t", ("Variant", "SR (%)"), (("rooms val",), ("a [b]", "1.0 [0.5, 1.5]")))
