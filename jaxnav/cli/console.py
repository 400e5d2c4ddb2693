"""Parts shared by all commands: running one, printing text, parsing options into settings, caching compiled programs.

`run_command` turns the errors of a command into one-line messages and exit codes. `PlainConsole` prints text from files
safely. `parse_config` and `parse_arguments` build dataclasses of settings from a command line, with and without
`--config`.
"""

import argparse
import contextlib
import ctypes
import dataclasses
import functools
import io
import os
import signal
import sys
import typing
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
import yaml
from rich.console import Console
from rich.text import Text
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from jaxnav.errors import InputError, Interrupted
from jaxnav.runs.config_files import CONFIGS, RENAMED_SETTINGS, apply_yaml, parse_setting

Config = TypeVar("Config")

#: Folder of compiled programs, unless JAX is configured with another.
PROGRAM_CACHE_DIR = "~/.cache/jaxnav/xla"

#: Unicode categories of characters that control a terminal, hide or reorder text, end a line, or are unassigned.
_ESCAPED_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
#: Seconds from which a compilation is cached, and its freed memory returned.
_LONG_COMPILATION_S = 0.5


# Running a command


def run_command(command: Callable[[Console], object]) -> int:
    """Run a command and return its exit code.

    Every error is printed as one line. Bad input, files that cannot be read or written, and lack of memory give code 2;
    Ctrl-C and SIGTERM give 128 plus the number of the signal.

    Args:
      command: called with the console for messages, which goes to stderr and never wraps a line.
    """
    console = PlainConsole(stderr=True, soft_wrap=True)

    # Without JAX imported by now, the command compiles nothing.
    if "jax" in sys.modules:
        _enable_program_cache(console)
        _trim_memory_after_compiling()

    try:
        command(console)
    except BrokenPipeError:
        raise  # handled in `__main__`, as nobody reads the output any more
    except Interrupted as interrupt:
        console.print(f"interrupted: {interrupt}; the same command goes on from there", style="yellow")
        return 128 + interrupt.signal
    except KeyboardInterrupt:
        console.print("interrupted: before it was done", style="yellow")
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


def _user_message(error: Exception) -> str | None:
    """Return the message for an error that the user can fix, or None for a bug of the program."""
    match error:
        case InputError():
            return str(error)
        case MemoryError():
            return f"there is not enough memory ({error}); give fewer or smaller scenes, seeds or environments"
        case OSError(strerror=str()):
            return f"{error.filename or 'a file'}: {error.strerror}; mend the path, its permissions or the disk"
    if type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error):
        return "there is not enough memory on the device; give fewer seeds or a smaller ppo.num_envs"
    return None


# Printing


