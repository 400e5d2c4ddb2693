"""A run directory may have any name: checkpoints are stored nowhere else, or the name is refused at the start.

`python -m support.path_names` in `tests` trains in every one of these directories and prints a table.

Seen to fail: if Orbax gets the folder itself instead of a link, 14 of the names cannot be read or saved; without
expansion of `~`, a folder of this name is created.
"""

import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support.commands import evaluate, refusal, train
from support.path_names import NAMES
from support.refusals import assert_message_names
from support.tiny_run import write_config

import jaxnav
from jaxnav.cli.console import parse_arguments
from jaxnav.cli.eval import EvalConfig
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_yaml
from jaxnav.store import checkpoint
from jaxnav.store.files import expand_home, make_manifest, write_atomic

MANIFEST = make_manifest({})
STATE = {"weights": jnp.arange(3.0)}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_checkpoints_are_stored_in_a_run_directory_of_any_name(name, tmp_path, monkeypatch):
    # The working directory has this name, too.
    working_dir = tmp_path / name
    run_dir = Path(name)
    working_dir.mkdir()
    monkeypatch.chdir(working_dir)

    # The checkpoint that is restored equals the saved one.
    checkpoint.save_checkpoint(run_dir, 1, STATE, MANIFEST)
    restored = checkpoint.restore_checkpoint(run_dir, jax.eval_shape(lambda: STATE), MANIFEST)
    assert restored is not None
    assert (restored.step, restored.damaged) == (1, ())
    assert restored.state["weights"].tolist() == [0.0, 1.0, 2.0]

    # Nothing was written elsewhere.
    assert os.listdir(tmp_path) == [name]
    assert os.listdir(working_dir) == [name]
    assert os.listdir(run_dir) == ["checkpoints"]
    assert os.listdir(run_dir / "checkpoints") == ["1"]


@pytest.mark.slow
def test_names_that_match_each_other_as_patterns_keep_separate_checkpoints(tmp_path):
    step_by_name = {"a*": 1, "ab": 2, "a[b]": 3, "a?": 4}
    for name, step in step_by_name.items():
        checkpoint.save_checkpoint(tmp_path / name, step, STATE, MANIFEST)
    for name, step in step_by_name.items():
        restored = checkpoint.restore_checkpoint(tmp_path / name, jax.eval_shape(lambda: STATE), MANIFEST)
        assert restored is not None
        assert restored.step == step


@pytest.mark.slow
def test_save_checkpoint_refuses_a_temporary_folder_with_a_hostile_name(tmp_path, monkeypatch):
    (tmp_path / "t[1]").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "t[1]"))
    checkpoint.save_checkpoint(tmp_path / "plain", 1, STATE, MANIFEST)
    with pytest.raises(InputError, match=r"TMPDIR: is .*t\[1\].*; give a folder"):
        checkpoint.save_checkpoint(tmp_path / "exp[1]", 1, STATE, MANIFEST)


@pytest.mark.slow
def test_first_checkpoint_is_read_back(tmp_path, monkeypatch):
    right_digests = checkpoint.array_digests(STATE)
    wrong_digests = right_digests | dict.fromkeys(right_digests, "0")
    monkeypatch.setattr(checkpoint, "array_digests", lambda state: stubbed_digests.pop())

    # The digests of the loaded arrays, which are popped second, differ from those of the saved ones.
    stubbed_digests = [wrong_digests, right_digests]
    with pytest.raises(InputError, match="wrong digests of \\['weights'\\]"):
        checkpoint.save_checkpoint(tmp_path / "run", 1, STATE, MANIFEST)

    # Later checkpoints are not read back.
    stubbed_digests = [right_digests]
    checkpoint.save_checkpoint(tmp_path / "run", 2, STATE, MANIFEST)
    assert stubbed_digests == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["n" * 256, "n" * 700, "é" * 350])
def test_train_refuses_a_name_that_is_too_long_in_one_line(name, tmp_path, capsys):
    assert train(write_config(tmp_path), tmp_path / name) == 2
    assert_message_names(refusal(capsys), name, "File name too long")
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


def test_write_atomic_accepts_the_longest_name(tmp_path):
    write_atomic(tmp_path / ("é" * 127), b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["é" * 127]


# Home folders


def test_home_folders_are_expanded_alike_in_every_setting(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    expected = tmp_path / "x"
    assert expand_home("~/x") == expected
    assert check_config(RunConfig(run_dir="~/x", scenes="~/x")).run_dir == expected  # pyright: ignore[reportArgumentType]
    assert parse_arguments(EvalConfig, ["~/x", "--json=~/x"], "eval", "").json == expected

    # YAML settings, in a file in the home folder.
    (tmp_path / "a.yaml").write_text("{run_dir: ~/x, scenes: ~/x, cache: ~/x}")
    config = apply_yaml(RunConfig(), "~/a.yaml")
    assert (config.run_dir, config.scenes, config.cache) == (expected, expected, expected)

    # In an absolute path, `~` is the name of a folder.
    assert expand_home(tmp_path / "~") == tmp_path / "~"


@pytest.mark.parametrize("path", ["~no_such_user/x", "a\0b"])
def test_paths_without_a_meaning_are_refused_in_every_setting(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.yaml").write_text(json.dumps({"run_dir": path}))
    readers = (
        lambda: check_config(RunConfig(run_dir=path)),  # pyright: ignore[reportArgumentType]
        lambda: apply_yaml(RunConfig(), "a.yaml"),
        lambda: jaxnav.Run.open(path),
        lambda: jaxnav.evaluate(path),
        lambda: jaxnav.load_policy(path),
        lambda: jaxnav.make("rooms", scenes=path),
    )
    for reader in readers:
        with pytest.raises(InputError, match=r"(has no home folder; write|zero byte, which no path can; remove)"):
            reader()
    assert evaluate(path) == 2
    capsys.readouterr()
    assert [file.name for file in tmp_path.iterdir()] == ["a.yaml"]


@pytest.mark.exhaustive
@pytest.mark.timeout(900)
def test_a_run_directory_with_brackets_is_trained_resumed_and_evaluated(tmp_path, monkeypatch, capsys):
    name = os.fsdecode(b"exp[1]\\ \xff")
    monkeypatch.chdir(tmp_path)
    config_file = write_config(tmp_path)
    assert train(config_file, Path(name), "--seeds", 1, "--arms", "baseline") == 0
    assert train(config_file, Path(name), "--seeds", 1, "--arms", "baseline") == 0
    assert "resumed after update 4 of 4" in capsys.readouterr().err
    assert evaluate(name, "--episodes", 10) == 0
    assert sorted(os.listdir(tmp_path)) == sorted([name, "tiny.yaml"])
