"""The play command: an episode steered by hand, in the terminal."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.live import Live

from jaxnav.cli.console import command_line, exit_code
from jaxnav.errors import InputError
from jaxnav.game.keys import pressed
from jaxnav.game.prepare import prepare
from jaxnav.game.screen import end_screen, look_screen
from jaxnav.game.session import play
from jaxnav.runs.replay import scene_named


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
    """Run the command; return 0, or 2 after bad input."""
    config = command_line(PlayConfig, arguments, "jaxnav play", "Play an episode by hand.")
    return exit_code(lambda console: _play(config, console))


def _play(config: PlayConfig, console: Console) -> None:
    """Play the episode on the screen, then show its map."""
    out = Console(highlight=False)
    with pressed(sys.stdin) as keys:
        if not out.is_terminal:
            raise InputError("play: the output is no terminal; start it in one")
        game = prepare(**dataclasses.asdict(config), console=console)
        with Live(console=out, screen=True, auto_refresh=False) as live:
            ending = play(game, keys, lambda look: live.update(look_screen(game, look), refresh=True))
    scene = scene_named(game.world, game.bank.names[int(game.episode.scene[0])])
    out.print(end_screen(game, ending, scene, out.width))
