"""The import command on mutated files of every format.

`python -m support.fuzz_importers [RUNS]` in `tests` prints the counts.

A run replaces or deletes up to three values of a fixture at random places, or damages bytes of its files. In every
case the command must end with code 0 and a complete scene file, or with code 2 and no file.
"""

import collections
import contextlib
import copy
import gzip
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from jaxnav.cli.scenes import main
from jaxnav.scenes.files.scene_file import read_scenes
from support.importer_inputs.ai2thor import METADATA
from support.importer_inputs.habitat import EPISODES, STARTS, write_json
from support.importer_inputs.procthor import HOUSE
from support.importer_inputs.scene_data import FILES
from support.importer_inputs.semantic_maps import bedroom, l_shaped_floor, write_maps
from support.mutations import edited

CRASHED = -1
NASTY = [None, True, -1, 0, 7, 1e308, -0.13, 10**400, float("nan"), float("inf"), "", "Floor", "\ud800", [], {}, [[]]]

_NAME_WORDS = (
    "Bed",
    "sofa",
    "FloorPlan_test-dev1",
    "house.1.glb",
    "Home.glb",
    "._x",
    "small",
    "room",
    "\u00e9t\u00e9",
    "\ufeff",
)
_NAME_SEPARATORS = ("|", "_", "-", ".", "/", " ", "")


class Format(NamedTuple):
    """An input of the import command.

    Attributes:
      name: name of the format.
      content: JSON value; for a folder, its files by name.
      write: writes a content to a folder, and returns the path to import.
      options: further options of the command.
    """

    name: str
    content: object
    write: Callable[[Path, object], Path]
    options: tuple[str, ...] = ()


def _file_writer(name: str) -> Callable[[Path, object], Path]:
    """Return a function that writes a content as JSON to a file of this name, compressed if it ends with `.gz`."""

    def write_file(folder: Path, content: object) -> Path:
        path = folder / name
        data = json.dumps(content).encode()
        path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
        return path

    return write_file


def _write_scene_folder(folder: Path, content: object) -> Path:
    scene_folder = folder / "Scene_Data" / "FloorPlan401"
    scene_folder.mkdir(parents=True)
    files = content if isinstance(content, dict) else {}
    for name, value in files.items():
        ascii_name = Path(str(name)).name.encode("ascii", "ignore").decode()
        (scene_folder / ascii_name).write_text(json.dumps(value))
    return folder / "Scene_Data"


def _write_maps_and_episodes(folder: Path, content: object) -> Path:
    write_maps(folder / "maps.pbz2", content)
    return write_json(folder / "val.json.gz", {"episodes": STARTS})


FORMATS = (
    Format("procthor", HOUSE, _file_writer("house.json")),
    Format("ai2thor", METADATA, _file_writer("room.json.gz")),
    Format("scene-data", FILES, _write_scene_folder),
    Format("habitat", EPISODES, _file_writer("val.json.gz")),
    Format("habitat", {"Home": {0: l_shaped_floor(), 1: bedroom()}}, _write_maps_and_episodes, ("--maps", "maps.pbz2")),
)


def random_name(rng: random.Random) -> str:
    """Return an id or name: hashes, numbers and words, joined by one of the separators of the formats."""
    name_parts: list[str] = []
    for _ in range(rng.randint(1, 4)):
        hash_text = f"{rng.getrandbits(128):032x}"[: rng.choice((4, 8, 32))]
        name_parts.append(rng.choice((hash_text, hash_text.upper(), str(rng.randrange(-1, 999)), *_NAME_WORDS)))
    return rng.choice(_NAME_SEPARATORS).join(name_parts)


def randomly_mutated(content: object, rng: random.Random) -> object:
    """Return a copy with up to three values deleted, or replaced by nasty values or random names."""

    def draw_value() -> object:
        return random_name(rng) if rng.random() < 0.3 else copy.deepcopy(rng.choice(NASTY))

    for _ in range(rng.randint(1, 3)):
        content = edited(content, rng.choice, draw_value)
    return content


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return bytes without their end, or with one byte changed."""
    if rng.random() < 0.5:
        return data[: rng.randrange(len(data) + 1)]
    index = rng.randrange(len(data))
    return data[:index] + bytes([rng.randrange(256)]) + data[index + 1 :]


def fuzz(scene_format: Format, num_runs: int, seed: int = 0) -> tuple[collections.Counter, float]:
    """Return the number of runs by exit code, and the seconds of the slowest run.

    Raises:
      AssertionError: a run failed and left a file, or succeeded and left none.
    """
    rng = random.Random(seed)
    exit_codes = collections.Counter()
    slowest_s = 0.0
    for _ in range(num_runs):
        with tempfile.TemporaryDirectory() as folder_name:
            folder = Path(folder_name)
            (folder / "in").mkdir()

            # Damage the bytes of a file, or values of its content.
            damages_bytes = rng.random() < 0.3
            content = scene_format.content if damages_bytes else randomly_mutated(scene_format.content, rng)
            source = scene_format.write(folder / "in", content)
            if damages_bytes:
                file = rng.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
                file.write_bytes(damaged(file.read_bytes(), rng))

            # Time the command; any exception is a crash.
            target = folder / "out" / "scenes.jsonl.gz"
            arguments = ["import", scene_format.name, str(source), str(target)]
            for word in scene_format.options:
                arguments.append(str(folder / "in" / word) if word.endswith(".pbz2") else word)
            start_time = time.perf_counter()
            try:
                exit_code = main(arguments)
            except Exception:
                exit_code = CRASHED
            slowest_s = max(slowest_s, time.perf_counter() - start_time)
            exit_codes[exit_code] += 1

            # A complete scene file after success, and no file otherwise.
            file_names = [path.name for path in target.parent.iterdir()] if target.parent.exists() else []
            assert file_names == ([target.name] if exit_code == 0 else []), (exit_code, file_names)
            if exit_code == 0:
                read_scenes(target)
    return exit_codes, slowest_s


def print_counts(num_runs: int) -> None:
    """Fuzz every format, and print a table of the results."""
    table = Table("format", "runs", "imported", "refused", "crashed", "slowest (s)")
    # The messages of the command are not shown.
    with open(os.devnull, "w") as no_output, contextlib.redirect_stderr(no_output):
        for scene_format in FORMATS:
            exit_codes, slowest_s = fuzz(scene_format, num_runs)
            counts = (num_runs, exit_codes[0], exit_codes[2], exit_codes[CRASHED])
            format_name = " ".join((scene_format.name, *scene_format.options))
            table.add_row(format_name, *map(str, counts), f"{slowest_s:.2f}")
    Console().print(table)


if __name__ == "__main__":
    print_counts(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
