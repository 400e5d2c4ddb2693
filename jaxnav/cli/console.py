"""Parts shared by all commands: running one, printing text and tables, parsing options, caching compiled programs.

`run_command` turns the errors of a command into one-line messages and exit codes, and `print_table` fits a table to the
terminal. `parse_config` and `parse_arguments` build dataclasses of settings from a command line, with and without
`--config`.

No module of `jaxnav.cli` imports JAX, Flax or SciPy at its top, so that help, completion and refusals of bad options
take less than a second. A command imports what it runs inside its function.
"""

import argparse
import contextlib
import copy
import ctypes
import dataclasses
import difflib
import functools
import hashlib
import inspect
import io
import operator
import os
import re
import shlex
import shutil
import signal
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
import yaml
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from jaxnav.errors import InputError, Interrupted
from jaxnav.plain_console import PlainConsole, escape_control_chars
from jaxnav.runs.config_files import CONFIGS, RENAMED_SETTINGS, apply_yaml, parse_setting
from jaxnav.store.files import expand_home, write_atomic

Config = TypeVar("Config")

#: Folder of compiled programs, unless JAX is configured with another.
PROGRAM_CACHE_DIR = "~/.cache/jaxnav/xla"
#: Options that print the help.
HELP_OPTIONS = ("-h", "--help")

#: Characters of the boxes in which tyro prints its messages.
_BOX_CHARACTERS = "╭╮╰╯│─"
#: Narrowest width, in columns, of anything that is printed; terminals may be narrower.
_MIN_WIDTH = 40
#: Widest help, in columns; longer lines are hard to read.
_MAX_HELP_WIDTH = 100
#: Width of output that goes to a file or a pipe, in columns, where nothing should be wrapped.
_PIPE_WIDTH = 10_000
#: Seconds from which a compiled program is kept for the next command.
_CACHED_COMPILATION_S = 0.2
#: Seconds from which the memory that a compilation freed is returned.
_LONG_COMPILATION_S = 0.5
#: Longest name of a results file without its endings, and longest part of it, in characters.
_MAX_NAME_LENGTH = 160
_MAX_PART_LENGTH = 40


# Running a command


def run_command(command: Callable[..., object], parse: Callable[[], Any] | None = None, compiles: bool = True) -> int:
    """Run a command and return its exit code.

    Every error is printed as one line. Bad input, files that cannot be read or written, and lack of memory give code 2;
    Ctrl-C and SIGTERM give 128 plus the number of the signal.

    Args:
      command: called with the settings, if `parse` is given, and the console for messages. The console writes to stderr
        and never wraps a line.
      parse: returns the settings, or raises `InputError` or `SystemExit`. JAX is imported after it.
      compiles: whether the command may compile programs with JAX, which are then kept for the next command.
    """
    console = PlainConsole(stderr=True, soft_wrap=True)
    try:
        arguments = (console,) if parse is None else (parse(), console)
        if compiles:
            _prepare_jax(console)
            _enable_program_cache(console)
            _trim_memory_after_compiling()
        command(*arguments)
    except BrokenPipeError:
        raise  # handled in `__main__`, as nobody reads the output any more
    except Interrupted as interrupt:
        console.print(f"interrupted: {interrupt}; run the same command again to continue", style="yellow")
        return 128 + interrupt.signal
    except KeyboardInterrupt:
        console.print("interrupted: the command has not finished", style="yellow")
        return 128 + signal.SIGINT
    except Exception as error:
        message = _user_message(error)
        if message is None:
            raise
        console.print(f"error: {message}", style="red")
        return 2
    return 0


