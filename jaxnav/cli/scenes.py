"""The scenes commands: import scenes, show one as a picture, tell what a file of them holds."""

import sys

import tyro

from jaxnav.cli.console import exit_code, result_console
from jaxnav.cli.showing import ShowConfig, show_scene
from jaxnav.cli.telling import StatsConfig, tell_statistics
from jaxnav.scenes.files.importing import ImportConfig, import_scenes

COMMANDS = {"import": ImportConfig, "show": ShowConfig, "stats": StatsConfig}


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    arguments = sys.argv[1:] if arguments is None else arguments
    config = tyro.extras.subcommand_cli_from_dict(COMMANDS, args=arguments, prog="jaxnav scenes")
    if isinstance(config, ImportConfig):
        return exit_code(lambda console: import_scenes(config, console))
    if isinstance(config, ShowConfig):
        return exit_code(lambda console: show_scene(config, console))
    return exit_code(lambda _: tell_statistics(config, result_console()))
