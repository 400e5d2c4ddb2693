"""Commands under 21 environments: `python -m support.command_environments` in the folder `tests` prints a table of all.

Every command ends well, or with one line that names what hinders it. An environment consists of variables, where None
stands for one that is not set, and of redirections of the streams.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from support.commands import train
from support.processes import REPOSITORY
from support.tiny_run import write_config

ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "usual": {},
    "64 bits": {"JAX_ENABLE_X64": "1"},
    "NaN": {"JAX_DEBUG_NANS": "1"},
    "no jit": {"JAX_DISABLE_JIT": "1"},
    "no backend": {"JAX_PLATFORMS": "no_such_backend"},
    "no home": {"HOME": None},
    "home that cannot be written": {"HOME": "/proc/nothing"},
    "matplotlib": {"MATPLOTLIBRC": "matplotlibrc"},
    "matplotlib backend": {"MPLBACKEND": "module://no_such"},
    "ASCII": {"PYTHONIOENCODING": "ascii"},
    "C locale": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    "dumb": {"TERM": "dumb"},
    "no terminal": {"TERM": None},
    "one column": {"COLUMNS": "1"},
    "many columns": {"COLUMNS": "100000"},
    "bad columns": {"COLUMNS": "x"},
    "no color": {"NO_COLOR": "1"},
    "color": {"FORCE_COLOR": "1"},
    "optimized": {"PYTHONOPTIMIZE": "2"},
    "no input": {"redirection": "<&-"},
    "no output": {"redirection": ">&- 2>&-"},
}
COMMANDS = {
    "list": ("list", "worlds"),
    "show": ("scenes", "show", "rooms", "--out", "scene.png"),
    "play": ("play",),
    "eval": ("eval", "finished", "--episodes", "2"),
    "train": ("train", "--config", "tiny.yaml", "--run-dir", "run", "--seeds", "1", "--arms", "baseline"),
    "report": ("report", "finished", "--episodes", "20"),
}


class CommandAttempt(NamedTuple):
    """A command that was run in an environment.

    Attributes:
      exit_code: exit code; None if the command did not end in time.
      output: everything that it printed.
      seconds: seconds that it took.
    """

    exit_code: int | None
    output: str
    seconds: float


def run_jaxnav(
    *words: object, redirection: str = "", timeout: float = 300, folder: Path | None = None, **environment: str | None
) -> tuple[int, str]:
    """Run a command in a shell, with variables of the environment, and return exit code and output."""
    command = [sys.executable, "-m", "jaxnav", *map(str, words)]
    shell_line = f'exec "$@" {redirection}'
    variables = {name: value for name, value in {**os.environ, **environment}.items() if value is not None}
    process = subprocess.run(
        ["sh", "-c", shell_line, "sh", *command],
        cwd=folder,
        env=variables | {"PYTHONPATH": str(REPOSITORY)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout,
    )
    return process.returncode, process.stdout + process.stderr


def try_command(environment_name: str, command_name: str, folder: Path, timeout: float = 240) -> CommandAttempt:
    """Run a command in an environment.

    Args:
      environment_name: a key of `ENVIRONMENTS`.
      command_name: a key of `COMMANDS`.
      folder: working directory, with a finished run in `finished` for the commands that read one.
      timeout: seconds after which the command is ended.
    """
    write_config(folder)
    (folder / "matplotlibrc").write_text("text.usetex: True\nsavefig.format: pdf\n")
    start = time.monotonic()
    try:
        exit_code, output = run_jaxnav(
            *COMMANDS[command_name], timeout=timeout, folder=folder, **ENVIRONMENTS[environment_name]
        )
    except subprocess.TimeoutExpired:
        exit_code = None
        output = ""
    return CommandAttempt(exit_code, output, time.monotonic() - start)


def find_fault(environment_name: str, attempt: CommandAttempt, folder: Path) -> str | None:
    """Describe how an attempt breaks the promise; None if it keeps it."""
    if attempt.exit_code is None:
        return "did not end in time"
    if attempt.exit_code not in (0, 2):
        return f"exit code {attempt.exit_code}"
    if "Traceback" in attempt.output:
        return "traceback"
    if attempt.exit_code == 2 and "error: " not in attempt.output and environment_name != "no output":
        return "no error message"
    for picture in folder.rglob("*.png"):
        if not picture.read_bytes().startswith(b"\x89PNG"):
            return f"{picture.name} is no PNG"
    return None


def print_matrix() -> int:
    """Run every command in every environment, print a line for each, and return the number of faults."""
    num_faults = 0
    with tempfile.TemporaryDirectory() as finished_folder:
        finished_dir = Path(finished_folder) / "run"
        assert train(write_config(Path(finished_folder)), finished_dir) == 0
        for environment_name in ENVIRONMENTS:
            for command_name in COMMANDS:
                with tempfile.TemporaryDirectory() as folder:
                    shutil.copytree(finished_dir, Path(folder) / "finished")
                    attempt = try_command(environment_name, command_name, Path(folder), timeout=900)
                    fault = find_fault(environment_name, attempt, Path(folder))

                # The last line of a refusal says why.
                num_faults += fault is not None
                last_line = attempt.output.splitlines()[-1] if attempt.exit_code and attempt.output else ""
                outcome = "well" if fault is None else f"FAULT: {fault}"
                cells = (f"{environment_name:28}", f"{command_name:7}", f"exit {attempt.exit_code}")
                print(*cells, f"{attempt.seconds:5.0f} s", outcome, last_line, sep="  ", flush=True)
    print(f"{num_faults} faults in {len(ENVIRONMENTS)} environments x {len(COMMANDS)} commands")
    return num_faults


if __name__ == "__main__":
    sys.exit(print_matrix() > 0)
