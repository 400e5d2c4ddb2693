"""The train and eval commands, called in this process, and checks of what commands leave and print."""

from pathlib import Path

import pytest

from jaxnav.cli import eval as eval_command
from jaxnav.cli import train as train_command


def train(config_file: Path | str, run_dir: Path | str, *options: object) -> int:
    """Run the train command, and return its exit code."""
    return train_command.main(["--config", str(config_file), "--run-dir", str(run_dir), *map(str, options)])


def evaluate(*options: object) -> int:
    """Run the eval command, and return its exit code."""
    return eval_command.main([*map(str, options)])


def refusal(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the last line of stderr, which must be a refusal."""
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    return error


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file below a folder, by relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
