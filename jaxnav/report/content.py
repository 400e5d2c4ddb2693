"""What a page holds: sections of text, tables and charts."""

from typing import NamedTuple

from rich.table import Table as ConsoleTable


class Table(NamedTuple):
    """Hold a table of texts.

    Attributes:
      title: of the table.
      header: of the columns.
      rows: cells of each line; a line of one cell heads those that follow.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Chart(NamedTuple):
    """Hold a chart as SVG, and what it shows in words."""

    svg: str
    caption: str


class Section(NamedTuple):
    """Hold a section of the page.

    Attributes:
      title: of the section.
      about: what it shows.
      charts, tables: in this order.
      folded: tables that are there to be opened.
      notes: below all of them.
    """

    title: str
    about: str
    charts: tuple[Chart, ...] = ()
    tables: tuple[Table, ...] = ()
    folded: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()


def as_texts(title: str, table: ConsoleTable) -> Table:
    """Return a terminal's table as texts, with the same cells."""
    columns = [[str(cell) for cell in column.cells] for column in table.columns]
    rows = tuple(tuple(cells) if any(cells[1:]) else cells[:1] for cells in zip(*columns, strict=True))
    return Table(title, tuple(str(column.header) for column in table.columns), rows)
