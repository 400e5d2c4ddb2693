"""Tables of the terminal as texts."""

from rich.table import Table as ConsoleTable
from rich.text import Text

from jaxnav.report.content import as_texts


def test_cells_are_those_of_the_terminal():
    table = ConsoleTable("Variant", "SR (%)")
    table.add_row(Text("rooms val", style="bold"))
    table.add_row(Text("a [b]"), Text("1.0 [0.5, 1.5]"))
    assert as_texts("t", table) == ("t", ("Variant", "SR (%)"), (("rooms val",), ("a [b]", "1.0 [0.5, 1.5]")))
