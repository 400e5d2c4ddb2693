"""The training command."""

from jaxnav.cli.console import exit_code
from jaxnav.cli.options import parse
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import train


def main(arguments: list[str] | None = None, prog: str = "jaxnav train") -> int:
    """Run the command and return its exit code."""
    what = "Train a method with and without the layout estimator."
    return exit_code(lambda console: train(parse(RunConfig(), arguments, prog, what), console))
