"""The table command: print the JSON file of an evaluation as a Markdown table."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.cli.console import escape_control_chars, parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.report import REPORT_FORMAT, markdown_table
from jaxnav.store.files import WRITTEN_BY_0_1


@dataclasses.dataclass(frozen=True)
class TableConfig:
    """Choose an evaluation to print.

    Attributes:
      file: JSON that an evaluation wrote.
    """

    file: Annotated[Path, tyro.conf.Positional]


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    config = parse_arguments(TableConfig, arguments, "jaxnav table", "Print an evaluation as Markdown.")
    return run_command(lambda _: _print_table(config.file))


def _print_table(path: Path) -> None:
    text = markdown_table(_read_report(path))
    print(escape_control_chars(text, keep="\n"), end="")


def _read_report(path: Path) -> dict:
    """Return the report in a JSON file, or raise an `InputError` if the file is no evaluation."""
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: no evaluation can be read from it ({error}); give a file that an evaluation wrote"
        ) from error
    if not isinstance(report, dict) or report.get("format") != REPORT_FORMAT or "compilations" not in report:
        raise InputError(f"{path}: is no evaluation of format {REPORT_FORMAT}; give a file that an evaluation wrote")
    # Reports have notes since version 0.2.
    if "notes" not in report:
        raise InputError(f"{path}: {WRITTEN_BY_0_1}")
    return report
