"""Shards of scenes on disk: content, kills, errors and damage."""

import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from support.commands import contents
from support.corridors import TASK, Corridors, FaultyCorridors, GatedCorridors, build
from support.scenes import CATEGORIES

from jaxnav.errors import InputError
from jaxnav.scenes.tables import shards as module
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Rules, Task

ARRAYS = ("ahead", "rows", "best_length", "goal_distance", "first_cell", "num_cells", "goals", "num_goals")


def times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def copied_code(tmp_path, monkeypatch):
    """A copy of the code of the scenes, in place of it."""
    code = tmp_path / "code"
    shutil.copytree(module._SOURCE, code, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(module, "_SOURCE", code)
    return code


def needed_code(code, *missing):
    """What modules import of the scenes, directly or not, and the data beside them."""
    covered, missing = set(), list(missing)
    while missing:
        name = missing.pop()
        covered.add(name)
        covered |= {path.relative_to(code).as_posix() for path in (code / name).parent.glob("*.yaml")}
        imported = re.findall(r"^ *from jaxnav\.scenes\.([\w.]+) import", (code / name).read_text(), re.MULTILINE)
        missing += {f"{module_name.replace('.', '/')}.py" for module_name in imported} - covered
    return covered


# What is in them


@pytest.mark.parametrize("without", [(), (1, 4, 5)])
def test_shards_end_to_end_are_the_bank_of_all_scenes(tmp_path, without):
    corridors = Corridors(without=without)
    shards, bank = build(tmp_path, corridors), compile_bank([corridors[i] for i in range(len(corridors))], TASK)
    # Seven scenes in shards of two at most: (0), (1, 2), (3, 4) and (5, 6).
    assert shards.counts == ((1, 1, 1, 1) if without else (1, 2, 2, 2))
    starts = np.cumsum([0] + [len(shard.ahead) for shard in shards], dtype=np.int32)
    for field in ARRAYS:
        arrays = [getattr(shard, field) for shard in shards]
        if field in ("ahead", "first_cell"):  # global cells
            arrays = [array + start for array, start in zip(arrays, starts, strict=False)]
        np.testing.assert_array_equal(np.concatenate(arrays), getattr(bank, field), err_msg=field, strict=True)
    for field in ("names", "room_types"):
        assert sum((getattr(shard, field) for shard in shards), ()) == getattr(bank, field)
    assert shards.skipped == bank.skipped == tuple(f"corridor-{i}" for i in without)
    assert {shard.task for shard in shards} == {shards.task} == {TASK}


def test_arrays_are_memory_mapped_and_the_sizes_are_the_greatest(tmp_path):
    shards = build(tmp_path)
    for field in ARRAYS:
        array = getattr(shards[0], field)
        assert isinstance(array, np.memmap), field
        assert not array.flags.writeable
    # Corridors of 4, 5, 6, 7, 8, 4 and 5 rows have 7, 9, 11, 13, 15, 7 and 9 cells: 7, 20, 28 and 16 in the shards.
    assert [len(shard.ahead) for shard in shards] == [7, 20, 28, 16]
    assert (shards.num_cells, shards.num_scenes) == (28, 2)


def test_a_shard_without_a_goal_is_left_out_and_a_bank_without_one_refused(tmp_path):
    shards = build(tmp_path, Corridors(count=6, without=(2, 3)))
    assert (shards.counts, shards.skipped) == ((2, 2), ("corridor-2", "corridor-3"))
    assert [shard.names[0] for shard in shards] == ["corridor-0", "corridor-4"]
    with pytest.raises(InputError, match=r"none of the 3 scenes has a reachable goal: .* Book, Chair, Fridge"):
        build(tmp_path, Corridors(count=3, without=(0, 1, 2), identity="bare"))


# Where they are


def test_several_workers_write_the_same_bytes_and_report_each_shard(tmp_path):
    reports = []
    one = build(tmp_path / "one")
    two = build(tmp_path / "two", workers=2, report=lambda *numbers: reports.append(numbers))
    assert contents(one.folder) == contents(two.folder)
    assert len(contents(one.folder)) == 4 * 9  # shards of eight arrays and the texts
    assert reports == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_whatever_the_shards_follow_from_is_in_their_folder(tmp_path, monkeypatch):
    code = copied_code(tmp_path, monkeypatch) / "lattice.py"
    folder = build(tmp_path).folder
    assert build(tmp_path).folder == folder
    others = [
        build(tmp_path, Corridors(identity="others")),
        build(tmp_path, task=Task(CATEGORIES, rules=Rules(success_distance=1.25))),
        build(tmp_path, shard_scenes=3),
    ]
    code.write_text("# changed")
    others.append(build(tmp_path))
    assert len({folder, *(shards.folder for shards in others)}) == 5


def test_their_folder_follows_from_the_code_that_makes_them_alone(tmp_path, monkeypatch):
    code = copied_code(tmp_path, monkeypatch)
    key = module._cache_key(Corridors(), TASK, 2)
    needed = needed_code(code, "tables/shards.py")
    assert {"tables/compile.py", "worlds.py", "generate/rooms.yaml", "files/scene_file.py"} <= needed
    changes = set()
    for path in [path for path in code.rglob("*.*") if path.is_file()]:
        content = path.read_text()
        path.write_text(f"{content}\n# changed\n")
        if module._cache_key(Corridors(), TASK, 2) != key:
            changes.add(path.relative_to(code).as_posix())
        path.write_text(content)
    assert changes == needed
    assert not any("importers" in name or "__init__" in name for name in changes)


def test_only_what_is_missing_is_compiled(tmp_path):
    made, reports = [], []

    class Watched(Corridors):
        def __getitem__(self, index):
            made.append(index)
            return super().__getitem__(index)

    shards = build(tmp_path, Watched())
    assert made == list(range(7))
    before, before_times = contents(shards.folder), times(shards.folder)
    shutil.rmtree(shards.paths[1])
    leftover = shards.folder / ".00001.0123.tmp"  # by a kill
    leftover.mkdir()
    (leftover / "rows.npy").write_bytes(b"half")
    made.clear()
    assert build(tmp_path, Watched(), report=lambda *numbers: reports.append(numbers)) == shards
    assert made == [1, 2]
    assert reports == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert contents(shards.folder) == before  # and nothing else is left
    changed = {path.parent for path, modified in times(shards.folder).items() if before_times[path] != modified}
    assert changed == {shards.paths[1]}


# Kills, errors and damage


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_build_that_is_killed_leaves_whole_shards_and_no_process(tmp_path, number):
    gated = GatedCorridors(gate=str(tmp_path / "gate"), gated=(4, 5, 6))
    code = (
        "import signal; from pathlib import Path; from support.corridors import GatedCorridors, build;"
        "signal.signal(signal.SIGINT, signal.default_int_handler);"
        f"build(Path({str(tmp_path)!r}), {gated!r}, workers=2)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, Path(__file__).parents[2:4]))}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE)
    while len(list(tmp_path.glob("*/0*"))) < 2:  # the other two wait for the gate
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    process.communicate(timeout=60)  # until the last worker, which has the pipe too, is gone
    assert process.returncode == -number
    (folder,) = tmp_path.glob("*")
    before_times = times(folder)
    assert {path.parent.name for path in before_times} == {"00000", "00001"}
    (tmp_path / "gate").touch()
    shards = build(tmp_path, gated)
    assert shards.folder == folder
    assert contents(folder) == contents(build(tmp_path / "whole").folder)
    assert before_times.items() <= times(folder).items()


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_in_a_scene_reaches_the_caller_and_ends_the_other_workers(tmp_path, workers):
    # Shards (0, 1, 2) and (3, 4, 5, 6), which fails; with two workers the first waits for ever.
    with pytest.raises(InputError) as caught:
        build(tmp_path, FaultyCorridors(gated=(0,) if workers == 2 else ()), shard_scenes=4, workers=workers)
    assert str(caught.value) == "corridor 3: has no end; give it one"
    assert [path.name for path in tmp_path.glob("*/*")] == (["00000"] if workers == 1 else [])
    assert not multiprocessing.active_children()


def test_a_shard_that_another_process_finished_first_is_kept(tmp_path, monkeypatch):
    save, others = np.save, {}

    def overtaken(file, array):
        monkeypatch.setattr(np, "save", save)
        others.update(times(build(tmp_path).folder))  # also sweeps up the shard that is being written
        save(file, array)

    monkeypatch.setattr(np, "save", overtaken)
    shards = build(tmp_path)
    assert len(others) == 4 * 9
    assert times(shards.folder) == others


def test_a_disk_that_is_full_is_an_error_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(np, "save", Mock(side_effect=OSError("No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        build(tmp_path)
    assert not list(tmp_path.glob("*/*"))


@pytest.mark.parametrize("damage", ["missing", "empty", "short", "shorter", "unclosed"])
@pytest.mark.parametrize("name", ["rows.npy", "goals.npy", "shard.json"])
def test_a_damaged_shard_is_refused_until_it_is_deleted(tmp_path, name, damage):
    shards = build(tmp_path)
    path = shards.paths[2] / name
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        unclosed = content.replace(b"}", b" ")
        path.write_bytes({"empty": b"", "short": content[:-2], "shorter": content[:70], "unclosed": unclosed}[damage])
    shards[1]
    with pytest.raises(InputError) as caught:
        shards[2]
    assert str(caught.value).startswith(f"{path}: ")
    assert f"delete the folder {path.parent}, then" in str(caught.value)
    shutil.rmtree(path.parent)
    build(tmp_path)[2]
    assert path.read_bytes() == content
