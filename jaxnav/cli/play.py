"""The play command: an episode steered by hand, in the terminal."""

import sys

from rich.console import Console
from rich.live import Live

from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.game.session import PlayConfig, play_game, prepare_game
from jaxnav.game.terminal import game_screen, read_keys, result_screen


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    config = parse_arguments(PlayConfig, arguments, "jaxnav play", "Play an episode by hand.")
    return run_command(lambda console: _play(config, console))


def _play(config: PlayConfig, console: Console) -> None:
    """Play the episode on the screen, then show its map."""
    screen = Console(highlight=False)
    with read_keys(sys.stdin) as keys:
        if not screen.is_terminal:
            raise InputError("play: the output is no terminal; start it in one")
        game = prepare_game(config, console)
        with Live(console=screen, screen=True, auto_refresh=False) as live:
            result = play_game(game, keys, lambda view: live.update(game_screen(game, view), refresh=True))
    screen.print(result_screen(game, result, screen.width))
