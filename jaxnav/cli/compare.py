"""The compare command: methods side by side, with and without the layout."""

from jaxnav.cli.console import exit_code
from jaxnav.cli.options import parse
from jaxnav.study.compare import run_compare
from jaxnav.study.compare_config import CompareConfig, check_compare


def main(arguments: list[str] | None = None, prog: str = "jaxnav compare") -> int:
    """Run the command; return 0, or 2 after bad input."""
    return exit_code(lambda console: run_compare(parse_compare(arguments, prog), console))


def parse_compare(arguments: list[str] | None, prog: str = "jaxnav compare") -> CompareConfig:
    """Parse a comparison: defaults, the configuration of `--config`, options.

    Raises:
      InputError: bad configuration or setting.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    what = "Train and evaluate methods in several worlds, and write their table: Table 2 of the paper, or ablations."
    return parse(CompareConfig(), arguments, prog, what, check_compare)
