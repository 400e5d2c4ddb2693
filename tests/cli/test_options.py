"""The options of the train command: renamed ones, those of the method, the help."""

import dataclasses
import re

import pytest
from support.commands import refusal, train

from jaxnav.cli import train as train_command
from jaxnav.cli.options import parse
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig


@pytest.mark.parametrize("option", ["--sizes.relation-layers", "--sizes.relation_layers"])
@pytest.mark.parametrize("value", [" 2", "=2"])
def test_renamed_options_are_refused_with_their_new_name(tmp_path, capsys, option, value):
    assert train_command.main(["--run-dir", str(tmp_path / "run"), *f"{option}{value}".split()]) == 2
    assert refusal(capsys) == f"error: {option}: unknown option; it is --method-sizes relation_layers N now"
    assert not (tmp_path / "run").exists()


def test_renamed_options_keep_the_group_they_are_nested_in():
    with pytest.raises(InputError, match=r"it is --base\.method-sizes relation_layers N now"):
        parse(RunConfig(), ["--base.sizes.relation-layers", "2"], "study", "")


@pytest.mark.parametrize(
    ("file", "options", "expected"),
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
def test_sizes_of_the_method_are_one_option(tmp_path, file, options, expected):
    path = tmp_path / "config.yaml"
    path.write_text(file)
    assert parse(RunConfig(), ["--config", str(path), *options], "train.py", "").method_sizes == expected


def test_the_help_names_every_setting(capsys):
    with pytest.raises(SystemExit) as exit:
        train_command.main(["--help"])
    assert exit.value.code == 0
    text = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
    for words in ("--method STR how experience is made", "--method-sizes [NAME INT [NAME INT ...]]", "--config FILE"):
        assert words in text
    for field in dataclasses.fields(RunConfig):
        assert f"--{field.name.replace('_', '-')}" in text


def test_a_config_that_does_not_exist_is_refused(tmp_path, capsys):
    for missing in (tmp_path / "none.yaml", "smoek"):
        assert train(missing, tmp_path / "run") == 2
        assert refusal(capsys).startswith(f"error: {missing}: cannot be read (No such file or directory); check the")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("value", [["nonsense"], ["relation_layers"], ["relation_layers", "two"]])
def test_sizes_without_whole_numbers_are_refused(tmp_path, capsys, value):
    with pytest.raises(SystemExit) as exit:
        train_command.main(["--run-dir", str(tmp_path / "run"), "--method-sizes", *value])
    assert exit.value.code == 2
    assert "--method-sizes" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--ppo.gamma", "--seeds", "--layout.setting"])
def test_bad_options_are_refused(tmp_path, capsys, option):
    with pytest.raises(SystemExit) as exit:
        train_command.main(["--run-dir", str(tmp_path / "run"), option, "nonsense"])
    assert exit.value.code == 2
    assert option in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