@contextlib.contextmanager
def refuse_unwritable(path: object, remedy: str) -> Iterator[None]:
    """Turn an `OSError` of writing to a path into an `InputError` with a remedy."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); give another {remedy}") from error


def name_evaluation(command: str, split: str, world: str | None, scenes: Path | None, *details: str | None) -> str:
    """Return the name, without an ending, of the file that a command writes by default.

    Results of other settings get another name, so that they never overwrite each other.

    Args:
      command: name of the command.
      split: scenes that are evaluated.
      world: generated world; None for that of the run or policy.
      scenes: scene file; None without one.
      details: texts for other options that change the results; None for options that are not given.
    """
    scenes_part = None if scenes is None else f"scenes-{name_path(scenes)}"  # never the name of a world
    name = "-".join(part for part in (command, world, scenes_part, split, *details) if part is not None)
    return name if len(name) <= _MAX_NAME_LENGTH else f"{name[:_MAX_NAME_LENGTH]}-{_short_digest(name)}"


def name_subject(subject: str) -> str:
    """Return the part of a file name that stands for a policy or an agent: its name, or that of its folder."""
    if os.sep in subject:
        return name_path(Path(subject))
    # A module has no `-`, so `module:AGENT` stays apart from all others; a digest replaces what a file name lacks.
    readable_name = subject.replace(":", "-")
    name = re.sub(r"[^A-Za-z0-9._-]", "_", readable_name)[: _MAX_NAME_LENGTH // 2]
    return name if name == readable_name else f"{name}-{_short_digest(subject)}"


def name_path(path: Path) -> str:
    """Return the part of a file name that stands for a path: the start of its last name, and a digest of the whole."""
    readable_name = re.sub(r"[^A-Za-z0-9._-]", "_", path.name.removesuffix(".gz").removesuffix(".jsonl"))
    return f"{readable_name[:_MAX_PART_LENGTH]}-{_short_digest(os.fspath(path.resolve()))}"


def name_numbers(option: str, numbers: Sequence[float]) -> str:
    """Return the part of a file name that stands for an option with numbers, such as `epsilon0.25-0.5`."""
    numbers_text = "-".join(repr(float(number)).removesuffix(".0") for number in numbers)
    if len(numbers_text) > _MAX_PART_LENGTH:
        numbers_text = f"s-{len(numbers)}-{_short_digest(numbers_text)}"
    return option + numbers_text


def _short_digest(text: str) -> str:
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:8]


def write_latest(command: str, path: Path) -> None:
    """Name a file of results as the newest one of a command, in `latest-COMMAND.txt` next to it."""
    write_atomic(path.with_name(f"latest-{command}.txt"), f"{path.name}\n".encode())


def refuse_folder(path: Path, option: str) -> None:
    """Raise an `InputError` if no file can be written at a path, because it is a folder or lies in a file."""
    if path.is_dir() or not path.name or (path.parent.exists() and not path.parent.is_dir()):
        raise InputError(f"{option} {path}: is a folder or lies in a file; give the name of a file to write")


def _user_message(error: Exception) -> str | None:
    """Return the message for an error that the user can fix, or None for a bug of the program."""
    match error:
        case InputError():
            return str(error)
        case MemoryError():
            return f"there is not enough memory ({error}); give fewer or smaller scenes, seeds or environments"
        case OSError(strerror=str()):
            return f"{error.filename or 'a file'}: {error.strerror}; check the path, its permissions and the disk"
    if isinstance(error, RuntimeError | AssertionError) and not _has_jax_backend():
        platforms = os.environ.get("JAX_PLATFORMS", "")
        return f"JAX_PLATFORMS={platforms}: JAX finds no such device; unset it, give cpu, or install the package for it"
    if type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error):
        return "there is not enough memory on the device; give fewer seeds or a smaller ppo.num_envs"
    return None


def _has_jax_backend() -> bool:
    """True where JAX finds a device, or is not in use."""
    if "jax" not in sys.modules:
        return True
    try:
        return bool(sys.modules["jax"].devices())
    except (RuntimeError, AssertionError):  # JAX raises either, some without a message
        return False


# Printing


def make_result_console() -> Console:
    """Return the console for results on stdout: as wide as the terminal, or too wide to wrap in a file or a pipe."""
    console = PlainConsole()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        return PlainConsole(width=_PIPE_WIDTH)
    return PlainConsole(width=max(_MIN_WIDTH, console.width))


def print_table(console: Console, table: Table, num_key_columns: int = 1) -> None:
    """Print a table so that no cell wraps and no word of a header breaks.

    If the table is wider than the console, its columns are printed as several tables, one below the other. Each repeats
    the key columns.

    Args:
      console: result console.
      table: cells are strings or `Text`.
      num_key_columns: number of columns at the left that name a row.
    """
    # Width of each column with its header in one line, and with a line for each word of the header.
    full_widths = []
    narrow_widths = []
    for column in table.columns:
        cell_widths = [_measure(console, cell).maximum for cell in column.cells]
        header = _measure(console, column.header)
        full_widths.append(max([header.maximum, *cell_widths]))
        narrow_widths.append(max([header.minimum, *cell_widths]))

    # Names of rows may wrap where the key columns would take more than half of the console.
    key_widths = dict(enumerate(full_widths[:num_key_columns]))
    name_width = console.width // 2 - sum(full_widths[1:num_key_columns])
    key_widths[0] = min(full_widths[0], max(_MIN_WIDTH // 2, name_width))

    # Add columns to a part of the table for as long as they fit.
    parts = [dict(key_widths)]
    for index in range(num_key_columns, len(table.columns)):
        candidate = parts[-1] | {index: narrow_widths[index]}
        is_too_wide = _measure(console, _select_columns(table, candidate)).maximum > console.width
        if is_too_wide and len(parts[-1]) > num_key_columns:
            parts.append(dict(key_widths))
        parts[-1][index] = narrow_widths[index]

    # Where there is room, headers have one line.
    for part in parts:
        for index in list(part)[num_key_columns:]:
            candidate = part | {index: full_widths[index]}
            if _measure(console, _select_columns(table, candidate)).maximum <= console.width:
                part[index] = full_widths[index]
        console.print(_select_columns(table, part))


def _measure(console: Console, renderable: Any) -> Measurement:
    """Measure the width of something that is printed, without the limit of the console."""
    return Measurement.get(console, console.options.update(width=_PIPE_WIDTH), renderable)


def _select_columns(table: Table, widths: Mapping[int, int]) -> Table:
    """Return a table with some of the columns.

    Args:
      table: the whole table.
      widths: width of each column to keep, by its index.
    """
    selected = copy.copy(table)
    selected.columns = []
    selected.rows = []
    cells_by_column = []
    for index, width in sorted(widths.items()):
        column = table.columns[index]
        selected.add_column(column.header, justify=column.justify, width=width)
        cells_by_column.append(list(column.cells))

    for row_index, row in enumerate(table.rows):
        row_cells = [column_cells[row_index] for column_cells in cells_by_column]
        selected.add_row(*row_cells, style=row.style, end_section=row.end_section)
    return selected


@contextlib.contextmanager
def escape_parser_output(arguments: Sequence[str]) -> Iterator[None]:
    """Print what a parser prints without colors, with control characters escaped, and errors without boxes.

    The error messages of a parser quote the command line, and its help quotes a configuration file.

    Args:
      arguments: the command line. The help has the width of the terminal, within limits.
    """
    # Help is drawn with the characters that stdout has; the box of an error is removed, so it can have any.
    is_help = any(option in arguments for option in HELP_OPTIONS)
    streams = (sys.stdout, sys.stderr)
    buffers = []
    for stream in streams:
        encoding = stream.encoding if is_help else "utf-8"
        buffers.append(io.TextIOWrapper(io.BytesIO(), encoding, stream.errors, write_through=True))

    # The parser reads its width from COLUMNS. An error is wide enough for one line.
    columns_before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(_help_width() if is_help else _PIPE_WIDTH)

    try:
        with contextlib.redirect_stdout(buffers[0]), contextlib.redirect_stderr(buffers[1]):
            yield
    finally:
        if columns_before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = columns_before
        for buffer in buffers:
            buffer.seek(0)
        help_text, error_text = (escape_control_chars(buffer.read(), keep="\n") for buffer in buffers)
        streams[0].write(_wrap_long_lines(help_text))
        streams[1].write(_unbox_error(error_text))


def _help_width() -> int:
    """Width of a help text: that of the terminal, within limits."""
    return min(max(_MIN_WIDTH, shutil.get_terminal_size().columns), _MAX_HELP_WIDTH)


def _wrap_long_lines(text: str) -> str:
    """Wrap usage and description of a help text, which tyro prints in one line each; boxes have the right width."""
    lines = []
    for line in text.splitlines():
        is_long = len(line) > _help_width() and not line.startswith(" ")
        lines += textwrap.wrap(line, _help_width(), break_on_hyphens=False) if is_long else [line]
    return "".join(f"{line}\n" for line in lines)


def _unbox_error(text: str) -> str:
    """Return the message in a box of tyro as one line; other text stays as it is."""
    lines = text.splitlines()
    if not (lines and lines[0].startswith("╭")):
        return text

    # The first line holds a title; after a ruler, tyro repeats the description of the option.
    message_lines = []
    for line in lines[1:]:
        content = line.strip(f"{_BOX_CHARACTERS} ")
        if not content:
            break
        message_lines.append(content)

    # Missing arguments are listed as name and description, in turn.
    missing_in = message_lines and re.fullmatch("Missing from (.+):", message_lines[0])
    if missing_in:
        return f"error: {', '.join(message_lines[1::2])}: missing; {missing_in[1]} --help describes the arguments\n"
    return f"error: {' '.join(message_lines).removeprefix('Error parsing ')}\n"


# Parsing options


def parse_config(
    default: Config,
    arguments: list[str] | None,
    prog: str,
    description: str,
    check: Callable[[Config], Config] = lambda config: config,
    configs: Mapping[str, Path] = CONFIGS,
    is_positional: bool = False,
    complete_help: Callable[[Config, Sequence[str]], Config] = lambda config, arguments: config,
) -> Config:
    """Return the settings of a command that has the option `--config`.

    Later sources override earlier ones: `default`, the configuration of `--config`, the other options.

    Args:
      default: settings without any option.
      arguments: the options; None for those of the process.
      prog: name of the command in its help.
      description: description of the command in its help.
      check: validates the settings, and may complete them.
      configs: packaged configurations by name.
      is_positional: True where the configuration is the first argument instead of the option `--config`.
      complete_help: returns the settings whose values the help shows as defaults, from those of the configuration and
        the command line.

    Raises:
      InputError: bad configuration, or an option that has been renamed; names the configuration.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    # The configuration file sets the defaults, so read it before the options are parsed.
    words = list(sys.argv[1:] if arguments is None else arguments)
    if is_positional and words and not words[0].startswith("-"):
        words = ["--config", *words]
    config_parser = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    config_parser.add_argument("--config")
    namespace, other_words = config_parser.parse_known_args(words)
    if namespace.config is not None:
        default = apply_yaml(default, namespace.config, configs)

    if any(option in other_words for option in HELP_OPTIONS):
        default = complete_help(default, other_words)
    options_class = make_options_class(type(default), configs, is_positional)
    options = parse_arguments(
        options_class, other_words, prog, description, default=options_class(namespace.config, default)
    )
    if options.config != namespace.config:
        raise InputError(f"{options.config}: unexpected argument; {prog} --help lists all options")
    try:
        return check(options.settings)
    except InputError as error:
        raise InputError(f"{namespace.config}: {error}" if namespace.config else str(error)) from error


