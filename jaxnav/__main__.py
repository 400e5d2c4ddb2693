"""The jaxnav command."""

import difflib
import importlib
import os
import sys

from jaxnav import __version__

COMMANDS = {
    "train": "train a method with and without the layout estimator",
    "eval": "evaluate a run: tables of variants, epsilons and seeds",
    "account": "say what experience is worth, beside a run of agents without any",
    "mixture": "remove experience where half of the scenes are shifted: what is kept, recovered, known",
    "report": "show a run on one page: tables, curves and replays side by side",
    "log": "show a training log in TensorBoard or Weights & Biases, also while training goes on",
    "export": "export a policy with its model card, also as a program that runs without jaxnav",
    "episode": "draw one evaluation episode, at one or several layout shifts",
    "play": "look for an object yourself, in the terminal, with what an agent perceives",
    "instrument": "prove that the layout shift leaves the difficulty and costs the baseline",
    "study": "put the claims of the paper to the test: runs, results, figures, a document",
    "compare": "compare methods without and with the layout: Table 2 of the paper, ablations",
    "scenes": "import scenes, show one as a picture, tell what a file of them holds",
    "table": "print an evaluation as a Markdown table",
}

HELP = "usage: jaxnav COMMAND [OPTIONS]\n\n" + "".join(f"  {name:11} {what}\n" for name, what in COMMANDS.items())
NOTES = """
Each has its own --help; --version prints the version.
Compiled programs are kept in ~/.cache/jaxnav/xla for the next command. The environment variable
JAX_COMPILATION_CACHE_DIR names another folder; with JAX_ENABLE_COMPILATION_CACHE=0 none are kept."""


#: Exit code where nobody reads the output any more: 128 and SIGPIPE, as of other commands.
_CLOSED = 141


def main(arguments: list[str] | None = None) -> int:
    """Run the command that the first argument names.

    Returns its exit code, 2 for an unknown one.
    """
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is written when Python ends
        return _CLOSED


def _run(arguments: list[str] | None) -> int:
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(HELP + NOTES)
        return 0
    if name == "--version":
        print(f"jaxnav {__version__}")
        return 0
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        mend = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(COMMANDS)}"
        print(f"error: unknown command {name!r}; {mend}", file=sys.stderr)
        return 2
    if "" not in sys.path:
        sys.path.insert(0, "")  # methods of the working directory are found as by `python -m jaxnav`
    return importlib.import_module(f"jaxnav.cli.{name}").main(rest)


if __name__ == "__main__":
    sys.exit(main())
