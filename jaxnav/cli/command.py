"""What all commands share: what they say, and how bad input ends them."""

from collections.abc import Callable

from rich.console import Console

from jaxnav.errors import InputError


def exit_code(command: Callable[[Console], None]) -> int:
    """Run a command, which tells of its progress on the console it gets: 0, or 2 after bad input, told in one line."""
    console = Console(stderr=True, highlight=False)
    try:
        command(console)
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def result_console() -> Console:
    """The console for a command's result, 120 columns wide wherever it goes."""
    return Console(width=120, highlight=False)
