"""The page: sections and replays as one HTML file that needs nothing else."""

import base64
import dataclasses
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any

from jaxnav.report.content import Chart, Section, Table
from jaxnav.report.replays import Replays


def render(title: str, facts: Mapping[str, str], sections: Sequence[Section], replays: Sequence[Replays]) -> str:
    """Return the page as HTML.

    Every text is escaped. The script is allowed by its digest alone, and nothing may be loaded.

    Args:
      title: of the page.
      facts: about the run, by name.
      sections: in order; the replays follow the first.
      replays: at each shift.
    """
    script = _file("draw.js") + _file("player.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    rendered = [_section(section) for section in sections]
    titles = [sections[0].title, "Replays", *(section.title for section in sections[1:])]
    return Template(_file("page.html")).substitute(
        title=html.escape(title),
        policy=f"sha256-{digest}",
        style=_file("page.css"),
        script=script,
        data=_embedded([dataclasses.asdict(each) for each in replays]),
        facts="".join(
            f"<div>{_tag('dt', html.escape(name))}{_tag('dd', html.escape(fact))}</div>" for name, fact in facts.items()
        ),
        links="".join(f'<a href="#{_anchor(each)}">{html.escape(each)}</a>' for each in titles),
        first=rendered[0],
        others="\n".join(rendered[1:]),
    )


def _section(section: Section) -> str:
    parts = [_tag("h2", html.escape(section.title)), _tag("p", html.escape(section.about), "about")]
    parts += [_chart(chart) for chart in section.charts]
    parts += [_table(table) for table in section.tables]
    parts += [
        f"<details><summary>{html.escape(each.title)}</summary>{_table(each)}</details>" for each in section.folded
    ]
    parts += [_tag("p", html.escape(note), "note") for note in section.notes]
    return f'<section id="{_anchor(section.title)}">{"".join(parts)}</section>'


def _chart(chart: Chart) -> str:
    label = html.escape(chart.caption)
    return f'<figure class="chart" role="img" aria-label="{label}">{chart.svg}</figure>'


def _table(table: Table) -> str:
    head = "".join(_tag("th", html.escape(cell)) for cell in table.header)
    body = "".join(_line(row, len(table.header)) for row in table.rows)
    caption = _tag("caption", html.escape(table.title))
    return f'<div class="table"><table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _line(row: Sequence[str], width: int) -> str:
    first, *others = (html.escape(cell) for cell in row)
    if not others:
        return f'<tr class="group"><th colspan="{width}">{first}</th></tr>'
    return f"<tr><th>{first}</th>{''.join(_tag('td', cell) for cell in others)}</tr>"


def _tag(name: str, content: str, kind: str = "") -> str:
    attribute = f' class="{kind}"' if kind else ""
    return f"<{name}{attribute}>{content}</{name}>"


def _anchor(title: str) -> str:
    return re.sub(r"\W+", "-", title.lower())


def _embedded(data: Any) -> str:
    """Return JSON that no HTML parser takes for a tag or a comment."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _file(name: str) -> str:
    return resources.files("jaxnav.report").joinpath(name).read_text(encoding="utf-8")
