"""The commands and the example of the README run twice in one folder, without a complaint and without a change.

The commands have the settings of the tiny run and few episodes; all other words are those of the README.
"""

import json
import re
import shlex
from pathlib import Path

import pytest
from support.command_environments import run_jaxnav
from support.commands import contents
from support.importer_inputs.procthor import HOUSE
from support.tiny_run import write_config

README = (Path(__file__).parents[2] / "README.md").read_text()
#: Options that make a command short.
SHORT_OPTIONS = {"eval": "--episodes 20", "sweep": "--episodes 20", "report": "--episodes 20"}
#: Module of the README's `my_module:AGENT`: an agent that walks ahead.
AGENT_MODULE = """
import numpy as np


def AGENT(observations):
    return np.zeros(len(observations["goal"]), int)
"""


def readme_commands():
    """Return the words of each command in the section `Commands`, without `jaxnav` and without comments."""
    section = README.partition("\n## Commands\n")[2].partition("\n## ")[0]
    commands = []
    for line in re.findall(r"^    jaxnav (.*)$", section, re.MULTILINE):
        words = shlex.split(line.replace("small_goals", "tiny.yaml"), comments=True)
        commands.append([*words, *SHORT_OPTIONS.get(words[0], "").split()])
    return commands


def run_readme(folder):
    """Run the commands, each in a process of its own, and return the files that they leave.

    The file of a lock names the process that holds it.
    """
    for words in readme_commands():
        exit_code, output = run_jaxnav(*words, folder=folder)
        assert exit_code == 0, output
        assert "warning" not in output
    return {name: content for name, content in contents(folder).items() if not name.endswith((".lock", ".pyc"))}


def test_readme_has_a_command_of_each_kind():
    names = {words[0] for words in readme_commands()}
    assert {"train", "eval", "sweep", "report", "export", "scenes"} <= names


@pytest.fixture
def readme_folder(tmp_path):
    """A folder with the files that the commands read."""
    write_config(tmp_path)
    (tmp_path / "my_module.py").write_text(AGENT_MODULE)
    (tmp_path / "train.jsonl.gz").write_text("\n".join([json.dumps(HOUSE)] * 10))
    return tmp_path


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_commands_of_the_readme_run(readme_folder):
    files = run_readme(readme_folder)
    assert {"runs/houses/config.json", "homes.jsonl.gz"} < files.keys()


@pytest.mark.exhaustive
@pytest.mark.timeout(900)
def test_commands_of_the_readme_run_twice(readme_folder):
    first_files = run_readme(readme_folder)
    second_files = run_readme(readme_folder)
    changed_files = {name for name in first_files | second_files if first_files.get(name) != second_files.get(name)}
    assert changed_files == set()


@pytest.mark.slow
def test_example_of_the_readme_runs_twice(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    example, *_ = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = {}
    exec(example, names)
    first_output = capsys.readouterr().out
    exec(example, names)
    assert capsys.readouterr().out == first_output != ""
    assert contents(tmp_path) == {}
