"""The scenes commands: import scenes, show one as a picture, tell what a file of them holds."""

import sys

import tyro
from rich.console import Console

from jaxnav.cli.importing import ImportConfig, import_scenes
from jaxnav.cli.showing import ShowConfig, show_scene
from jaxnav.cli.telling import StatsConfig, tell_statistics
from jaxnav.errors import InputError

COMMANDS = {"import": ImportConfig, "show": ShowConfig, "stats": StatsConfig}


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    console = Console(stderr=True, highlight=False)
    arguments = sys.argv[1:] if arguments is None else arguments
    config = tyro.extras.subcommand_cli_from_dict(COMMANDS, args=arguments, prog="jaxnav scenes")
    try:
        match config:
            case ImportConfig():
                import_scenes(config, console)
            case ShowConfig():
                show_scene(config, console)
            case StatsConfig():
                tell_statistics(config, Console(width=120, highlight=False))
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0
