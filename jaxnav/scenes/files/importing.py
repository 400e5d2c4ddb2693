"""Import of scenes from the formats of simulators and datasets."""

import dataclasses
import fnmatch
import reprlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids, unknown_types
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor
from jaxnav.scenes.files.importers.assemble import Note
from jaxnav.scenes.files.importers.controller import read_controller
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.files.importers.replacements import read_replacements
from jaxnav.scenes.files.importers.scene_data import read_scene_data
from jaxnav.scenes.files.scene_file import iterate_scenes, write_scenes
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.worlds import WORLDS, world_named

Format = Literal["procthor", "ai2thor", "scene-data", "habitat", "replacements", "scenes"]
Split = Literal["train", "val", "test"]
Imported = Iterator[Scene | InputError | Note]

#: Format that each option of `read_format` is for.
FORMAT_OPTIONS = {
    "assets": "procthor",
    "agent_part": "procthor",
    "maps": "habitat",
    "from_controller": "ai2thor",
    "base": "replacements",
}


class ImportSummary(NamedTuple):
    """Summarize an import.

    Attributes:
      scenes: those that were written, by name.
      refused: number of scenes that could not be used.
      unknown: number of objects of each type that is in no vocabulary.
      unconnected: standable cells outside the largest connected part, of each scene that has such cells.
      notes: what else was done to the scenes, and its number.
    """

    scenes: dict[str, Scene]
    refused: int
    unknown: Counter[str]
    unconnected: Counter[str]
    notes: Counter[str]


def read_format(
    form: Format,
    source: str,
    split: Split = "train",
    assets: Path | None = None,
    maps: Path | None = None,
    from_controller: bool = False,
    base: Path | None = None,
    agent_part: bool = False,
) -> Imported:
    """Yield the scenes of a source.

    Args:
      form: the format.
      source: path of a file or folder; with `from_controller` names of scenes with commas between them.
      split: split of the scenes; scenes of a scene file keep theirs.
      assets: asset database of ProcTHOR.
      maps: semantic floor maps for Habitat episodes.
      from_controller: whether to read from an installed AI2-THOR simulator.
      base: scene file with the rooms that re-placements are of.
      agent_part: of ProcTHOR houses only what is connected with the agent's place in the file.

    Yields:
      A scene, or why it cannot be used; also notes of what was done.

    Raises:
      InputError: the source cannot be read, or an option is missing or is for another format.
    """
    options = {"assets": assets, "agent_part": agent_part, "maps": maps, "base": base}
    _check_options(form, options | {"from_controller": from_controller})
    path = Path(source)
    match form:
        case "procthor":
            yield from read_procthor(path, split, assets, agent_part)
        case "ai2thor":
            yield from read_controller(source.split(","), split) if from_controller else read_ai2thor(path, split)
        case "scene-data":
            yield from read_scene_data(path, split)
        case "habitat":
            yield from read_habitat(path, split, maps)
        case "replacements":
            if base is None:
                raise InputError("--base: is missing; replacements need the scene file of their rooms")
            yield from read_replacements(path, base)
        case "scenes":
            yield from iterate_scenes(path)


def select(scenes: Imported, room_types: tuple[str, ...] = (), largest: int | None = None) -> Imported:
    """Leave out scenes of other room types or sizes.

    Args:
      scenes: see `read_format`.
      room_types: of the scenes to keep; empty for all.
      largest: cells along the longer side of the largest scene to keep; None for any.

    Yields:
      Scenes to keep, a note for each scene that is left out, and all else.

    Raises:
      InputError: no scene is kept.
    """
    kept, others, sides = 0, set[str](), set[int]()
    for scene in scenes:
        if not isinstance(scene, Scene):
            yield scene
        elif room_types and scene.room_type not in room_types:
            others.add(scene.room_type)
            yield Note(f"scenes are left out, for their room type is not {' or '.join(room_types)}", 1)
        elif largest is not None and max(scene.reach.shape) > largest:
            sides.add(max(scene.reach.shape))
            yield Note(f"scenes are left out, for they are longer than {largest} cells", 1)
        else:
            kept += 1
            yield scene
    if sides and not kept:
        raise InputError(f"--largest {largest}: leaves no scene; the smallest is {min(sides)} cells long")
    if others and not kept:
        raise InputError(f"--room-types {' '.join(room_types)}: leaves no scene; there are {', '.join(sorted(others))}")


