"""The table command: an evaluation's JSON as a Markdown table."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.cli.console import command_line, exit_code, printable
from jaxnav.errors import InputError
from jaxnav.evaluation.report import FORMAT
from jaxnav.evaluation.report_tables import markdown_table


@dataclasses.dataclass(frozen=True)
class TableConfig:
    """Choose an evaluation to print.

    Attributes:
      file: JSON that an evaluation wrote.
    """

    file: Annotated[Path, tyro.conf.Positional]


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    config = command_line(TableConfig, arguments, "jaxnav table", "Print an evaluation as Markdown.")
    return exit_code(lambda _: print(printable(markdown_table(_read(config.file)), kept="\n"), end=""))


def _read(path: Path) -> dict:
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: no evaluation can be read from it ({error}); give a file that an evaluation wrote"
        ) from error
    if not isinstance(report, dict) or report.get("format") != FORMAT:
        raise InputError(f"{path}: is no evaluation of format {FORMAT}; give a file that an evaluation wrote")
    return report
