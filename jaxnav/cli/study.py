"""The study command: put the paper's claims to the test."""

from jaxnav.cli.console import exit_code
from jaxnav.cli.options import parse
from jaxnav.study.config import StudyConfig, check_study
from jaxnav.study.run import run_study


def main(arguments: list[str] | None = None, prog: str = "jaxnav study") -> int:
    """Run the command; return 0, or 2 after bad input."""
    return exit_code(lambda console: run_study(parse_study(arguments, prog), console))


def parse_study(arguments: list[str] | None, prog: str = "jaxnav study") -> StudyConfig:
    """Parse a study: defaults, the configuration of `--config`, options.

    Raises:
      InputError: bad configuration or setting.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    return parse(StudyConfig(), arguments, prog, "Put the paper's claims to the test.", check_study)
