"""Write docs/commands.md and docs/commands_train.md from the help of the commands.

python docs/write_commands.py

A test compares the committed pages with what this script would write.
"""

import contextlib
import io
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jaxnav.__main__ import COMMANDS, main

DOCS = Path(__file__).parent
INTRODUCTION = """\
# Commands

Every command with its options, as `jaxnav COMMAND --help` prints them. The [options of `jaxnav train`][train] have
their own page. [Python calls of the commands](reference_calls.md) lists the call behind each command.

[train]: commands_train.md
"""
TRAIN_INTRODUCTION = """\
# Options of `jaxnav train`
"""
TRAIN_SECTION = "The [options of `jaxnav train`](commands_train.md) are the settings of a run."
HELP_SECTION = "`jaxnav help` lists the commands; `jaxnav help COMMAND` prints the help of a command."
#: Commands whose help lists commands of their own.
GROUPS = {"scenes": ("import", "show", "stats")}
#: Width of the help, in columns; at larger widths, boxes stand side by side.
WIDTH = 100


class Option(NamedTuple):
    """One option of a command.

    Attributes:
      name: as it is typed, with its values.
      text: its description.
      default: its default; empty if there is none.
    """

    name: str
    text: str
    default: str


#: Stands for the settings of `jaxnav train` among the options of `jaxnav study`.
BASE_OPTION = Option("--base.SETTING VALUE", "any [option of `jaxnav train`](commands_train.md), for all runs.", "")


def write_pages() -> dict[str, str]:
    """Return the text of each page by its file name."""
    lines = [INTRODUCTION, "| command | purpose |", "| --- | --- |"]
    for name, summary in COMMANDS.items():
        lines.append(f"| [`jaxnav {name}`](#jaxnav-{name}) | {summary} |")

    for name in COMMANDS:
        lines += ["", f"## jaxnav {name}", ""]
        if name == "help":
            lines.append(HELP_SECTION)
        elif name == "train":
            lines += [*describe_command(read_help(name), with_options=False), "", TRAIN_SECTION]
        elif name in GROUPS:
            for subcommand in GROUPS[name]:
                lines += [f"### jaxnav {name} {subcommand}", "", *describe_command(read_help(name, subcommand)), ""]
            lines.pop()
        else:
            lines += describe_command(read_help(name))

    train_lines = [TRAIN_INTRODUCTION, *describe_command(read_help("train"))]
    return {"commands.md": "\n".join(lines) + "\n", "commands_train.md": "\n".join(train_lines) + "\n"}


def read_help(*words: str) -> str:
    """Return the help of a command."""
    buffer = io.BytesIO()
    columns_before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(WIDTH)
    try:
        # The encoding decides how boxes are drawn.
        output = io.TextIOWrapper(buffer, encoding="utf-8", write_through=True)
        with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
            main([*words, "--help"])
    finally:
        del os.environ["COLUMNS"]
        if columns_before is not None:
            os.environ["COLUMNS"] = columns_before
    return buffer.getvalue().decode()


def describe_command(text: str, with_options: bool = True) -> list[str]:
    """Return the section of a command: description, usage, and a list of options for each group."""
    usage, _, rest = text.partition("\n\n")
    description, _, boxes = rest.partition("╭─")
    usage = re.sub(r"^usage: |\[-h\] ", "", usage).strip()
    lines = [*indent_code(description), "", "```text", usage, "```"]
    if not with_options:
        return lines

    for title, box in read_boxes("╭─" + boxes):
        options = [option for option in read_options(box) if option.name != "-h, --help"]
        if usage.startswith("jaxnav study"):
            options = [option for option in options if not option.name.startswith("--config")]  # it is NAME
        group = title.removesuffix("options").strip()
        if group == "base":
            options = [BASE_OPTION]
        elif group.startswith("base."):
            continue
        elif group not in ("", "positional arguments"):
            lines += ["", f"## Group `{group}`", "", *read_group_description(box)]
        lines.append("")
        for option in options:
            default = f" Default: `{option.default}`." if option.default else ""
            lines.append(f"- `{option.name}`: {option.text}{default}")
    return lines


def read_boxes(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the title and the lines of each box of a help text."""
    title = ""
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith("╭"):
            title, lines = line.strip("╭─╮ "), []
        elif line.startswith("╰"):
            yield title, lines
        elif line.startswith("│"):
            lines.append(line.strip("│").removeprefix(" ").rstrip())


def read_group_description(lines: list[str]) -> list[str]:
    """Return the lines above the ruler of a box."""
    rulers = [index for index, line in enumerate(lines) if line.startswith("─")]
    return lines[: rulers[0]] if rulers else []


def read_options(lines: list[str]) -> Iterator[Option]:
    """Yield the options in the lines of a box, where further lines of an option are indented."""
    entries: list[list[str]] = []
    for line in lines[len(read_group_description(lines)) :]:
        if line.startswith(" ") and entries:
            entries[-1].append(line.strip())
        elif line and not line.startswith("─"):
            entries.append(re.split(r"\s{2,}", line, maxsplit=1))

    for name, *text_lines in entries:
        # Lines break after the comma of a large number.
        text = re.sub(r"(\d,) (?=\d{3}\b)", r"\1", " ".join(text_lines))
        text = text.replace("(required)", "").strip()
        match = re.search(r"\s*\(default: (.*)\)$", text)
        default = " ".join(shlex.split(match[1])) if match else ""
        text = text[: match.start()] if match else text
        yield Option(shorten_values(name), text, default)


def shorten_values(name: str) -> str:
    """Return an option with its values, without the brackets of repeated ones."""
    name = re.sub(r"\[(\S+) \[\1 \.\.\.\]\]", r"\1 ...", name)
    return name.replace("|", " or ")


def indent_code(text: str) -> list[str]:
    """Return the lines of a description; indented lines become code."""
    return [f"    {line.strip()}" if line.startswith("  ") else line for line in text.strip().splitlines()]


if __name__ == "__main__":
    for file_name, page in write_pages().items():
        (DOCS / file_name).write_text(page, encoding="utf-8")
