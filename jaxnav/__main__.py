"""The `jaxnav` command: `main` imports the module of a sub-command and runs it."""

import difflib
import importlib
import io
import os
import sys

from jaxnav import __version__

COMMANDS = {
    "train": "train policies of a method, without and with layout weights",
    "eval": "evaluate a run, a policy or an agent of yours",
    "sweep": "evaluate many thresholds of sTDE: a table and a figure",
    "study": "run an experiment of the paper, or measure the value of experience",
    "report": "show a run on one HTML page: tables, curves and replays",
    "episode": "draw one evaluation episode",
    "play": "search for an object yourself, in the terminal",
    "scenes": "import scenes, draw one, or print statistics of scenes",
    "export": "export a policy: parameters, or a program that runs without jaxnav",
    "log": "show a training log in TensorBoard or Weights & Biases",
    "list": "list worlds, methods, policies, experiments, benchmarks, settings",
    "completion": "print a script that completes commands and options in your shell",
    "help": "print this help, or the help of a command",
}

HELP = "usage: jaxnav COMMAND [OPTIONS]\n\n" + "".join(f"  {name:11} {summary}\n" for name, summary in COMMANDS.items())
NOTES = """
jaxnav COMMAND --help prints the options of a command.
jaxnav --version prints the version.

Compiled programs are kept in ~/.cache/jaxnav/xla for the next command. Set
JAX_COMPILATION_CACHE_DIR to use another folder, or
JAX_ENABLE_COMPILATION_CACHE=0 to keep none."""

#: Commands of earlier versions, with what replaces them.
_FORMER_COMMANDS = {
    "account": "study account --run RUN --reference RUN",
    "mixture": "study mixture --run RUN --reference RUN",
    "instrument": "study instrument --run RUN",
    "compare": "study table2",
    "table": "eval FILE.json --format markdown",
}

#: Exit code if the reader of the output has gone: 128 plus SIGPIPE, as of other programs.
_BROKEN_PIPE = 141


def main(arguments: list[str] | None = None) -> int:
    """Run the command named by the first argument and return its exit code; 2 for an unknown command."""
    # A stream that was closed, as by `>&-`, is None; then read nothing and print nowhere.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115  (open until the process ends)
    # Characters that an encoding lacks are printed as escapes.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    try:
        try:
            return _dispatch(arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes stdout when it ends, so let that go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE


def _dispatch(arguments: list[str] | None) -> int:
    """Print help or version, or import the command's module and call its entry point."""
    words = sys.argv[1:] if arguments is None else arguments
    name, *command_arguments = words or ["--help"]
    # `jaxnav help COMMAND` is `jaxnav COMMAND --help`.
    if name == "help" and command_arguments:
        name, *command_arguments = [*command_arguments, "--help"]
    if name in ("-h", "--help", "help"):
        print(HELP + NOTES)
        return 0
    if name == "--version":
        print(f"jaxnav {__version__}")
        return 0
    if name in _FORMER_COMMANDS:
        print(f"error: jaxnav {name} was renamed; use jaxnav {_FORMER_COMMANDS[name]}", file=sys.stderr)
        return 2
    if name not in COMMANDS:
        matches = difflib.get_close_matches(name, COMMANDS, n=1)
        advice = f"did you mean {matches[0]!r}?" if matches else f"choose one of {', '.join(COMMANDS)}"
        print(f"error: unknown command {name!r}; {advice}", file=sys.stderr)
        return 2

    # Find methods in the working directory, as `python -m jaxnav` does.
    if "" not in sys.path:
        sys.path.insert(0, "")
    module = importlib.import_module(f"jaxnav.cli.{name}")
    return module.main(command_arguments)


if __name__ == "__main__":
    sys.exit(main())