class PlainConsole(Console):
    """Console that shows every text literally, since names may come from files.

    Square brackets are not markup, and characters that control the terminal or reorder text are escaped.
    """

    def __init__(self, **options: Any) -> None:
        """Prepare, with options as of `rich.console.Console`."""
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text with control characters escaped."""
        return super().render_str(escape_control_chars(text), **options)


def make_result_console() -> Console:
    """Return the console for results, 120 columns wide."""
    return PlainConsole(width=120)


def escape_control_chars(text: str, keep: str = "") -> str:
    """Return a text with control characters as escape sequences.

    Args:
      text: any characters.
      keep: control characters that stay as they are.
    """
    escaped = []
    for char in text:
        if char not in keep and unicodedata.category(char) in _ESCAPED_CATEGORIES:
            char = char.encode("unicode_escape").decode()
        escaped.append(char)
    return "".join(escaped)


@contextlib.contextmanager
def escape_parser_output() -> Iterator[None]:
    """Escape everything that a parser prints, and drop its colors.

    Its error messages quote the command line, and its help quotes a configuration file.
    """
    streams = (sys.stdout, sys.stderr)
    buffers = []
    for stream in streams:
        buffers.append(io.TextIOWrapper(io.BytesIO(), stream.encoding, stream.errors, write_through=True))

    try:
        with contextlib.redirect_stdout(buffers[0]), contextlib.redirect_stderr(buffers[1]):
            yield
    finally:
        for stream, buffer in zip(streams, buffers, strict=True):
            buffer.seek(0)
            stream.write(escape_control_chars(buffer.read(), keep="\n"))


# Parsing options


def parse_config(
    default: Config,
    arguments: list[str] | None,
    prog: str,
    description: str,
    check: Callable[[Config], Config] = lambda config: config,
    configs: Mapping[str, Path] = CONFIGS,
) -> Config:
    """Return the settings of a command that has the option `--config`.

    Later sources override earlier ones: `default`, the configuration of `--config`, the other options.

    Args:
      default: settings without any option.
      arguments: the options; None for those of the process.
      prog: name of the command in its help.
      description: of the command, for its help.
      check: validates the settings, and may complete them.
      configs: packaged configurations by name.

    Raises:
      InputError: bad configuration, or an option that has been renamed; names the configuration.
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    # The configuration file sets the defaults, so read it before the options are parsed.
    config_parser = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    config_parser.add_argument("--config")
    namespace, other_arguments = config_parser.parse_known_args(arguments)
    _refuse_renamed(other_arguments)
    if namespace.config is not None:
        default = apply_yaml(default, namespace.config, configs)

    # Wrap the settings beside a field for `--config`, so that the help lists both.
    config_option = tyro.conf.arg(
        metavar="NAME|FILE.yaml",
        help=f"settings to lay over the defaults: a packaged configuration ({', '.join(configs)}) or a YAML file; "
        "the other options override them.",
    )
    config_field = ("config", Annotated[str | None, config_option], None)
    settings_field = ("settings", Annotated[type(default), tyro.conf.arg(name="")], default)
    options_class = dataclasses.make_dataclass("Options", [config_field, settings_field])
    options = parse_arguments(options_class, other_arguments, prog, description, registry=_REGISTRY)
    try:
        return check(options.settings)
    except InputError as error:
        raise InputError(f"{namespace.config}: {error}" if namespace.config else str(error)) from error


def parse_arguments(
    kind: Callable[..., Config], arguments: list[str] | None, prog: str, description: str, **options: Any
) -> Config:
    """Return the settings that a command line gives.

    Args:
      kind: dataclass of the settings.
      arguments: the options; None for those of the process.
      prog: name of the command in its help.
      description: of the command, for its help.
      options: further options of `tyro.cli`.

    Raises:
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    with escape_parser_output():
        return tyro.cli(kind, args=arguments, prog=prog, description=description, **options)


def _refuse_renamed(arguments: Sequence[str]) -> None:
    """Raise an `InputError` for an option of a renamed setting; its message gives the new option."""
    for argument in arguments:
        if not argument.startswith("--"):
            continue
        option = argument.partition("=")[0]
        setting = option.removeprefix("--").replace("-", "_")
        for old, new in RENAMED_SETTINGS.items():
            if f".{setting}".endswith(f".{old}"):
                group, _, name = f"{setting.removesuffix(old)}{new}".rpartition(".")
                raise InputError(f"{option}: unknown option; it is --{group.replace('_', '-')} {name} N now")


_REGISTRY = ConstructorRegistry()


@_REGISTRY.primitive_rule
def _parse_int_mapping(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[dict[str, int]] | None:
    """Make a mapping of numbers one option, also if the configuration file fills it."""
    if info.type != dict[str, int]:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="[NAME INT [NAME INT ...]]",
        instance_from_str=_parse_int_pairs,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=_format_int_pairs,
    )


@_REGISTRY.primitive_rule
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
    if len(words) % 2:
        raise ValueError("give a whole number after each name")
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))


def _format_int_pairs(values: dict[str, int]) -> list[str]:
    words = []
    for name, number in values.items():
        words += [str(name), str(number)]
    return words


# Compiled programs and their memory


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
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LONG_COMPILATION_S)


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
