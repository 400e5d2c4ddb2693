"""The import of scenes: from users' files, in the formats that there are, to a scene file."""

import dataclasses
import fnmatch
import reprlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids, unknown_types
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor
from jaxnav.scenes.files.importers.controller import read_controller
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.files.importers.replacements import read_replacements
from jaxnav.scenes.files.importers.scene_data import read_scene_data
from jaxnav.scenes.files.scene_file import iterate_scenes, write_scenes
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.worlds import WORLDS

Split = Literal["train", "val", "test"]
Imported = Iterator[Scene | InputError]

#: World whose vocabulary scenes are compared with, by the world that they come from; `rooms` for others.
USUAL_WORLDS = {
    "robothor": "apartments",
    "apartments": "apartments",
    "procthor": "houses",
    "habitat": "houses",
    "gibson": "houses",
    "houses": "houses",
}
#: Options that only one format has.
OWN_OPTIONS = {"assets": "procthor", "maps": "habitat", "from_controller": "ai2thor", "base": "replacements"}


@dataclasses.dataclass(frozen=True)
class ImportConfig:
    """Import scenes to a scene file.

    Attributes:
      format: `procthor`: houses as JSON or JSON lines; `ai2thor`: metadata of the controller with reachable positions,
        a file or a folder of files; `scene-data`: the offline folders of SAVN, ORG and L-sTDE; `habitat`: an ObjectNav
        split or one of its files; `replacements`: places of movable objects in the rooms of `--base`; `scenes`: a scene
        file, to divide it into splits.
      source: what to read; with `--from-controller` names of scenes with commas between them.
      out: scene file to write (`*.jsonl.gz`).
      split: of the scenes that none of the following patterns fits.
      val, test: patterns of scene names, such as `FloorPlan_Train11_*`, that make up these splits.
      world: world whose vocabulary the types are compared with; default: that which the scenes stand for.
      categories: vocabulary to compare with instead.
      assets: asset database of ProcTHOR (JSON), for types and sizes.
      maps: semantic floor maps for Habitat episodes (`*_info.pbz2`).
      from_controller: read from an installed `ai2thor` simulator instead of from files.
      base: scene file with the rooms that re-placements are of.
    """

    format: Annotated[
        Literal["procthor", "ai2thor", "scene-data", "habitat", "replacements", "scenes"], tyro.conf.Positional
    ]
    source: Annotated[str, tyro.conf.Positional]
    out: Annotated[Path, tyro.conf.Positional]
    split: Split = "train"
    val: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    world: Literal["rooms", "apartments", "houses"] | None = None
    categories: tuple[str, ...] | None = None
    assets: Path | None = None
    maps: Path | None = None
    from_controller: bool = False
    base: Path | None = None


def import_scenes(config: ImportConfig, console: Console) -> None:
    """Import, write the scene file, and tell what was refused and which types are unknown.

    Raises:
      InputError: nothing could be imported, or the file cannot be written.
    """
    if not config.out.name.endswith(".jsonl.gz"):
        raise InputError(f"{config.out}: give a name that ends in .jsonl.gz")
    for option, owner in OWN_OPTIONS.items():
        if getattr(config, option) and config.format != owner:
            name = option.replace("_", "-")
            raise InputError(f"--{name}: is for the format {owner}, not for {config.format}; leave it out")
    kept: dict[str, Scene] = {}
    unknown: Counter[str] = Counter()
    refused = 0
    for scene in _read(config):
        try:
            if isinstance(scene, InputError):
                raise scene
            categories = _vocabulary(scene, config)
            _check(scene, kept, categories, config.source)
        except InputError as error:
            refused += 1
            console.print(f"refused: {error}", style="yellow", markup=False, soft_wrap=True)
        else:
            kept[scene.name] = _with_split(scene, config)
            unknown += unknown_types([scene], categories)
    if not kept:
        raise InputError(f"{config.source}: none of its {refused} scenes can be used; mend what is said of them above")
    for pattern in (*config.val, *config.test):
        if not fnmatch.filter(kept, pattern):
            raise InputError(f"pattern {pattern!r}: fits no scene; there are {reprlib.repr(sorted(kept))}")
    try:
        write_scenes(config.out, kept.values())
    except OSError as error:
        raise InputError(f"{config.out}: cannot be written ({error.strerror}); give another name") from error
    for name, count in unknown.most_common():
        console.print(f"unknown type, only blocks the sight: {name} x {count}", markup=False, soft_wrap=True)
    console.print(f"{len(kept)} scenes imported, {refused} refused; written to {config.out}", soft_wrap=True)


def _read(config: ImportConfig) -> Imported:
    path, split = Path(config.source), config.split
    if config.from_controller:
        return read_controller(config.source.split(","), split)
    if config.format == "replacements":
        if config.base is None:
            raise InputError("--base: is missing; replacements need the scene file of their rooms")
        return read_replacements(path, config.base)
    readers: dict[str, Callable[[], Imported]] = {
        "procthor": lambda: read_procthor(path, split, config.assets),
        "ai2thor": lambda: read_ai2thor(path, split),
        "scene-data": lambda: read_scene_data(path, split),
        "habitat": lambda: read_habitat(path, split, config.maps),
        "scenes": lambda: iterate_scenes(path),
    }
    return readers[config.format]()


def _vocabulary(scene: Scene, config: ImportConfig) -> tuple[str, ...]:
    world = config.world or USUAL_WORLDS.get(scene.world, "rooms")
    return config.categories or WORLDS[world].task.categories


def _check(scene: Scene, kept: dict[str, Scene], categories: tuple[str, ...], source: str) -> None:
    where = f"{source}, scene {scene.name!r}"
    if scene.name in kept:
        raise InputError(f"{where}: name is that of an earlier scene; import them to two files")
    if max(category_ids(scene.types, categories), default=-1) < 0:
        raise InputError(
            f"{where}: objects are of no known type; known are {', '.join(categories)} (see --world and --categories)"
        )


def _with_split(scene: Scene, config: ImportConfig) -> Scene:
    patterns: tuple[tuple[Split, tuple[str, ...]], ...] = (("val", config.val), ("test", config.test))
    fits = [split for split, names in patterns if any(fnmatch.fnmatchcase(scene.name, name) for name in names)]
    return dataclasses.replace(scene, split=fits[0] if fits else config.split)