def import_scenes(
    scenes: Iterable[Scene | InputError | Note],
    source: str,
    out: Path,
    split: Split = "train",
    val: tuple[str, ...] = (),
    test: tuple[str, ...] = (),
    categories: tuple[str, ...] | None = None,
    report: Callable[[InputError], None] = print,
) -> ImportSummary:
    """Write usable scenes to a scene file.

    Args:
      scenes: see `read_format`.
      source: what they were read from, for error messages.
      out: scene file to write (`*.jsonl.gz`).
      split: of the scenes whose names no pattern fits.
      val, test: patterns of scene names, such as `FloorPlan_Train11_*`, of these splits.
      categories: vocabulary that the types are compared with; None for that of the world that a scene stands for.
      report: called with the reason why a scene is refused.

    Raises:
      InputError: no scene can be used, a pattern fits none, or the file cannot be written.
    """
    if not out.name.endswith(".jsonl.gz"):
        raise InputError(f"{out}: give a name that ends in .jsonl.gz")
    summary = _usable(scenes, source, categories, report)
    kept = summary.scenes
    if not kept:
        raise InputError(f"{source}: none of its {summary.refused} scenes can be used; mend what is said of them above")
    for pattern in (*val, *test):
        if not fnmatch.filter(kept, pattern):
            raise InputError(f"pattern {pattern!r}: fits no scene; there are {reprlib.repr(sorted(kept))}")
    try:
        write_scenes(out, [_with_split(scene, {"val": val, "test": test}, split) for scene in kept.values()])
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); give another name") from error
    return summary


def _check_options(form: Format, options: dict[str, Path | bool | None]) -> None:
    """Refuse options that are for another format."""
    for option, usable in FORMAT_OPTIONS.items():
        if options[option] and form != usable:
            name = option.replace("_", "-")
            raise InputError(f"--{name}: is for the format {usable}, not for {form}; leave it out")


def _usable(
    scenes: Iterable[Scene | InputError | Note],
    source: str,
    categories: tuple[str, ...] | None,
    report: Callable[[InputError], None],
) -> ImportSummary:
    """Return the usable scenes and what is told of them."""
    kept: dict[str, Scene] = {}
    unknown, unconnected, notes = Counter[str](), Counter[str](), Counter[str]()
    refused = 0
    for scene in scenes:
        try:
            if isinstance(scene, InputError):
                raise scene
            if isinstance(scene, Note):
                notes += Counter({scene.text: scene.number})
                continue
            vocabulary = categories or WORLDS[world_named(scene.world)].task.categories
            _check(scene, kept, vocabulary, source)
        except InputError as error:
            refused += 1
            report(error)
        else:
            kept[scene.name] = scene
            unknown += unknown_types([scene], vocabulary)
            unconnected += Counter({scene.name: int(scene.reach.sum()) - len(standable_cells(scene.reach))})
    return ImportSummary(kept, refused, unknown, unconnected, notes)


def _check(scene: Scene, kept: dict[str, Scene], categories: tuple[str, ...], source: str) -> None:
    """Refuse a scene without categories, or of an earlier name."""
    where = f"{source}, scene {scene.name!r}"
    if scene.name in kept:
        raise InputError(f"{where}: name is that of an earlier scene; import them to two files")
    if max(category_ids(scene.types, categories), default=-1) < 0:
        raise InputError(
            f"{where}: objects are of no known type; known are {', '.join(categories)} (see --world and --categories)"
        )


def _with_split(scene: Scene, patterns: dict[Split, tuple[str, ...]], default: Split) -> Scene:
    """Set the first split with a pattern that fits."""
    fits = (split for split, names in patterns.items() if any(fnmatch.fnmatchcase(scene.name, name) for name in names))
    return dataclasses.replace(scene, split=next(fits, default))
