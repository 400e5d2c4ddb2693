"""The options of the train command: renamed options, options of the method, configurations and the help."""

import dataclasses
import re
import runpy
from pathlib import Path

import pytest
from support.commands import refusal, train

from jaxnav.__main__ import main
from jaxnav.cli import train as train_command
from jaxnav.cli.console import parse_config
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import CONFIGS, apply_yaml

PRESETS = ["belief", "long", "paper", "paper_small", "paper_vtnet", "small_goals", "smoke", "wide"]


@pytest.mark.parametrize("option", ["--sizes.relation-layers", "--sizes.relation_layers"])
@pytest.mark.parametrize("value", [" 2", "=2"])
def test_train_names_the_new_name_of_a_renamed_option(tmp_path, capsys, option, value):
    assert train_command.main(["--run-dir", str(tmp_path / "run"), *f"{option}{value}".split()]) == 2
    assert refusal(capsys) == f"error: {option}: was renamed; use --method-sizes relation_layers N"
    assert not (tmp_path / "run").exists()


def test_renamed_option_keeps_its_nested_group():
    with pytest.raises(InputError, match=r"use --base\.method-sizes relation_layers N"):
        parse_config(RunConfig(), ["--base.sizes.relation-layers", "2"], "study", "")


@pytest.mark.parametrize(
    ("config_text", "options", "expected"),
    [
        ("", ["--method-sizes", "relation_layers", "2"], {"relation_layers": 2}),
        ("method_sizes: {relation_layers: 3}", [], {"relation_layers": 3}),
        ("method_sizes: {relation_layers: 3}", ["--method-sizes", "relation_layers", "2"], {"relation_layers": 2}),
        (
            "method_sizes: {relation_layers: 3}",
            ["--method-sizes", "a", "1", "b", "2", "--seeds", "1"],
            {"a": 1, "b": 2},
        ),
        ("method_sizes: {relation_layers: 3}", ["--method-sizes"], {}),
    ],
)
def test_method_sizes_option_replaces_or_extends_the_config(tmp_path, config_text, options, expected):
    path = tmp_path / "config.yaml"
    path.write_text(config_text)
    config = parse_config(RunConfig(), ["--config", str(path), *options], "train.py", "")
    assert config.method_sizes == expected


def test_train_help_names_every_setting(capsys):
    with pytest.raises(SystemExit) as exit_info:
        train_command.main(["--help"])
    assert exit_info.value.code == 0
    text = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
    for option_help in ("--method STR ", "--method-sizes [NAME INT ...]", "--config NAME|FILE.yaml "):
        assert option_help in text
    for field in dataclasses.fields(RunConfig):
        assert f"--{field.name.replace('_', '-')}" in text


def test_train_lists_the_packaged_configs_for_a_missing_one(tmp_path, capsys):
    remedy = f"give {', '.join(PRESETS)} or a file"
    for missing_config in (tmp_path / "none.yaml", "smoek"):
        assert train(missing_config, tmp_path / "run") == 2
        assert refusal(capsys) == f"error: {missing_config}: no such configuration; {remedy}"
    assert not (tmp_path / "run").exists()


def test_config_option_accepts_a_packaged_name_or_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "smoke").write_text("seeds: 4")
    assert list(CONFIGS) == PRESETS

    def parse_seeds(config_option):
        return parse_config(RunConfig(), ["--config", config_option], "train.py", "").seeds

    # A packaged name takes precedence over a file; a path with a folder is always a file.
    assert parse_seeds("smoke") == 1
    assert parse_seeds("./smoke") == 4
    assert parse_seeds(str(CONFIGS["smoke"])) == 1


def test_example_config_is_valid():
    (example_path,) = (Path(__file__).parents[2] / "configs").glob("*.yaml")
    config = check_config(apply_yaml(RunConfig(), example_path))
    assert config.seeds == 5
    assert config not in (RunConfig(), apply_yaml(RunConfig(), "smoke"))


@pytest.mark.parametrize(("command", "first_name"), [("train", "belief"), ("study", "ablations")])
def test_command_help_lists_the_packaged_configurations(capsys, command, first_name):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
    assert text.startswith(f"usage: jaxnav {command} ")
    assert "NAME|FILE.yaml " in text
    assert f": {first_name}, " in text


@pytest.mark.parametrize(
    ("script", "usage"),
    [
        ("train.py", "usage: train.py "),
        ("eval.py", "usage: eval.py "),
    ],
)
def test_script_help_names_the_script(monkeypatch, capsys, script, usage):
    monkeypatch.setattr("sys.argv", [script, "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(Path(__file__).parents[2] / script), run_name="__main__")
    assert capsys.readouterr().out.startswith(usage)


@pytest.mark.parametrize("value", [["nonsense"], ["relation_layers"], ["relation_layers", "two"]])
def test_method_sizes_option_refuses_values_without_integers(tmp_path, capsys, value):
    with pytest.raises(SystemExit) as exit_info:
        train_command.main(["--run-dir", str(tmp_path / "run"), "--method-sizes", *value])
    assert exit_info.value.code == 2
    assert "--method-sizes" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--ppo.gamma", "--seeds", "--layout.setting"])
def test_train_names_options_of_wrong_type(tmp_path, capsys, option):
    with pytest.raises(SystemExit) as exit_info:
        train_command.main(["--run-dir", str(tmp_path / "run"), option, "nonsense"])
    assert exit_info.value.code == 2
    assert option in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
