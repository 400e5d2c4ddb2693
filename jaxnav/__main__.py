"""The `jaxnav` command: `main` imports the module of a sub-command and runs it."""

import difflib
import importlib
import os
import sys

from jaxnav import __version__

COMMANDS = {
    "train": "train a method with and without the layout estimator",
    "eval": "evaluate a run: tables of variants, epsilons and seeds",
    "report": "show a run on one page: tables, curves and replays side by side",
    "log": "show a training log in TensorBoard or Weights & Biases, also while training goes on",
    "export": "export a policy with its model card, also as a program that runs without jaxnav",
    "episode": "draw one evaluation episode, at one or several layout shifts",
    "play": "look for an object yourself, in the terminal, with what an agent perceives",
    "study": "run an experiment: the paper's claims, tables and ablations, or what the experience of a run is worth",
    "scenes": "import scenes, show one as a picture, tell what a file of them holds",
    "table": "print an evaluation as a Markdown table",
}

HELP = "usage: jaxnav COMMAND [OPTIONS]\n\n" + "".join(f"  {name:11} {summary}\n" for name, summary in COMMANDS.items())
NOTES = """
Each has its own --help; --version prints the version.
Compiled programs are kept in ~/.cache/jaxnav/xla for the next command. The environment variable
JAX_COMPILATION_CACHE_DIR names another folder; with JAX_ENABLE_COMPILATION_CACHE=0 none are kept."""

#: Commands that became experiments, with what replaces them.
_FORMER_COMMANDS = {
    "account": "study account --run RUN --without RUN",
    "mixture": "study mixture --run RUN --without RUN",
    "instrument": "study instrument --run RUN",
    "compare": "study table2",
}

#: Exit code if the reader of the output has gone: 128 plus SIGPIPE, as of other programs.
_BROKEN_PIPE = 141


def main(arguments: list[str] | None = None) -> int:
    """Run the command named by the first argument and return its exit code; 2 for an unknown command."""
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
    if name in ("-h", "--help"):
        print(HELP + NOTES)
        return 0
    if name == "--version":
        print(f"jaxnav {__version__}")
        return 0
    if name in _FORMER_COMMANDS:
        print(f"error: jaxnav {name} is jaxnav {_FORMER_COMMANDS[name]} now", file=sys.stderr)
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
