"""The play command: an episode steered by hand, in the terminal."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.live import Live

from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.game.keys import read_keys
from jaxnav.game.prepare import prepare_game
from jaxnav.game.screen import game_screen, result_screen
from jaxnav.game.session import play_game
from jaxnav.runs.evaluate import find_scene


@dataclasses.dataclass(frozen=True)
class PlayConfig:
    """Look for an object yourself, with what an agent perceives.

    Attributes:
      world: generated scenes and rules.
      scenes: scene file to read instead of the world's scenes.
      split: scenes to play in.
      goal: category to look for; default: any.
      seed: of the scenes and of the episode.
      shift: layout shift of the scenes, from 0 to 1.
      policy: folder of an exported policy, or one of the package (`rooms-org`): its advice and its belief are shown.
        Without, the belief begins with what random walks in training scenes see together.
      epsilon: threshold of sTDE in its advice.
    """

    world: Literal["rooms", "apartments", "houses"] = "rooms"
    scenes: Path | None = None
    split: Literal["train", "val", "test"] = "val"
    goal: str | None = None
    seed: int = 0
    shift: float = 0.0
    policy: str | None = None
    epsilon: float = 0.5


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
        game = prepare_game(**dataclasses.asdict(config), console=console)
        with Live(console=screen, screen=True, auto_refresh=False) as live:
            result = play_game(game, keys, lambda view: live.update(game_screen(game, view), refresh=True))

    scene = find_scene(game.world, game.bank.names[int(game.episode.scene[0])])
    screen.print(result_screen(game, result, scene, screen.width))
