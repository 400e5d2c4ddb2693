"""The play command: an episode in the terminal, with the reader at the keys."""

import os
import sys

from rich.console import Console
from rich.live import Live

from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.game.config import PlayConfig

DESCRIPTION = "Search for an object yourself, in the terminal: you see only what an agent perceives."


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(_play, lambda: parse_arguments(PlayConfig, arguments, "jaxnav play", DESCRIPTION))


def _play(config: PlayConfig, console: Console) -> None:
    """Play the episode on the screen, then show its map."""
    from jaxnav.game.session import play_game, prepare_game
    from jaxnav.game.terminal import game_screen, read_keys, result_screen

    screen = Console(highlight=False)
    with read_keys(sys.stdin) as keys:
        if not screen.is_terminal:
            raise InputError("play: the output is not a terminal; start the command in a terminal")
        if screen.is_dumb_terminal or not screen.encoding.startswith("utf"):
            terminal = f"TERM={os.environ.get('TERM', '')}, encoding {screen.encoding}"
            raise InputError(f"play: the terminal cannot show the map ({terminal}); give another TERM, or LANG=C.UTF-8")
        game = prepare_game(config, console)
        with Live(console=screen, screen=True, auto_refresh=False) as live:
            result = play_game(game, keys, lambda view: live.update(game_screen(game, view), refresh=True))
    screen.print(result_screen(game, result, screen.width))