def make_options_class(settings_type: type, configs: Mapping[str, Path] = CONFIGS, is_positional: bool = False) -> type:
    """Return a dataclass with the fields `config` and `settings`, for a configuration and the options of a type.

    Args:
      settings_type: dataclass of the settings.
      configs: packaged configurations by name.
      is_positional: True where the configuration is the first argument instead of the option `--config`.
    """
    purpose = "experiment to run" if is_positional else "configuration that replaces the defaults"
    text = f"{purpose}: {', '.join(configs)}, or a YAML file. Options override its settings."
    config_option = tyro.conf.arg(metavar="NAME|FILE.yaml", help=text)
    annotation = Annotated[str | None, config_option]
    if is_positional:
        annotation = Annotated[annotation, tyro.conf.Positional]
    config_field = ("config", annotation, None)
    settings_field = ("settings", Annotated[settings_type, tyro.conf.arg(name="")], settings_type())
    return dataclasses.make_dataclass("Options", [config_field, settings_field])


def parse_arguments(
    kind: Callable[..., Config], arguments: list[str] | None, prog: str, description: str, **options: Any
) -> Config:
    """Return the settings that a command line gives.

    Args:
      kind: dataclass of the settings.
      arguments: the options; None for those of the process.
      prog: name of the command in its help.
      description: description of the command in its help.
      options: further options of `tyro.cli`.

    Raises:
      InputError: an option that has been renamed.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    _refuse_renamed(words)
    with escape_parser_output(words):
        config, unknown_words = tyro.cli(
            kind,
            args=words,
            prog=prog,
            description=description,
            return_unknown_args=True,
            registry=REGISTRY,
            **options,
        )
    if unknown_words:
        _exit_for_unknown(unknown_words[0], list_option_names(kind), prog)
    return config


def list_option_names(kind: Any, prefix: str = "") -> list[str]:
    """Return the names of all options of a dataclass, without `--`, with those of nested dataclasses."""
    names = []
    for name, annotation in typing.get_type_hints(kind).items():
        is_settings = name == "settings" and kind.__name__ == "Options"
        option = prefix if is_settings else f"{prefix}{name.replace('_', '-')}"
        if dataclasses.is_dataclass(annotation):
            names += list_option_names(annotation, option if is_settings else f"{option}.")
        else:
            names.append(option)
    return names


def _exit_for_unknown(word: str, names: Sequence[str], prog: str) -> NoReturn:
    """Print the nearest options to an unknown one, and exit with code 2."""
    typed = word.partition("=")[0].lstrip("-").replace("_", "-")
    if not word.startswith("-"):
        problem = f"error: {word}: unexpected argument"
        matches = []
    else:
        problem = f"error: {word.partition('=')[0]}: unknown option"
        matches = _find_similar_options(typed, names)

    advice = f"{prog} --help lists all options"
    if matches:
        advice = f"did you mean {' or '.join(f'--{name}' for name in matches)}?"
    print(escape_control_chars(f"{problem}; {advice}"), file=sys.stderr)
    raise SystemExit(2)


def _find_similar_options(typed: str, names: Sequence[str]) -> list[str]:
    """Return at most three names of options that are similar to a misspelled one, the most similar first."""
    # The group of an option is easily forgotten, as in `num-train` for `worlds.num-train`.
    name_by_ending = {name.rpartition(".")[2]: name for name in names}
    matches = difflib.get_close_matches(typed, names, n=2, cutoff=0.75)
    if typed in name_by_ending:
        matches.append(name_by_ending[typed])
    if not matches:
        matches = difflib.get_close_matches(typed, names, n=1)
    if not matches:
        matches = [name_by_ending[ending] for ending in difflib.get_close_matches(typed, name_by_ending, n=1)]
    return list(dict.fromkeys(matches))


#: Options of earlier versions, with the options that replace them.
_FORMER_OPTIONS = {"--without": "--reference", "--beside": "--reference", "--unaware": "--reference"}
#: Options of earlier versions, with the commands that replace them.
_FORMER_FLAGS = {"--hand-over": "jaxnav study handover --run RUN --reference RUN"}


def _refuse_renamed(arguments: Sequence[str]) -> None:
    """Raise an `InputError` for an option that was renamed; its message gives the new option."""
    for index, argument in enumerate(arguments):
        option, has_value, value = argument.partition("=")
        if not option.startswith("--"):
            continue
        if not has_value:
            value = next(iter(arguments[index + 1 : index + 2]), "RUN")

        problem = f"{option}: was renamed; use"
        name = option.replace("_", "-")
        if name in _FORMER_OPTIONS:
            raise InputError(f"{problem} {_FORMER_OPTIONS[name]} {value}")
        if name in _FORMER_FLAGS:
            raise InputError(f"{problem} {_FORMER_FLAGS[name]}")
        setting = option.removeprefix("--").replace("-", "_")
        for old, new in RENAMED_SETTINGS.items():
            if f".{setting}".endswith(f".{old}"):
                group, _, new_name = f"{setting.removesuffix(old)}{new}".rpartition(".")
                raise InputError(f"{problem} --{group.replace('_', '-')} {new_name} N")


#: Rules by which tyro turns dataclasses into options.
REGISTRY = ConstructorRegistry()


@REGISTRY.struct_rule
def describe_fields(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Describe the fields of a dataclass by its docstring; those without a default become positional arguments."""
    # Generic dataclasses are internal to tyro.
    if not dataclasses.is_dataclass(info.type) or getattr(info.type, "__parameters__", ()):
        return None
    descriptions = _read_attribute_docs(info.type)
    plain_annotations = typing.get_type_hints(info.type)
    annotations = typing.get_type_hints(info.type, include_extras=True)

    fields = []
    for field in dataclasses.fields(info.type):
        if isinstance(info.default, info.type):
            default = getattr(info.default, field.name)
        elif field.default is not dataclasses.MISSING:
            default = field.default
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        else:
            default = tyro.MISSING
        option = tyro.conf.arg(help_behavior_hint=_format_default)
        annotation: Any = Annotated[annotations[field.name], option]
        # Required values are arguments without an option, such as RUN in `jaxnav eval RUN`; commands stay commands.
        plain_annotation = plain_annotations[field.name]
        is_command = any(map(dataclasses.is_dataclass, typing.get_args(plain_annotation) or (plain_annotation,)))
        if default is tyro.MISSING and not is_command:
            metavar = tyro.conf.arg(metavar=field.name.upper().replace("_", "-"))
            annotation = Annotated[annotation, tyro.conf.Positional, metavar]
        fields.append(StructFieldSpec(field.name, annotation, default, descriptions.get(field.name)))
    return StructConstructorSpec(info.type, tuple(fields))


