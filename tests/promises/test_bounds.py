"""Sizes are checked before memory is taken, and what is missing is told in one line.

Seen to fail, each planted alone: `largest` without a limit, pickles of any number of parts, lists of any number of
episodes, a console that does not know `MemoryError`, a `jaxnav` that does not know `BrokenPipeError`.
"""

import bz2
import errno
import gzip
import json
import os
import subprocess
import sys
import tracemalloc

import pytest
from support.commands import train
from support.fuzz import KINDS, fuzz
from support.processes import REPOSITORY, run
from support.tiny_run import write_config
from support.tiny_world import BANK

from jaxnav.cli.console import run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import MAX_EPISODES, draw_episodes
from jaxnav.scenes.files.importers.pickled_arrays import read_pickle
from jaxnav.scenes.files.scene_file import max_decompressed_size, read_bytes

MIB = 2**20


def test_read_bytes_refuses_a_gzip_bomb_within_a_memory_limit(tmp_path):
    bomb = tmp_path / "rooms.jsonl.gz"
    with gzip.GzipFile(bomb, "wb", compresslevel=1) as file:
        for _ in range(192):
            file.write(bytes(MIB))
    # 192 MiB in less than one; 64 MiB and one byte are read, and copied once.
    assert bomb.stat().st_size < MIB
    tracemalloc.start()
    with pytest.raises(InputError, match=r"rooms.jsonl.gz: holds more than 67,108,864 bytes; split it"):
        read_bytes(bomb)
    assert tracemalloc.get_traced_memory()[1] < 160 * MIB
    tracemalloc.stop()


def test_max_decompressed_size_grows_with_the_file():
    assert [max_decompressed_size(size) // MIB for size in (0, MIB, 2 * MIB, 100 * MIB)] == [64, 64, 100, 5000]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"N0" * 2**21, "holds more than 1,048,576 parts"),  # pushed and popped, two bytes at a time
        (b"I" + b"1" * 2**27, "holds more than 67,108,864 bytes"),  # one line
    ],
)
def test_read_pickle_refuses_too_many_parts_or_bytes(tmp_path, content, problem):
    path = tmp_path / "maps.pbz2"
    path.write_bytes(bz2.compress(content, 1))
    with pytest.raises(InputError, match=problem):
        read_pickle(path)


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
    error = capsys.readouterr().err
    assert f"{option.removeprefix('--').replace('-', '_')} is {value}; give at most " in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_products_of_sizes_are_capped(tmp_path, capsys):
    config = write_config(tmp_path)
    assert train(config, tmp_path / "run", "--layout.walks", 10**6, "--layout.steps", 10**6) == 2
    assert "layout.walks x layout.steps is 1000000000000; give at most 268,435,456" in capsys.readouterr().err
    assert train(config, tmp_path / "run", "--total-steps", 10**12, "--chunk", 1) == 2
    assert "makes 7,812,500,000 chunks; give a larger chunk" in capsys.readouterr().err  # of 16 x 8 steps
    with pytest.raises(InputError, match=f"--episodes 1000001: give at least 1, and at most {MAX_EPISODES}"):
        draw_episodes(BANK, MAX_EPISODES + 1)


@pytest.mark.parametrize(
    ("error", "last_line"),
    [
        (
            MemoryError("Unable to allocate 6 GiB"),
            "error: there is not enough memory (Unable to allocate 6 GiB); give ",
        ),
        (OSError(errno.ENOSPC, "No space left on device", "a/b"), "error: a/b: No space left on device; mend the path"),
        (OSError(errno.EROFS, "Read-only file system", "a/b"), "error: a/b: Read-only file system; mend the path"),
        (PermissionError(errno.EACCES, "Permission denied", "a"), "error: a: Permission denied; mend the path, its"),
    ],
)
def test_run_command_reports_system_errors_in_one_line(capsys, error, last_line):
    def command(_):
        raise error

    assert run_command(command) == 2
    message = capsys.readouterr().err
    assert message.startswith(last_line)
    assert message.count("\n") == 1


def test_run_command_raises_unexpected_errors():
    def command(_):
        raise KeyError("a bug")

    with pytest.raises(KeyError):
        run_command(command)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        *(pytest.param(words, marks=pytest.mark.slow) for words in (["train", "--help"], ["scenes", "stats", "rooms"])),
    ],
)
def test_command_ends_quietly_on_a_closed_pipe(arguments):
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(
        [sys.executable, "-m", "jaxnav", *arguments], cwd=REPOSITORY, stdout=write, stderr=subprocess.PIPE, check=False
    )
    os.close(write)
    assert b"Traceback" not in ended.stderr
    assert b"Exception ignored" not in ended.stderr
    assert ended.returncode in (1, 141)  # 1 is what rich ends with


@pytest.mark.parametrize("kind", KINDS)
def test_random_input_ends_commands_by_exit_code(kind, tmp_path):
    codes, slowest = fuzz(kind, tmp_path, 15, seed=0)
    assert set(codes) <= {0, 2}, codes
    assert codes[2] > 0
    assert slowest < 10


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_two_hundred_random_inputs_stay_within_time_and_memory(kind):
    """In a process of their own, whose memory is theirs alone; docs/promises.md has the command of more."""
    process = run(["-m", "support.fuzz", kind, 200, 1], PYTHONPATH=REPOSITORY / "tests")
    output, error = process.communicate()
    assert process.returncode == 0, error[-2000:]
    result = json.loads(output.splitlines()[-1])
    print(kind, result)
    assert {code for code, _ in result["codes"]} <= {0, 2}, result
    assert sum(number for _, number in result["codes"]) == 200
    assert result["slowest"] < 10
    assert result["peak"] < 1024
