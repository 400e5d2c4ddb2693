"""What all commands share."""

from collections.abc import Callable

from rich.console import Console

from jaxnav.errors import InputError


def exit_code(command: Callable[[Console], object]) -> int:
    """Run a command and return its exit code.

    The command gets a console to tell of its progress on. The code is 0, or 2 after bad input, told in one line.
    """
    console = Console(stderr=True, highlight=False)
    try:
        command(console)
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def result_console() -> Console:
    """Return the console for a result, 120 columns wide."""
    return Console(width=120, highlight=False)