def _read_attribute_docs(kind: type) -> dict[str, str]:
    """Return the descriptions of the attributes in the docstrings of a class and its bases."""
    descriptions = {}
    for base in reversed(kind.__mro__):
        section = inspect.cleandoc(base.__dict__.get("__doc__") or "").partition("\nAttributes:\n")[2]
        for entry in re.split(r"\n(?=  \w)", f"\n{section}")[1:]:
            names, _, description = entry.partition(":")
            for name in names.split(","):
                descriptions[name.strip()] = " ".join(description.split())
    return descriptions


def _format_default(label: str) -> str:
    """Format the default of an option in its help; a missing default is described in words."""
    # A single value needs no quotes to be read.
    words = shlex.split(label)
    label = words[0] if len(words) == 1 else label
    return "" if label in ("", "None", "{}") else f"(default: {label})"


@REGISTRY.primitive_rule
def _parse_optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Accept None without showing it in the help."""
    if typing.get_origin(info.type) not in (typing.Union, types.UnionType):
        return None
    members = [member for member in typing.get_args(info.type) if member is not type(None)]
    if len(members) == len(typing.get_args(info.type)):
        return None
    value_type = functools.reduce(operator.or_, members)
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(value_type, info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return None

    def parse(words: list[Any]) -> Any:
        # Before an unknown option, tyro passes an empty list as the value of an argument that is not given.
        if words in (["None"], [[]]):
            return None
        for word in words:
            # Choices of an optional argument without an option are not checked by tyro.
            if spec.choices is not None and word not in spec.choices:
                raise ValueError(f"{word!r} is unknown; choose from {', '.join(spec.choices)}")
        return spec.instance_from_str(words)

    return dataclasses.replace(
        spec,
        instance_from_str=parse,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )


@REGISTRY.primitive_rule
def _parse_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | PrimitiveConstructorSpec[float] | None:
    """Refuse text that is no number in plain words."""
    if info.type not in (int, float):
        return None
    number_type, description = (int, "a whole number") if info.type is int else (float, "a number")

    def parse(words: list[str]) -> int | float:
        try:
            return number_type(words[0])
        except ValueError as error:
            raise ValueError(f"{words[0]!r} is not {description}") from error

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=number_type.__name__.upper(),
        instance_from_str=parse,
        is_instance=lambda value: isinstance(value, int | number_type) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


@REGISTRY.primitive_rule
def _parse_path(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
    """Expand the home folder in paths; a shell does not in `--run-dir=~/run`."""
    if info.type is not Path:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: expand_home(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    )


@REGISTRY.primitive_rule
def _parse_int_mapping(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[dict[str, int]] | None:
    """Make a mapping of numbers one option, also if the configuration file fills it."""
    if info.type != dict[str, int]:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME INT ...]",
        instance_from_str=_parse_int_pairs,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=_format_int_pairs,
    )


@REGISTRY.primitive_rule
def _parse_nested_mapping(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[dict[str, Any]] | None:
    """Make any other mapping one option, whose value is YAML."""
    if typing.get_origin(info.type) is not dict or info.type == dict[str, int]:
        return None

    def format_yaml(value: dict[str, Any]) -> list[str]:
        return [yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6).strip()]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="YAML",
        instance_from_str=lambda words: parse_setting(words[0], info.type),
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=format_yaml,
    )


def _parse_int_pairs(words: Sequence[str]) -> dict[str, int]:
    try:
        return dict(zip(words[::2], map(int, words[1::2]), strict=True))
    except ValueError as error:
        raise ValueError("give a whole number after each name") from error


def _format_int_pairs(values: dict[str, int]) -> list[str]:
    words = []
    for name, number in values.items():
        words += [str(name), str(number)]
    return words


# Compiled programs and their memory


def _prepare_jax(console: Console) -> None:
    """Set the modes of JAX that a command needs.

    Raises:
      InputError: an environment variable of JAX has an impossible value.
    """
    try:
        import jax
    except ValueError as error:
        # JAX names the variable, or its setting in lower case.
        for name, value in os.environ.items():
            if name.startswith("JAX_") and name.lower() in str(error).lower():
                raise InputError(f"{name}={value}: is no value that JAX takes; unset it") from error
        raise

    jax.config.update("jax_enable_x64", False)  # policies compute in float32
    # Not compiled, a command that takes seconds takes hours.
    if jax.config.values["jax_disable_jit"]:
        jax.config.update("jax_disable_jit", False)
        console.print("warning: JAX_DISABLE_JIT is ignored: commands compile; use jaxnav from Python", style="yellow")


def _enable_program_cache(console: Console) -> None:
    """Keep compiled programs on disk for the next command, unless JAX is configured otherwise."""
    import jax

    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] is not None or not settings["jax_enable_compilation_cache"]:
        return

    try:
        folder = Path(PROGRAM_CACHE_DIR).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:
        console.print(f"warning: compiled programs are not kept: {error}", style="yellow")
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _CACHED_COMPILATION_S)


@functools.cache
def _trim_memory_after_compiling() -> None:
    """Return freed memory to the system after each long compilation.

    glibc would keep up to half a gigabyte. With other C libraries, nothing is done.
    """
    import jax

    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if malloc_trim is None:
        return

    def on_duration(event: str, duration_secs: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and duration_secs > _LONG_COMPILATION_S:
            malloc_trim(0)

    jax.monitoring.register_event_duration_secs_listener(on_duration)
