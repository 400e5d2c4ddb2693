"""The help of all commands is quick and complete, shows the world's defaults, and is as wide as the terminal."""

import dataclasses
import os
import re
import subprocess
import sys
import typing
from pathlib import Path

import pytest
from support.tiers import params_by_tier

from jaxnav.__main__ import COMMANDS, main
from jaxnav.cli.completion import list_command_types
from jaxnav.cli.console import _read_attribute_docs
from jaxnav.runs.config import RunConfig, fill_world_defaults
from jaxnav.scenes.worlds import WORLDS

#: Packages that take long to import.
SLOW_PACKAGES = ("jax", "flax", "scipy", "optax", "orbax", "matplotlib")
#: Beginnings of descriptions that are parts of a sentence.
FRAGMENT = re.compile(r"(of|in|by|at|that|what|its|how|as|to) ")


def read_help(capsys, *words: str) -> str:
    """Return the help of a command in one line, without boxes."""
    capsys.readouterr()
    with pytest.raises(SystemExit, match="0"):
        sys.exit(main([*words, "--help"]))
    return re.sub(r"[│\s]+", " ", capsys.readouterr().out)


def run_in_new_process(*words: str, columns: str | None = None) -> str:
    """Return the output of a command that runs in a new process."""
    environment = os.environ | ({} if columns is None else {"COLUMNS": columns})
    command = [sys.executable, "-m", "jaxnav", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=60).stdout


def collect_option_types(command_types: dict[str, typing.Any]) -> list[type]:
    """Return the dataclasses of the options of all commands, nested ones included."""
    option_types: list[type] = []
    queue = list(command_types.values())
    while queue:
        candidate = queue.pop()
        if isinstance(candidate, dict):  # a command with further commands
            queue += candidate.values()
        elif dataclasses.is_dataclass(candidate) and candidate not in option_types:
            option_types.append(typing.cast(type, candidate))
            queue += typing.get_type_hints(candidate).values()
    return option_types


# Speed


def test_help_of_every_command_imports_no_slow_package():
    code = """
import sys
from jaxnav.__main__ import COMMANDS, main
command_lines = [["help"]]
for name in COMMANDS:
    command_lines.append([name, "--help"])
command_lines += [["scenes", "import", "--help"], ["train", "--sead"]]
for words in command_lines:
    try:
        main(words)
    except SystemExit:
        pass
print([name for name in sys.argv[1:] if name in sys.modules], file=sys.stderr)
"""
    process = subprocess.run([sys.executable, "-c", code, *SLOW_PACKAGES], capture_output=True, text=True, check=True)
    assert process.stderr.splitlines()[-1] == "[]"


# Descriptions


@pytest.mark.parametrize(
    "option_type", collect_option_types(list_command_types()), ids=lambda option_type: option_type.__name__
)
def test_every_option_has_a_description(option_type):
    if option_type.__name__ in ("Options", "ExperimentOptions"):
        return
    descriptions = _read_attribute_docs(option_type)
    for field in dataclasses.fields(option_type):
        is_group = dataclasses.is_dataclass(typing.get_type_hints(option_type)[field.name])
        assert is_group or field.name in descriptions
        assert not FRAGMENT.match(descriptions.get(field.name, ""))


def test_help_lists_every_command_and_describes_one(capsys):
    text = read_help(capsys)
    for name, summary in COMMANDS.items():
        assert f" {name} {summary} " in text

    # `help` lists the commands, and takes the name of one.
    assert main(["help"]) == 0
    with pytest.raises(SystemExit, match="0"):
        main(["help", "log"])
    assert "usage: jaxnav log " in capsys.readouterr().out
    with pytest.raises(SystemExit, match="0"):
        main(["help", "scenes", "show"])
    assert "usage: jaxnav scenes show " in capsys.readouterr().out
    assert main(["help", "trian"]) == 2


# Defaults


@pytest.mark.parametrize("world", WORLDS)
def test_train_help_shows_the_defaults_of_the_world(world, capsys):
    text = read_help(capsys, "train", "--world", world)
    config = fill_world_defaults(RunConfig(world=world))
    assert f"(default: {WORLDS[world].total_steps})" in text
    for field in dataclasses.fields(config.worlds):
        value = getattr(config.worlds, field.name)
        label = " ".join(value) if isinstance(value, tuple) else str(value)
        option = f"--worlds.{field.name.replace('_', '-')} "
        description = text.partition(option)[2].partition(" --")[0]
        assert f"(default: {label})" in description
    assert "None" not in text


def test_train_help_shows_the_values_of_a_config(tmp_path, capsys):
    config_file = tmp_path / "run.yaml"
    config_file.write_text("{world: houses, seeds: 7, worlds: {num_train: 11}}")
    text = read_help(capsys, "train", "--config", str(config_file))
    for value in ("houses", 7, 11, WORLDS["houses"].counts["val"], WORLDS["houses"].total_steps):
        assert f"(default: {value})" in text


def test_help_leaves_the_settings_of_a_run_as_they_are():
    # A run with the defaults filled in would count as a run of another world, with other files.
    assert fill_world_defaults(RunConfig()) != RunConfig()
    assert RunConfig().worlds.num_train is None


def test_study_help_shows_the_settings_of_the_experiment(capsys):
    text = read_help(capsys, "study", "table2")
    assert "(default: results/paper)" in text
    assert "(default: results/experiment)" in read_help(capsys, "study")


# Width


@pytest.mark.parametrize(("columns", "max_width"), [("1", 40), ("5", 40), ("60", 60), ("500", 100)])
def test_help_has_the_width_of_the_terminal_within_limits(columns, max_width):
    lines = run_in_new_process("train", "--help", columns=columns).splitlines()
    assert max(map(len, lines)) == max_width


def test_help_on_a_terminal_without_unicode_is_readable():
    command = [sys.executable, "-m", "jaxnav", "log", "--help"]
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    output = subprocess.run(command, env=environment, capture_output=True, check=True).stdout.decode("ascii")
    assert "--follow" in output


@pytest.mark.slow
def test_scripts_of_the_repository_have_the_help_of_their_command():
    root = Path(__file__).parents[2]
    for script in ("train", "eval"):
        command = [sys.executable, str(root / f"{script}.py"), "--help"]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert output.startswith(f"usage: {script}.py ")


# Closed streams


#: Commands with a closed stream, and their exit codes.
CLOSED_STREAMS = [("--help >&-", 0), ("log --help >&-", 0), ("log --help 2>&-", 0), ("log 2>&-", 2), ("play <&-", 2)]


@pytest.mark.skipif(os.name != "posix", reason="needs a shell")
@pytest.mark.parametrize(
    ("words", "exit_code"),
    params_by_tier(CLOSED_STREAMS, fast=CLOSED_STREAMS[:1], slow=CLOSED_STREAMS),
)
def test_commands_end_quietly_where_a_stream_is_closed(words, exit_code):
    command = f"{sys.executable} -m jaxnav {words}"
    process = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False, timeout=60)
    assert process.returncode == exit_code
    assert "Traceback" not in process.stderr
