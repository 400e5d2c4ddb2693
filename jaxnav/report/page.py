"""The report's page: sections of text, tables and charts, and replays, as one self-contained HTML file.

`render_report_page` renders the page from a `Headline`, from `Section`s, which hold `TextTable`s and `Chart`s, and from
the data of the replays. Terms of the glossary open their definitions where they stand, see `jaxnav.report.terms`.
The page's layout, style and scripts are the files next to this module.
"""

import base64
import dataclasses
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any, NamedTuple

from rich.table import Table as ConsoleTable

from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.figures import interval_text
from jaxnav.report.headline import Headline, KeyFigure
from jaxnav.report.replays import Replays
from jaxnav.report.terms import GLOSSARY, mark_terms


class TextTable(NamedTuple):
    """Table of texts.

    Attributes:
      title: title of the table.
      header: names of the columns.
      rows: cells of each row; a row of one cell is the heading of the rows after it.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Chart(NamedTuple):
    """Chart as an SVG element, and its description in words."""

    svg: str
    caption: str


class Section(NamedTuple):
    """Section of the page, with its parts in the order of the page.

    Attributes:
      title: title of the section.
      about: introduction.
      charts: charts.
      tables: tables below the charts.
      folded: tables that the reader can open.
      notes: notes below all tables.
    """

    title: str
    about: str
    charts: tuple[Chart, ...] = ()
    tables: tuple[TextTable, ...] = ()
    folded: tuple[TextTable, ...] = ()
    notes: tuple[str, ...] = ()


def to_text_table(title: str, table: ConsoleTable) -> TextTable:
    """Return a table of the terminal as texts, with equal cells."""
    # Rich stores the cells by column.
    column_headers = []
    column_cells = []
    for column in table.columns:
        column_headers.append(str(column.header))
        column_cells.append(list(map(str, column.cells)))

    # A row whose other cells are empty heads the rows below it.
    table_rows = []
    for row_cells in zip(*column_cells, strict=True):
        is_heading = not any(row_cells[1:])
        table_rows.append(row_cells[:1] if is_heading else row_cells)
    return TextTable(title, tuple(column_headers), tuple(table_rows))


def render_report_page(
    title: str,
    headline: Headline,
    facts: Mapping[str, str],
    sections: Sequence[Section],
    replays: Sequence[Replays],
) -> str:
    """Return the page as HTML.

    Every text is escaped. The script is allowed by its digest alone, and the page can load nothing.

    Args:
      title: title of the page.
      headline: main results.
      facts: facts about the run, by name.
      sections: sections in order; the replays follow the first.
      replays: replays at each shift.
    """
    # The browser runs the script only if its digest is that of the page's policy.
    page_script = _read_resource("draw.js") + _read_resource("player.js")
    script_digest = base64.b64encode(hashlib.sha256(page_script.encode()).digest()).decode()

    # The header: facts about the run, and links to the sections.
    fact_items = []
    for fact_name, fact_text in facts.items():
        fact_items.append(f"<div>{_tag('dt', html.escape(fact_name))}{_tag('dd', html.escape(fact_text))}</div>")
    section_titles = [section.title for section in sections]
    section_titles.insert(1, "Replays")
    section_titles.append("Terms")
    section_links = []
    for section_title in section_titles:
        section_links.append(f'<a href="#{_anchor(section_title)}">{html.escape(section_title)}</a>')

    # The template puts the replays between the first section and the rest, and a glossary at the end.
    rendered_sections = list(map(_render_section, sections))
    return Template(_read_resource("page.html")).substitute(
        title=html.escape(title),
        policy=f"sha256-{script_digest}",
        style=_read_resource("page.css"),
        script=page_script,
        data=_embed_json(list(map(dataclasses.asdict, replays))),
        headline=_render_headline(headline),
        facts="".join(fact_items),
        links="".join(section_links),
        first=rendered_sections[0],
        others="\n".join(rendered_sections[1:]),
        terms=_render_glossary(),
        explanations=_render_explanations(),
    )


def _render_headline(headline: Headline) -> str:
    # Every term opens its definition at its first mention.
    marked_keys: set[str] = set()
    sentences = []
    for sentence in headline.sentences:
        sentences.append(mark_terms(html.escape(sentence), marked_keys))
    figures = []
    for figure in headline.figures:
        figures.append(_render_figure(figure))
    main_result, *other_results = sentences
    text = _tag("p", main_result, "headline")
    for result in other_results:
        text += _tag("p", result, "finding")
    return text + _tag("div", "".join(figures), "figures")


def _render_figure(figure: KeyFigure) -> str:
    """Return a figure as a list of its values, each with a drawing of its interval."""
    number_format = "+.1f" if figure.is_difference else ".1f"
    value_rows = []
    for name, value in figure.values.items():
        # The number, the drawing, and the bounds below.
        number, _, bounds = interval_text(value, number_format).partition(" ")
        number_html = f"{_tag('b', number)} {html.escape(figure.unit)}"
        drawing = _draw_interval(value, figure.axis)
        value_rows.append(_tag("dt", html.escape(name)) + _tag("dd", number_html + drawing + _tag("small", bounds)))
    title = _tag("h3", html.escape(figure.title))
    note = _tag("p", mark_terms(html.escape(figure.note), set()))
    return _tag("div", title + _tag("dl", "".join(value_rows)) + note, "figure")


def _draw_interval(value: Interval, axis: tuple[float, float]) -> str:
    """Return a drawing of a value and its interval on an axis, which is an ornament next to the numbers."""
    start, end = axis

    def place(number: float) -> float:
        return round(100 * (min(max(number, start), end) - start) / (end - start), 2)

    shapes = ['<rect class="track" y="3" width="100" height="2"/>']
    if start < 0 < end:
        shapes.append(f'<rect class="zero" x="{place(0) - 0.25}" width="0.5" height="8"/>')
    if value.has_bounds:
        left_edge = place(value.low)
        width = max(place(value.high) - left_edge, 0.5)
        shapes.append(f'<rect class="bounds" x="{left_edge}" y="2" width="{width}" height="4"/>')
    if value.mean == value.mean:  # not NaN
        shapes.append(f'<rect class="mean" x="{place(value.mean) - 0.5}" width="1" height="8"/>')
    return f'<svg viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true">{"".join(shapes)}</svg>'


def _render_glossary() -> str:
    """Return the list of all terms."""
    entries = []
    for term in GLOSSARY:
        name = f'<dt id="term-{term.key}">{html.escape(term.name)}</dt>'
        entries.append(name + _tag("dd", html.escape(term.definition)))
    return "".join(entries)


def _render_explanations() -> str:
    """Return the definitions that terms in the text open."""
    explanations = []
    for term in GLOSSARY:
        explanations.append(
            f'<div popover id="about-{term.key}" class="explanation">{_tag("b", html.escape(term.name))}'
            f"{_tag('p', html.escape(term.definition))}</div>"
        )
    return "".join(explanations)


def _render_section(section: Section) -> str:
    # The heading and the introduction, then charts and tables.
    about = mark_terms(html.escape(section.about), set())
    html_parts = [_tag("h2", html.escape(section.title)), _tag("p", about, "about")]
    html_parts += map(_render_chart, section.charts)
    html_parts += map(_render_table, section.tables)

    # Details are closed until the reader opens them.
    for table in section.folded:
        html_parts.append(f"<details><summary>{html.escape(table.title)}</summary>{_render_table(table)}</details>")
    for note in section.notes:
        html_parts.append(_tag("p", html.escape(note), "note"))
    return f'<section id="{_anchor(section.title)}">{"".join(html_parts)}</section>'


def _render_chart(chart: Chart) -> str:
    chart_label = html.escape(chart.caption)
    return f'<figure class="chart" role="img" aria-label="{chart_label}">{chart.svg}</figure>'


def _render_table(table: TextTable) -> str:
    table_caption = _tag("caption", html.escape(table.title))
    marked_keys: set[str] = set()
    header_row = _render_header(table.header, marked_keys)
    body_rows = [_render_row(row, len(table.header), marked_keys) for row in table.rows]

    # The box around a table scrolls where the page is narrower.
    return (
        f'<div class="table"><table>{table_caption}<thead><tr>{header_row}</tr></thead>'
        f"<tbody>{''.join(body_rows)}</tbody></table></div>"
    )


def _render_row(row: Sequence[str], num_columns: int, marked_keys: set[str]) -> str:
    # A single cell is a heading across all columns; otherwise the first cell names the row.
    first_cell, *other_cells = row
    if not other_cells:
        heading = mark_terms(html.escape(first_cell), marked_keys)
        return f'<tr class="group"><th colspan="{num_columns}" scope="rowgroup">{heading}</th></tr>'
    row_name = mark_terms(html.escape(first_cell), marked_keys)
    values = "".join(_tag("td", html.escape(cell)) for cell in other_cells)
    return f'<tr><th scope="row">{row_name}</th>{values}</tr>'


def _render_header(titles: Sequence[str], marked_keys: set[str]) -> str:
    header_cells = []
    for title in titles:
        header_cells.append(f'<th scope="col">{mark_terms(html.escape(title), marked_keys)}</th>')
    return "".join(header_cells)


def _tag(name: str, content: str, css_class: str = "") -> str:
    class_attribute = f' class="{css_class}"' if css_class else ""
    return f"<{name}{class_attribute}>{content}</{name}>"


def _anchor(title: str) -> str:
    return re.sub(r"\W+", "-", title.lower())


def _embed_json(data: Any) -> str:
    """Return JSON that no HTML parser takes for a tag or a comment."""
    json_text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return json_text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _read_resource(name: str) -> str:
    return resources.files("jaxnav.report").joinpath(name).read_text(encoding="utf-8")
