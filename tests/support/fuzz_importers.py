"""Mutated files of every format through the import command.

`python -m support.fuzz_importers [RUNS]` in `tests` prints the counts.

A run replaces or deletes up to three values of a fixture at random places, or damages bytes of its files. Whatever
comes of it, the command must end with code 0 and a whole scene file, or with code 2 and none.
"""

import collections
import copy
import gzip
import json
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
    """Describe an input: format, content, and a writer.

    The files of a folder are members of the content.
    """

    name: str
    content: object
    write: Callable[[Path, object], Path]
    options: tuple[str, ...] = ()


def _text(name: str) -> Callable[[Path, object], Path]:
    def write(folder: Path, content: object) -> Path:
        path = folder / name
        data = json.dumps(content).encode()
        path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
        return path

    return write


def _scene_folder(folder: Path, content: object) -> Path:
    scene = folder / "Scene_Data" / "FloorPlan401"
    scene.mkdir(parents=True)
    for name, value in content.items() if isinstance(content, dict) else ():
        (scene / Path(str(name)).name.encode("ascii", "ignore").decode()).write_text(json.dumps(value))
    return folder / "Scene_Data"


def _mapped(folder: Path, content: object) -> Path:
    write_maps(folder / "maps.pbz2", content)
    return write_json(folder / "val.json.gz", {"episodes": STARTS})


FORMATS = (
    Format("procthor", HOUSE, _text("house.json")),
    Format("ai2thor", METADATA, _text("room.json.gz")),
    Format("scene-data", FILES, _scene_folder),
    Format("habitat", EPISODES, _text("val.json.gz")),
    Format("habitat", {"Home": {0: l_shaped_floor(), 1: bedroom()}}, _mapped, ("--maps", "maps.pbz2")),
)


def random_name(draw: random.Random) -> str:
    """Return an id or name: hashes, numbers and words with the separators of the formats between them."""
    name_parts: list[str] = []
    for _ in range(draw.randint(1, 4)):
        hash_text = f"{draw.getrandbits(128):032x}"[: draw.choice((4, 8, 32))]
        name_parts.append(draw.choice((hash_text, hash_text.upper(), str(draw.randrange(-1, 999)), *_NAME_WORDS)))
    return draw.choice(_NAME_SEPARATORS).join(name_parts)


def mutated(content: object, draw: random.Random) -> object:
    """Return a copy with up to three values replaced, by nasty values or random names.

    They may be deleted, too.
    """

    def replacement() -> object:
        return random_name(draw) if draw.random() < 0.3 else copy.deepcopy(draw.choice(NASTY))

    for _ in range(draw.randint(1, 3)):
        content = edited(content, draw.choice, replacement)
    return content


def damaged(data: bytes, draw: random.Random) -> bytes:
    """Return bytes without their end, or with one changed."""
    if draw.random() < 0.5:
        return data[: draw.randrange(len(data) + 1)]
    index = draw.randrange(len(data))
    return data[:index] + bytes([draw.randrange(256)]) + data[index + 1 :]


def fuzz(form: Format, runs: int, seed: int = 0) -> tuple[collections.Counter, float]:
    """Return runs by exit code, and the slowest's seconds.

    Raises:
      AssertionError: a run that leaves a file without success, or none with it.
    """
    draw = random.Random(seed)
    codes = collections.Counter()
    slowest = 0.0
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder_name:
            folder = Path(folder_name)
            (folder / "in").mkdir()

            # Either the bytes of a file are damaged, or values of its content.
            damages_bytes = draw.random() < 0.3
            content = form.content if damages_bytes else mutated(form.content, draw)
            source = form.write(folder / "in", content)
            if damages_bytes:
                file = draw.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
                file.write_bytes(damaged(file.read_bytes(), draw))

            # The command, timed; any exception is a crash.
            options = [str(folder / "in" / word) if word.endswith(".pbz2") else word for word in form.options]
            target = folder / "out" / "scenes.jsonl.gz"
            began = time.perf_counter()
            try:
                code = main(["import", form.name, str(source), str(target), *options])
            except Exception:
                code = CRASHED
            slowest = max(slowest, time.perf_counter() - began)
            codes[code] += 1

            # A whole scene file after success, and no file otherwise.
            file_names = [path.name for path in target.parent.iterdir()] if target.parent.exists() else []
            assert file_names == ([target.name] if code == 0 else []), (code, file_names)
            if code == 0:
                read_scenes(target)
    return codes, slowest


if __name__ == "__main__":
    RUNS = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    table = Table("format", "runs", "imported", "refused", "crashed", "slowest (s)")
    silent, sys.stderr = sys.stderr, open("/dev/null", "w")  # noqa: SIM115 - what the command says of every run
    for form in FORMATS:
        counts, longest = fuzz(form, RUNS)
        numbers = (RUNS, counts[0], counts[2], counts[CRASHED])
        table.add_row(" ".join((form.name, *form.options)), *map(str, numbers), f"{longest:.2f}")
    sys.stderr = silent
    Console().print(table)
