"""Progress of long activities on a console."""

import contextlib
import threading
from collections.abc import Iterator

from rich.console import Console
from rich.text import Text

#: Seconds after which an activity is worth a line in a file or pipe.
_LINE_DELAY = 3.0


@contextlib.contextmanager
def show_activity(console: Console, text: str) -> Iterator[None]:
    """Show an activity: at once as a spinner on a terminal, elsewhere as a line once it has taken three seconds.

    Args:
      console: console for progress; a quiet one shows nothing.
      text: the activity, such as `compiling 20 scenes`.
    """
    if console.is_terminal:
        with console.status(Text(text)):
            yield
        return
    line_timer = threading.Timer(_LINE_DELAY, console.print, args=(Text(f"{text} ..."),))
    line_timer.daemon = True
    line_timer.start()
    try:
        yield
    finally:
        line_timer.cancel()
