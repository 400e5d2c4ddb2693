"""Run directories with hostile names: `python -m support.path_names` in the folder `tests` trains in each of them.

Each directory is trained twice: the second training has to find the finished run. The parent directory, in which the
command runs, has the name, too.
"""

import contextlib
import io
import os
import sys
import tempfile
from pathlib import Path

from support.commands import contents, train
from support.tiny_run import write_config

#: Names that a shell, a pattern, an address, an escape, a parser or a decoder may take for something else.
NAMES = (
    *("plain", "exp[1]", "[x]", "[!a]", "[]", "[", "]", "a]b[", "{a,b}", "{x}", "{"),
    *("*", "a*", "**", "?", "a?b", "\\", "a\\b", "q\\", "\\\\n", "^", "|", "a|b"),
    *("%", "%20", "%2F", "%s", "#", "a#b", "&", "a&b=c", "!", ";", "@", "+", "=", "<a>"),
    *(":", "a:b", "C:", "gs:", "s3:", "file:", "'", '"', "`", "$HOME", "${x}", "$(x)"),
    *("-x", "--x", "-", " ", " a ", "a b", "\t", "a\nb", "\x01", "\x7f", "~", "~x", "..."),
    *("é", "日本", "\u202e", "😀", os.fsdecode(b"\xff"), os.fsdecode(b"a\xe9b"), "n" * 255, "é" * 127),
)
#: Names that no file system or path can have.
IMPOSSIBLE_NAMES = ("n" * 256, "n" * 700, "é" * 350, "a\0b", "~no_such_user/x")
#: Addresses of other systems are paths, too.
PATHS = ("gs://bucket/run", "s3://bucket/run", "file:///run", "a/../b", "./a//b/")


def try_name(name: str, run_dir: str) -> tuple[list[int], list[str]]:
    """Train twice in a run directory, and return the exit codes and what lies beside the run.

    Args:
      name: name of the working directory.
      run_dir: the run directory, as on the command line. A leading `~` is taken for the home folder, also after `./`,
        so a folder of this name is given by its whole path.
    """
    exit_codes = []
    with tempfile.TemporaryDirectory() as folder:
        config_file = write_config(Path(folder))
        working_dir = Path(folder) / name
        working_dir.mkdir()
        if name.startswith("~"):
            run_dir = str(working_dir / name)
        with contextlib.chdir(working_dir), contextlib.redirect_stdout(io.StringIO()):
            for _ in range(2):
                try:
                    exit_codes.append(train(config_file, run_dir, "--seeds", 1, "--arms", "baseline"))
                except SystemExit as end:  # the parser refuses a word
                    exit_codes.append(end.code)

        # The run holds its log; everything else of the folder was written outside of the run.
        expected_dir = os.path.relpath(os.path.join(working_dir, run_dir), folder)
        strays = []
        for path in contents(Path(folder)):
            if path != config_file.name and not path.startswith(f"{expected_dir}{os.sep}"):
                strays.append(path)
    return exit_codes, strays


def print_table() -> int:
    """Train in every directory, print a line for each, and return the number of faults."""
    num_faults = 0
    attempts = [(name, f"./{name}") for name in NAMES]
    attempts += [("plain", name) for name in (*IMPOSSIBLE_NAMES, *PATHS)]
    for name, run_dir in attempts:
        messages = io.StringIO()
        with contextlib.redirect_stderr(messages):
            exit_codes, strays = try_name(name, run_dir)
        lines = messages.getvalue().splitlines()
        is_resumed = any("resumed after update 4 of 4" in line for line in lines)

        # Possible names are trained and found again, impossible ones are refused in one line.
        if run_dir in IMPOSSIBLE_NAMES:
            num_errors = sum(line.startswith("error: ") for line in lines)
            fault = exit_codes != [2, 2] or num_errors != 2
            outcome = lines[-1][-60:]
        else:
            fault = exit_codes != [0, 0] or not is_resumed
            outcome = "trained, resumed"
        fault = fault or bool(strays)
        num_faults += fault
        label = ascii(run_dir) if len(run_dir) < 40 else f"{run_dir[-1]!a} x {len(run_dir.removeprefix('./'))}"
        print(f"{label:24}", exit_codes, strays, f"FAULT: {lines}" if fault else outcome, sep="  ", flush=True)
    print(f"{num_faults} faults in {len(attempts)} paths")
    return num_faults


if __name__ == "__main__":
    sys.exit(print_table() > 0)
