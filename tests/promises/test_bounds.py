"""Sizes are capped before memory is allocated, and a lack of memory or disk is a one-line error.

Seen to fail, each planted alone: `largest` without a limit, pickles of any number of parts, lists of any number of
episodes, a console that does not know `MemoryError`, a `jaxnav` that does not know `BrokenPipeError`.
"""

import bz2
import dataclasses
import errno
import functools
import gzip
import json
import os
import subprocess
import sys
import tracemalloc
import typing

import numpy as np
import pytest
from support.commands import train
from support.fuzz import KINDS, fuzz
from support.processes import REPOSITORY, start_python
from support.refusals import assert_message_names
from support.tiny_run import write_config
from support.tiny_world import BANK

from jaxnav.cli.console import run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import MAX_EPISODES, draw_episodes
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_yaml
from jaxnav.scenes.files.importers.pickled_arrays import read_pickle
from jaxnav.scenes.files.scene_file import max_decompressed_size, read_bytes

MIB = 2**20


def test_read_bytes_refuses_a_gzip_bomb_within_a_memory_limit(tmp_path):
    # 192 MiB of zeros in less than one.
    gzip_bomb = tmp_path / "rooms.jsonl.gz"
    with gzip.GzipFile(gzip_bomb, "wb", compresslevel=1) as file:
        for _ in range(192):
            file.write(bytes(MIB))
    assert gzip_bomb.stat().st_size < MIB

    # 64 MiB and one byte are read, and copied once.
    tracemalloc.start()
    with pytest.raises(InputError, match=r"rooms.jsonl.gz: .*67,108,864 bytes; split it"):
        read_bytes(gzip_bomb)
    _, peak_memory = tracemalloc.get_traced_memory()
    assert peak_memory < 160 * MIB
    tracemalloc.stop()


def test_max_decompressed_size_grows_with_the_file():
    assert [max_decompressed_size(size) // MIB for size in (0, MIB, 2 * MIB, 100 * MIB)] == [64, 64, 100, 5000]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "limit"),
    [
        (b"N0" * 2**21, "1,048,576 parts"),  # pushed and popped, two bytes at a time
        (b"I" + b"1" * 2**27, "67,108,864 bytes"),  # one line
    ],
)
def test_read_pickle_refuses_too_many_parts_or_bytes(tmp_path, content, limit):
    pickle_file = tmp_path / "maps.pbz2"
    pickle_file.write_bytes(bz2.compress(content, 1))
    with pytest.raises(InputError, match=limit):
        read_pickle(pickle_file)


@pytest.mark.parametrize(
    "option",
    [
        "--seeds",
        "--total-steps",
        "--chunk",
        "--save-every",
        "--validations",
        "--val-episodes",
        "--layout.walks",
        "--ppo.num-envs",
        "--ppo.rollout",
        "--sizes.hidden",
        "--worlds.num-train",
        "--worlds.step-limit",
    ],
)
def test_train_caps_every_size_before_writing(tmp_path, capsys, option):
    value = 10**18
    assert train(write_config(tmp_path), tmp_path / "run", option, value) == 2
    message = capsys.readouterr().err
    field_name = option.removeprefix("--").replace("-", "_")
    assert_message_names(message, f"{field_name} is {value}", "give at most ")
    assert message.count("\n") == 1
    assert not (tmp_path / "run").exists()


# Numbers in settings


def list_numeric_settings(group_class, prefix=""):
    """Yield the name and type of every setting that holds a number, nested groups included."""
    types = typing.get_type_hints(group_class)
    for field in dataclasses.fields(group_class):
        field_type = types[field.name]
        if dataclasses.is_dataclass(field_type):
            yield from list_numeric_settings(field_type, f"{prefix}{field.name}.")
        elif {int, float} & {field_type, *typing.get_args(field_type)}:
            yield prefix + field.name, field_type


ABSURD_NUMBERS = ("1" + 23 * "0", "-1" + 23 * "0", "1" + 400 * "0", "1" + 5000 * "0", "1.0e+308")


