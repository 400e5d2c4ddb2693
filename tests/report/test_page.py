"""The page: names stay text, whatever they hold, and it is one file that loads nothing."""

import base64
import collections
import dataclasses
import hashlib
import json
import re
from html.parser import HTMLParser

import pytest
from rich.table import Table as ConsoleTable
from rich.text import Text
from support.report_page import example_page, example_replays

from jaxnav.report.page import to_text_table

HOSTILE = (
    "</script><!--<script>alert(1)</script><img src=x onerror='alert(1)'>\" onload=\"alert(1) &amp; ${x} $y \u2028"
)


class PageReader(HTMLParser):
    """Collects the tags of a page with their attributes, and the texts by the innermost tag around them."""

    def __init__(self, page_text):
        super().__init__()
        self.tags = []
        self.texts = {}
        self.open_tags = []
        self.feed(page_text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open_tags.append(tag)

    def handle_endtag(self, tag):
        if tag in self.open_tags:
            while self.open_tags.pop() != tag:
                pass

    def handle_data(self, data):
        if self.open_tags:
            self.texts.setdefault(self.open_tags[-1], []).append(data)

    def count_tags(self):
        return collections.Counter(tag for tag, _ in self.tags)

    def attribute_names(self):
        names = set()
        for _, attributes in self.tags:
            names.update(attributes)
        return names

    def attributes_of(self, tag):
        """The attributes of each of the tags with a name."""
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def hostile_reader():
    return PageReader(example_page(HOSTILE))


@pytest.fixture(scope="module")
def plain_reader():
    return PageReader(example_page())


def test_hostile_names_add_no_tags_and_no_attributes(hostile_reader, plain_reader):
    assert hostile_reader.count_tags() == plain_reader.count_tags()
    assert hostile_reader.attribute_names() == plain_reader.attribute_names()
    assert not any(name.startswith("on") for name in hostile_reader.attribute_names())


def test_hostile_names_are_shown_unchanged(hostile_reader):
    for tag, text in (
        ("h1", "title"),
        ("th", "row"),
        ("th", "group"),
        ("h3", "figure"),
        ("caption", "Shift 0"),
        ("dd", "run"),
    ):
        assert text + HOSTILE in hostile_reader.texts[tag], tag
    figure_labels = {attributes["aria-label"] for attributes in hostile_reader.attributes_of("figure")}
    assert figure_labels == {"chart" + HOSTILE}


def test_page_embeds_the_replays_as_json_without_markup():
    page_text = example_page(HOSTILE)
    embedded_json = page_text.partition('id="data">')[2].partition("</script>")[0]
    assert not set("<>&") & set(embedded_json)
    expected_data = json.loads(json.dumps([dataclasses.asdict(example_replays(HOSTILE))]))
    assert json.loads(embedded_json) == expected_data


def test_page_loads_nothing(plain_reader):
    page_text = example_page()
    assert not re.findall(r"(?:src|href)=\"(?!#)", page_text.partition("<script")[0])
    assert not {"link", "img", "iframe", "object", "embed", "base", "form"} & set(plain_reader.count_tags())
    assert "@import" not in page_text
    assert "url(" not in page_text


def test_page_policy_allows_its_own_script_alone(plain_reader):
    policies = []
    for attributes in plain_reader.attributes_of("meta"):
        if attributes.get("http-equiv") == "Content-Security-Policy":
            policies.append(attributes["content"])
    (policy,) = policies
    directives = dict(directive.split(" ", 1) for directive in policy.split("; "))
    script = plain_reader.texts["script"][-1]
    script_digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert directives["default-src"] == "'none'"
    assert directives["script-src"] == f"'sha256-{script_digest}'"


def test_page_shows_tables_without_javascript(plain_reader):
    assert plain_reader.texts["td"].count("50.0 [40.0, 60.0]") == 4  # two sections, open and folded
    assert any("need JavaScript" in text for text in plain_reader.texts["p"])
    (player_attributes,) = (attributes for _, attributes in plain_reader.tags if attributes.get("id") == "player")
    assert "hidden" in player_attributes


def test_page_links_lead_to_its_sections(hostile_reader):
    link_targets = {attributes["href"].removeprefix("#") for attributes in hostile_reader.attributes_of("a")}
    section_ids = {attributes["id"] for _, attributes in hostile_reader.tags if "id" in attributes}
    assert link_targets <= section_ids
    assert "replays" in link_targets


@pytest.mark.parametrize(
    "term", ["Layout weights, w", "TDE", "sTDE, ε (eps)", "Removal", "Layout gap, D", "[a, b] and [-]"]
)
def test_page_explains_the_terms_of_its_tables(plain_reader, term):
    assert term in plain_reader.texts["dt"]
    assert {"href": "#terms"} in plain_reader.attributes_of("a")


def test_every_term_on_the_page_has_its_definition(plain_reader):
    opened_ids = {
        button["popovertarget"] for button in plain_reader.attributes_of("button") if "popovertarget" in button
    }
    popover_ids = {attributes["id"] for _, attributes in plain_reader.tags if "popover" in attributes}
    assert "about-sr" in opened_ids
    assert opened_ids <= popover_ids


def test_ids_are_unique(plain_reader):
    ids = [attributes["id"] for tag, attributes in plain_reader.tags if "id" in attributes and tag != "section"]
    assert len(set(ids)) == len(ids)


def test_headline_shows_its_figures_with_bounds(plain_reader):
    assert "sentence" in plain_reader.texts["p"]
    assert "50.0" in plain_reader.texts["b"]
    assert {"[40.0, 60.0]", "[\N{MINUS SIGN}]"} <= set(plain_reader.texts["small"])


def test_to_text_table_copies_the_cells_of_a_console_table():
    table = ConsoleTable("Variant", "SR (%)")
    table.add_row(Text("rooms val", style="bold"))
    table.add_row(Text("a [b]"), Text("1.0 [0.5, 1.5]"))
    expected_rows = (("rooms val",), ("a [b]", "1.0 [0.5, 1.5]"))
    assert to_text_table("t", table) == ("t", ("Variant", "SR (%)"), expected_rows)
