"""Unknown and former commands and options, and bad values, are refused in one line that says how to go on."""

import pytest

from jaxnav.__main__ import main


def read_error(capsys, *words: str) -> str:
    """Run a command that must be refused, and return its message."""
    try:
        exit_code = main([*words])
    except SystemExit as parser_exit:
        exit_code = parser_exit.code
    assert exit_code == 2
    output = capsys.readouterr()
    assert output.out == ""
    (error,) = output.err.splitlines()
    assert error.startswith("error: ")
    assert not set("╭╰│") & set(error)
    return error


@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        (["trian"], "'train'"),
        (["help", "evl"], "'eval'"),
        (["scenes", "shw"], "'show'"),
        (["train", "--sead", "1"], "--seed"),
        (["train", "--sead=1"], "--seed"),
        (["train", "--num-train", "1"], "--worlds.num-train"),
        (["train", "--num_train", "1"], "--worlds.num-train"),
        (["train", "--ppo.gama", "1"], "--ppo.gamma"),
        (["eval", "runs/a", "--epsilom", "1"], "--epsilon"),
        (["study", "table2", "--shift", "1"], "--shifts"),
        (["scenes", "stats", "rooms", "--splt", "val"], "--split"),
        (["report", "runs/a", "--reverence", "runs/b"], "--reference"),
    ],
)
def test_typos_suggest_the_nearest_name(words, suggestion, capsys):
    assert suggestion in read_error(capsys, *words).partition("did you mean ")[2]


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["eval", "--json", "a.json"], ["SUBJECT", "missing"]),
        (["scenes", "import"], ["FORMAT, SOURCE, OUT", "missing"]),
        (["train", "--seeds", "x"], ["--seeds", "'x'", "whole number"]),
        (["train", "--ppo.gamma", "x"], ["--ppo.gamma", "'x'", "a number"]),
        (["train", "--world", "hosues"], ["--world", "hosues", "houses"]),
        (["list", "nothing"], ["nothing", "worlds", "methods"]),
        (["eval", "a", "--form", "residul"], ["--form", "residul", "residual"]),
        (["eval", "a", "b"], ["b", "unexpected"]),
        (["study", "table2", "b"], ["b", "unexpected"]),
        (["train", "--nothing-like-it"], ["--nothing-like-it", "jaxnav train --help"]),
        (["completion", "tcsh"], ["tcsh", "bash"]),
    ],
)
def test_bad_values_are_refused_in_one_line(words, parts, capsys):
    error = read_error(capsys, *words)
    assert all(part in error for part in parts), error


@pytest.mark.parametrize(
    ("words", "replacement"),
    [
        (["table", "a.json"], "jaxnav eval FILE.json --format markdown"),
        (["account", "a", "b"], "jaxnav study account --run RUN --reference RUN"),
        (["compare"], "jaxnav study table2"),
        (["study", "account", "--run", "a", "--without", "b"], "--reference b"),
        (["study", "account", "--run", "a", "--without=b"], "--reference b"),
        (["report", "a", "--beside", "b"], "--reference b"),
        (["study", "mixture", "--hand-over"], "jaxnav study handover"),
        (["train", "--sizes.relation-layers", "2"], "--method-sizes relation_layers"),
    ],
)
def test_former_commands_and_options_name_their_replacement(words, replacement, capsys):
    assert replacement in read_error(capsys, *words)


@pytest.mark.parametrize("key", ["unaware", "without"])
def test_former_keys_of_an_experiment_name_their_replacement(key, tmp_path, capsys):
    path = tmp_path / "experiment.yaml"
    path.write_text(f"{key}: anonymous")
    assert f"{key} was renamed; use reference" in read_error(capsys, "study", str(path))