@pytest.mark.parametrize(("name", "field_type"), list(list_numeric_settings(RunConfig)))
def test_absurd_numbers_are_refused_in_one_line(name, field_type, tmp_path):
    is_float = float in (field_type, *typing.get_args(field_type))
    for number in ABSURD_NUMBERS:
        # Write the number into its groups, such as `{ppo: {clip: 1.0e+308}}`.
        text = number
        for part in reversed(name.split(".")):
            text = f"{{{part}: {text}}}"
        (tmp_path / "a.yaml").write_text(text)

        message = None
        config = RunConfig(run_dir=tmp_path / "run")
        try:
            config = check_config(apply_yaml(config, tmp_path / "a.yaml"))
        except InputError as error:
            message = str(error)

        # Only numbers that are no counts may be so large, and they stay finite in the networks.
        if message is None:
            assert is_float
            assert np.isfinite(np.float32(functools.reduce(getattr, name.split("."), config)))
        else:
            # YAML itself reads no number of several thousand digits.
            assert_message_names(message, name.rpartition(".")[2] if len(number) < 4000 else "a.yaml: not valid YAML")
            assert "\n" not in message


def test_products_of_sizes_are_capped(tmp_path, capsys):
    config_file = write_config(tmp_path)
    run_dir = tmp_path / "run"
    assert train(config_file, run_dir, "--layout.walks", 10**6, "--layout.steps", 10**6) == 2
    walk_parts = ("layout.walks x layout.steps is 1000000000000", "give at most 268,435,456")
    assert_message_names(capsys.readouterr().err, *walk_parts)

    # Chunks of one update of 16 x 8 steps.
    assert train(config_file, run_dir, "--total-steps", 10**12, "--chunk", 1) == 2
    assert_message_names(capsys.readouterr().err, "7,812,500,000 chunks", "give a larger chunk")

    with pytest.raises(InputError, match=f"--episodes 1000001: .*at most {MAX_EPISODES}"):
        draw_episodes(BANK, MAX_EPISODES + 1)


@pytest.mark.parametrize(
    ("error", "named_parts"),
    [
        (MemoryError("Unable to allocate 6 GiB"), ["error: ", "memory", "6 GiB", "give "]),
        (OSError(errno.ENOSPC, "No space left on device", "a/b"), ["error: a/b: ", "No space left on device", "check"]),
        (OSError(errno.EROFS, "Read-only file system", "a/b"), ["error: a/b: ", "Read-only file system", "check"]),
        (PermissionError(errno.EACCES, "Permission denied", "a"), ["error: a: ", "Permission denied", "check"]),
    ],
)
def test_run_command_reports_system_errors_in_one_line(capsys, error, named_parts):
    def raise_error(_):
        raise error

    assert run_command(raise_error) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert_message_names(message, *named_parts)
    assert message.count("\n") == 1


def test_run_command_raises_unexpected_errors():
    def raise_key_error(_):
        raise KeyError("a bug")

    with pytest.raises(KeyError):
        run_command(raise_key_error)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        pytest.param(["train", "--help"], marks=pytest.mark.slow),
        pytest.param(["scenes", "stats", "rooms"], marks=pytest.mark.slow),
    ],
)
def test_command_ends_quietly_on_a_closed_pipe(arguments):
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "jaxnav", *arguments]
    process = subprocess.run(command, cwd=REPOSITORY, stdout=write_end, stderr=subprocess.PIPE, check=False)
    os.close(write_end)
    assert b"Traceback" not in process.stderr
    assert b"Exception ignored" not in process.stderr
    assert process.returncode in (1, 141)  # rich ends with 1


# Random input


@pytest.mark.parametrize("kind", KINDS)
def test_random_input_ends_commands_by_exit_code(kind, tmp_path):
    exit_codes, slowest_s = fuzz(kind, tmp_path, 15, seed=0)
    assert set(exit_codes) <= {0, 2}, exit_codes
    assert exit_codes[2] > 0
    assert slowest_s < 10


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_two_hundred_random_inputs_stay_within_time_and_memory(kind):
    """The inputs have a process, and so a peak memory, of their own; docs/promises.md has the command for more."""
    process = start_python(["-m", "support.fuzz", kind, 200, 1], PYTHONPATH=REPOSITORY / "tests")
    output, error = process.communicate()
    assert process.returncode == 0, error[-2000:]
    result = json.loads(output.splitlines()[-1])
    print(kind, result)
    assert {code for code, _ in result["codes"]} <= {0, 2}, result
    assert sum(number for _, number in result["codes"]) == 200
    assert result["slowest"] < 10
    assert result["peak"] < 1024
