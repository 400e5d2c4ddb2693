"""The instrument command: prove the layout dial."""

import sys

from jaxnav.cli.console import exit_code, result_console
from jaxnav.cli.options import parse_options
from jaxnav.cli.study import parse_study
from jaxnav.study.instrument import InstrumentConfig, prove_instrument, prove_main_run

WHAT = "Prove the dial with a finished run, or with the main run of the study of `--config`, trained if need be."


def main(arguments: list[str] | None = None, prog: str = "jaxnav instrument") -> int:
    """Run the command and return its exit code.

    It is 0, also where the proof fails, or 2 after bad input.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if any(argument.split("=")[0] == "--config" for argument in arguments):
        return exit_code(lambda console: prove_main_run(parse_study(arguments, prog), console, result_console()))
    config = parse_options(InstrumentConfig, arguments, prog, WHAT)
    return exit_code(lambda console: prove_instrument(config, console, result_console()))
