"""The instrument command: prove the layout dial."""

import tyro

from jaxnav.cli.console import exit_code, result_console
from jaxnav.cli.study import parse_study
from jaxnav.study.instrument import InstrumentConfig, prove_instrument, prove_main_run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code.

    It is 0, also where the proof fails, or 2 after bad input.
    """
    if any(argument.split("=")[0] == "--config" for argument in arguments or []):
        return exit_code(lambda console: prove_main_run(parse_study(arguments), console, result_console()))
    config = tyro.cli(
        tyro.conf.PositionalRequiredArgs[InstrumentConfig],
        args=arguments,
        prog="eval.py instrument",
        description="Prove the dial with a finished run, or `--config FILE` with the main run of a study, trained if "
        "need be.",
    )
    return exit_code(lambda console: prove_instrument(config, console, result_console()))
