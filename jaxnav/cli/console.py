"""What all commands share."""

import contextlib
import ctypes
import functools
import io
import os
import signal
import sys
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import tyro
from rich.console import Console
from rich.text import Text

from jaxnav.errors import InputError, Interrupted

Config = TypeVar("Config")

#: Where compiled programs are kept, unless JAX has been told another folder.
PROGRAMS = "~/.cache/jaxnav/xla"

#: Unicode categories of what controls a terminal, hides or turns text, ends a line, or is no character.
_HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
_LONG_S = 0.5  # of a compilation that is worth the effort


def exit_code(command: Callable[[Console], object]) -> int:
    """Run a command and return its exit code.

    The command gets a console to tell of its progress on, where each message is a line, however long. What ends it is
    told in one: bad input, a file that cannot be read or written and a lack of memory with code 2, Ctrl-C and SIGTERM
    with 128 and the signal's number.
    """
    console = PlainConsole(stderr=True, soft_wrap=True)
    if "jax" in sys.modules:  # otherwise the command compiles nothing
        _keep_programs(console)
        _give_memory_back()
    try:
        command(console)
    except BrokenPipeError:
        raise  # nobody reads the result any more; see `__main__`
    except KeyboardInterrupt as end:
        number = end.signal if isinstance(end, Interrupted) else signal.SIGINT
        how = f"{end}; the same command goes on from there" if isinstance(end, Interrupted) else "before it was done"
        console.print(f"interrupted: {how}", style="yellow")
        return 128 + number
    except Exception as error:
        if (problem := _problem(error)) is None:
            raise
        console.print(f"error: {problem}", style="red")
        return 2
    return 0


def _problem(error: Exception) -> str | None:
    """Return what a user can mend; None for a mistake of the program."""
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


class PlainConsole(Console):
    """Show every text as it is: a name may come from a file.

    Brackets are no markup, and characters that control a terminal or turn the order of letters are shown by number.
    """

    def __init__(self, **options: Any) -> None:
        """Prepare, with options as of `rich.console.Console`."""
        super().__init__(highlight=False, markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text, made harmless."""
        return super().render_str(printable(text), **options)


def printable(text: str, kept: str = "") -> str:
    """Return a text whose control characters are shown by number.

    Args:
      text: of any characters.
      kept: control characters that stay.
    """
    return "".join(
        each if each in kept or unicodedata.category(each) not in _HIDDEN else each.encode("unicode_escape").decode()
        for each in text
    )


def command_line(
    kind: Callable[..., Config], arguments: list[str] | None, prog: str, description: str, **options: Any
) -> Config:
    """Return the settings that a command line gives.

    Args:
      kind: dataclass of the settings.
      arguments: the options; None for those of the process.
      prog: the command, as the help names it.
      description: of the command, for its help.
      options: more of `tyro.cli`.

    Raises:
      SystemExit: with code 2 after a bad option, 0 after --help.
    """
    with harmless():
        return tyro.cli(kind, args=arguments, prog=prog, description=description, **options)


@contextlib.contextmanager
def harmless() -> Iterator[None]:
    """Show what a parser prints as text, without colours.

    Refusals quote the command line, and the help quotes a configuration file.
    """
    streams = (sys.stdout, sys.stderr)
    pages = [io.TextIOWrapper(io.BytesIO(), each.encoding, each.errors, write_through=True) for each in streams]
    try:
        with contextlib.redirect_stdout(pages[0]), contextlib.redirect_stderr(pages[1]):
            yield
    finally:
        for stream, page in zip(streams, pages, strict=True):
            page.seek(0)
            stream.write(printable(page.read(), kept="\n"))


def result_console() -> Console:
    """Return the console for a result, 120 columns wide."""
    return PlainConsole(width=120)


def _keep_programs(console: Console) -> None:
    """Keep compiled programs on disk for the next command.

    JAX's own settings count: another folder, and whether anything is kept.
    """
    import jax

    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] is not None or not settings["jax_enable_compilation_cache"]:
        return
    try:
        folder = Path(PROGRAMS).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"{folder} cannot be written")
    except (OSError, RuntimeError) as error:
        console.print(f"warning: compiled programs are not kept: {error}", style="yellow")
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LONG_S)


@functools.cache
def _give_memory_back() -> None:
    """Give the system back what each long compilation has freed.

    glibc keeps it, up to half a gigabyte. Other C libraries are left alone.
    """
    import jax

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is None:
        return

    def give_back(event: str, duration_secs: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and duration_secs > _LONG_S:
            trim(0)

    jax.monitoring.register_event_duration_secs_listener(give_back)
