"""Console that prints names literally: `PlainConsole`, and `to_plain_console` for the console of a caller.

Names of files, scenes and categories come from users and may hold anything. Every function that takes a console from
outside passes it through `to_plain_console` first; functions that receive a `PlainConsole` print with it.
"""

import unicodedata
from typing import Any

from rich.console import Console
from rich.text import Text

#: Unicode categories of characters that control a terminal, hide or reorder text, end a line, or are unassigned.
_ESCAPED_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}


class PlainConsole(Console):
    """Console that shows every text literally.

    Square brackets are not markup, and characters that control the terminal or reorder text are escaped.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text literally, with control characters escaped."""
        options |= {"markup": False, "emoji": False, "highlight": False}
        return super().render_str(escape_control_chars(text), **options)


def to_plain_console(console: Console | None) -> PlainConsole:
    """Return a console that prints literally to where another console prints.

    Args:
      console: console of a caller; None for silence.

    Returns:
      A console with the file, width, theme, recording and live displays of `console`.
    """
    if console is None:
        return PlainConsole(quiet=True)
    if isinstance(console, PlainConsole):
        return console

    # The two consoles share their buffers, so a recording of the caller's console holds what is printed here.
    plain_console = PlainConsole()
    vars(plain_console).update(vars(console))
    return plain_console


def escape_control_chars(text: str, keep: str = "") -> str:
    """Return a text with control characters as escape sequences.

    Args:
      text: any characters.
      keep: control characters that stay as they are.
    """
    escaped = []
    for char in text:
        if char not in keep and unicodedata.category(char) in _ESCAPED_CATEGORIES:
            char = char.encode("unicode_escape").decode()
        escaped.append(char)
    return "".join(escaped)
