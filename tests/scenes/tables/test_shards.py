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
from support.corridors import TASK, Corridors, FaultyCorridors, GatedCorridors, compile_corridors
from support.scenes import CATEGORIES

from jaxnav.errors import InputError
from jaxnav.scenes.tables import shards as module
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Rules, Task

ARRAYS = ("ahead", "rows", "best_length", "goal_distance", "first_cell", "num_cells", "goals", "num_goals")


def modification_times(folder):
    """Time of the last change, in nanoseconds, of every file below a folder."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def use_code_copy(tmp_path, monkeypatch):
    """Let the shards hash a copy of the code of the scenes, and return its folder."""
    code_folder = tmp_path / "code"
    shutil.copytree(module._SOURCE, code_folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(module, "_SOURCE", code_folder)
    return code_folder


def imported_files(code_folder, *modules):
    """Files of the scenes that modules import, directly or not, and the data files in their folders."""
    files = set()
    pending_modules = list(modules)
    while pending_modules:
        file_name = pending_modules.pop()
        files.add(file_name)
        files |= {path.relative_to(code_folder).as_posix() for path in (code_folder / file_name).parent.glob("*.yaml")}

        # The modules of the scenes that this one imports are next.
        module_text = (code_folder / file_name).read_text()
        imported_modules = re.findall(r"^ *from jaxnav\.scenes\.([\w.]+) import", module_text, re.MULTILINE)
        pending_modules += {f"{module_name.replace('.', '/')}.py" for module_name in imported_modules} - files
    return files


# Content of shards


@pytest.mark.parametrize("goalless_scenes", [(), (1, 4, 5)])
def test_concatenated_shards_equal_the_bank_of_all_scenes(tmp_path, goalless_scenes):
    corridors = Corridors(goalless=goalless_scenes)
    shards = compile_corridors(tmp_path, corridors)
    bank = compile_bank([corridors[i] for i in range(len(corridors))], TASK)
    # Seven scenes in shards of two at most: (0), (1, 2), (3, 4) and (5, 6).
    assert shards.counts == ((1, 1, 1, 1) if goalless_scenes else (1, 2, 2, 2))

    # Arrays equal those of the bank, with cells counted from the start of the bank.
    first_cells = np.cumsum([0] + [len(shard.ahead) for shard in shards], dtype=np.int32)
    for field_name in ARRAYS:
        arrays = [getattr(shard, field_name) for shard in shards]
        if field_name in ("ahead", "first_cell"):
            arrays = [array + first_cell for array, first_cell in zip(arrays, first_cells, strict=False)]
        np.testing.assert_array_equal(
            np.concatenate(arrays), getattr(bank, field_name), err_msg=field_name, strict=True
        )

    # So do texts.
    for field_name in ("names", "room_types"):
        assert sum((getattr(shard, field_name) for shard in shards), ()) == getattr(bank, field_name)
    assert shards.skipped == bank.skipped == tuple(f"corridor-{i}" for i in goalless_scenes)
    assert {shard.task for shard in shards} == {shards.task} == {TASK}


def test_shards_are_memory_mapped_and_report_the_largest_sizes(tmp_path):
    shards = compile_corridors(tmp_path)
    for field_name in ARRAYS:
        array = getattr(shards[0], field_name)
        assert isinstance(array, np.memmap), field_name
        assert not array.flags.writeable
    # Corridors of 4, 5, 6, 7, 8, 4 and 5 rows have 7, 9, 11, 13, 15, 7 and 9 cells: 7, 20, 28 and 16 in the shards.
    assert [len(shard.ahead) for shard in shards] == [7, 20, 28, 16]
    assert (shards.num_cells, shards.num_scenes) == (28, 2)


def test_shards_without_a_goal_are_left_out_or_refused_altogether(tmp_path):
    shards = compile_corridors(tmp_path, Corridors(count=6, goalless=(2, 3)))
    assert (shards.counts, shards.skipped) == ((2, 2), ("corridor-2", "corridor-3"))
    assert [shard.names[0] for shard in shards] == ["corridor-0", "corridor-4"]
    with pytest.raises(InputError, match=r"3 scenes .* Book, Chair, Fridge"):
        compile_corridors(tmp_path, Corridors(count=3, goalless=(0, 1, 2), identity="bare"))


# Folders of shards


@pytest.mark.slow
def test_two_workers_write_identical_shards_and_report_progress(tmp_path):
    reports = []
    by_one_worker = compile_corridors(tmp_path / "one")
    by_two_workers = compile_corridors(tmp_path / "two", workers=2, report=lambda *numbers: reports.append(numbers))
    assert contents(by_one_worker.folder) == contents(by_two_workers.folder)
    assert len(contents(by_one_worker.folder)) == 4 * 9  # shards of eight arrays and the texts
    assert reports == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_shard_folder_depends_on_scenes_task_size_and_code(tmp_path, monkeypatch):
    code_file = use_code_copy(tmp_path, monkeypatch) / "lattice.py"
    folder = compile_corridors(tmp_path).folder
    assert compile_corridors(tmp_path).folder == folder
    other_shards = [
        compile_corridors(tmp_path, Corridors(identity="others")),
        compile_corridors(tmp_path, task=Task(CATEGORIES, rules=Rules(success_distance=1.25))),
        compile_corridors(tmp_path, shard_scenes=3),
    ]
    code_file.write_text("# changed")
    other_shards.append(compile_corridors(tmp_path))
    assert len({folder, *(shards.folder for shards in other_shards)}) == 5


def test_shard_cache_key_depends_on_imported_code_alone(tmp_path, monkeypatch):
    code_folder = use_code_copy(tmp_path, monkeypatch)
    cache_key = module._cache_key(Corridors(), TASK, 2)
    needed_files = imported_files(code_folder, "tables/shards.py")
    assert {"tables/compile.py", "worlds.py", "generate/rooms.yaml", "files/scene_file.py"} <= needed_files

    # Change one file after the other, and note which of them change the key.
    key_files = set()
    for path in filter(Path.is_file, list(code_folder.rglob("*.*"))):
        file_content = path.read_text()
        path.write_text(f"{file_content}\n# changed\n")
        if module._cache_key(Corridors(), TASK, 2) != cache_key:
            key_files.add(path.relative_to(code_folder).as_posix())
        path.write_text(file_content)
    assert key_files == needed_files
    assert not any("importers" in file_name or "__init__" in file_name for file_name in key_files)


def test_compile_shards_builds_only_missing_shards(tmp_path):
    compiled_indices = []
    reports = []

    class Watched(Corridors):
        def __getitem__(self, index):
            compiled_indices.append(index)
            return super().__getitem__(index)

    shards = compile_corridors(tmp_path, Watched())
    assert compiled_indices == list(range(7))
    contents_before = contents(shards.folder)
    times_before = modification_times(shards.folder)

    # Remove a shard, and leave a temporary folder as a killed process does.
    shutil.rmtree(shards.paths[1])
    unfinished_shard = shards.folder / ".00001.0123.tmp"
    unfinished_shard.mkdir()
    (unfinished_shard / "rows.npy").write_bytes(b"half")

    # The missing shard is compiled, and the temporary folder is removed.
    compiled_indices.clear()
    assert compile_corridors(tmp_path, Watched(), report=lambda *numbers: reports.append(numbers)) == shards
    assert compiled_indices == [1, 2]
    assert reports == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert contents(shards.folder) == contents_before
    written_files = modification_times(shards.folder).items() - times_before.items()
    assert {path.parent for path, _ in written_files} == {shards.paths[1]}


# Kills, errors and damage


@pytest.mark.slow
@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGINT])
def test_killed_build_leaves_whole_shards_and_no_process(tmp_path, signal_number):
    gated_corridors = GatedCorridors(gate_path=str(tmp_path / "gate"), gated=(4, 5, 6))
    build_program = (
        "import signal; from pathlib import Path; from support.corridors import GatedCorridors, compile_corridors;"
        "signal.signal(signal.SIGINT, signal.default_int_handler);"
        f"compile_corridors(Path({str(tmp_path)!r}), {gated_corridors!r}, workers=2)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, Path(__file__).parents[2:4]))}

    # Send a signal to the process once two of its four shards are written.
    process = subprocess.Popen([sys.executable, "-c", build_program], env=environment, stdout=subprocess.PIPE)
    while len(list(tmp_path.glob("*/0*"))) < 2:  # the other two wait for the gate
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal_number)
    process.communicate(timeout=60)  # until the last worker, which has the pipe too, is gone
    assert process.returncode == -signal_number
    (folder,) = tmp_path.glob("*")
    times_before = modification_times(folder)
    assert {path.parent.name for path in times_before} == {"00000", "00001"}

    # A second build writes the others, and does not touch the first two.
    (tmp_path / "gate").touch()
    shards = compile_corridors(tmp_path, gated_corridors)
    assert shards.folder == folder
    assert contents(folder) == contents(compile_corridors(tmp_path / "whole").folder)
    assert times_before.items() <= modification_times(folder).items()


@pytest.mark.parametrize("workers", [1, 2])
def test_scene_error_reaches_the_caller_and_ends_all_workers(tmp_path, workers):
    # Shards (0, 1, 2) and (3, 4, 5, 6), which fails; with two workers the first waits for ever.
    with pytest.raises(InputError) as caught:
        compile_corridors(
            tmp_path, FaultyCorridors(gated=(0,) if workers == 2 else ()), shard_scenes=4, workers=workers
        )
    assert str(caught.value) == "corridor 3: has no end; give it one"
    assert [path.name for path in tmp_path.glob("*/*")] == (["00000"] if workers == 1 else [])
    assert not multiprocessing.active_children()


def test_compile_shards_keeps_a_shard_of_another_process(tmp_path, monkeypatch):
    original_save = np.save
    times_of_other = {}

    def save_after_other_process(file, array):
        monkeypatch.setattr(np, "save", original_save)
        times_of_other.update(
            modification_times(compile_corridors(tmp_path).folder)
        )  # also removes the shard that is being written
        original_save(file, array)

    monkeypatch.setattr(np, "save", save_after_other_process)
    shards = compile_corridors(tmp_path)
    assert len(times_of_other) == 4 * 9
    assert modification_times(shards.folder) == times_of_other


def test_full_disk_raises_and_leaves_no_shard(tmp_path, monkeypatch):
    monkeypatch.setattr(np, "save", Mock(side_effect=OSError("No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        compile_corridors(tmp_path)
    assert not list(tmp_path.glob("*/*"))


@pytest.mark.parametrize("damage", ["missing", "empty", "short", "shorter", "unclosed"])
@pytest.mark.parametrize("file_name", ["rows.npy", "goals.npy", "shard.json"])
def test_damaged_shard_is_refused_until_its_folder_is_deleted(tmp_path, file_name, damage):
    shards = compile_corridors(tmp_path)
    path = shards.paths[2] / file_name
    original_content = path.read_bytes()
    damaged_contents = {
        "empty": b"",
        "short": original_content[:-2],
        "shorter": original_content[:70],
        "unclosed": original_content.replace(b"}", b" "),
    }
    path.unlink()
    if damage != "missing":
        path.write_bytes(damaged_contents[damage])

    # Other shards are read; this one is refused with its file and the remedy.
    shards[1]
    with pytest.raises(InputError) as caught:
        shards[2]
    assert str(caught.value).startswith(f"{path}: ")
    assert f"delete the folder {path.parent}, and" in str(caught.value)

    # Without the folder the shard is built anew.
    shutil.rmtree(path.parent)
    compile_corridors(tmp_path)[2]
    assert path.read_bytes() == original_content
