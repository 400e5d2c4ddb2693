"""Import of scenes from the formats of simulators and datasets.

`read_source` yields the scenes of a source in any of the formats, `filter_scenes` leaves out unwanted ones, and
`import_scenes` checks the rest and writes them to a scene file. Scenes flow between them one by one, together with the
errors of scenes that cannot be used, notes of guesses and counts of what was read.
"""

import dataclasses
import fnmatch
import reprlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from jaxnav.choices import Split
from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids, count_unknown_types
from jaxnav.scenes.files.account import IN_REFUSED_SCENE, ImportCount
from jaxnav.scenes.files.importers.ai2thor import read_ai2thor, read_controller, read_replacements, read_scene_data
from jaxnav.scenes.files.importers.assemble import ImportNote
from jaxnav.scenes.files.importers.habitat import read_habitat
from jaxnav.scenes.files.importers.procthor import read_procthor
from jaxnav.scenes.files.scene_file import iterate_counted_scenes, write_scenes
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.worlds import WORLDS, world_name_of_origin
from jaxnav.store.files import expand_home

SceneFormat = Literal["procthor", "ai2thor", "scene-data", "habitat", "replacements", "scenes"]
ImportStream = Iterator[Scene | InputError | ImportNote | ImportCount]

#: Format that each option of `read_source` is for.
FORMAT_OPTIONS = {
    "assets": "procthor",
    "agent_part": "procthor",
    "maps": "habitat",
    "from_controller": "ai2thor",
    "base": "replacements",
}


class ImportSummary(NamedTuple):
    """Summary of an import.

    Attributes:
      scenes: the scenes that were written, by name.
      num_refused: number of scenes that could not be used.
      unknown_type_counts: number of objects of each type that is in no vocabulary.
      unconnected_cell_counts: standable cells outside the largest connected part, of each scene that has such cells.
      notes: number of guesses and other changes to the scenes, by their text.
      account: what was read, kept and skipped, by its unit; see `ImportCount`.
    """

    scenes: dict[str, Scene]
    num_refused: int
    unknown_type_counts: Counter[str]
    unconnected_cell_counts: Counter[str]
    notes: Counter[str]
    account: dict[str, ImportCount]


def read_source(
    scene_format: SceneFormat,
    source: str,
    split: Split = "train",
    assets: Path | None = None,
    maps: Path | None = None,
    from_controller: bool = False,
    base: Path | None = None,
    agent_part: bool = False,
) -> ImportStream:
    """Yield the scenes of a source.

    Args:
      scene_format: the format.
      source: path of a file or folder; with `from_controller` names of scenes with commas between them.
      split: split of the scenes; scenes of a scene file keep theirs.
      assets: asset database of ProcTHOR.
      maps: semantic floor maps for Habitat episodes.
      from_controller: whether to read from an installed AI2-THOR simulator.
      base: scene file with the rooms that re-placements are of.
      agent_part: use only the cells of a ProcTHOR house that are connected with the agent's place in the file.

    Yields:
      A scene, or why it cannot be used; also notes of guesses and other changes, and counts of what was read.

    Raises:
      InputError: the source cannot be read, or an option is missing or is for another format.
    """
    given_options = {
        "assets": assets,
        "agent_part": agent_part,
        "maps": maps,
        "from_controller": from_controller,
        "base": base,
    }

    # An option that the format does not use is a mistake.
    for option_name, option_format in FORMAT_OPTIONS.items():
        if given_options[option_name] and scene_format != option_format:
            problem = f"is for the format {option_format}, not for {scene_format}; leave it out"
            raise InputError(f"--{option_name.replace('_', '-')}: {problem}")

    # The importers read one scene after the other, as their caller asks for them.
    source_path = expand_home(source)
    match scene_format:
        case "procthor":
            yield from read_procthor(source_path, split, assets, agent_part)
        case "ai2thor" if from_controller:
            yield from read_controller(source.split(","), split)
        case "ai2thor":
            yield from read_ai2thor(source_path, split)
        case "scene-data":
            yield from read_scene_data(source_path, split)
        case "habitat":
            yield from read_habitat(source_path, split, maps)
        case "replacements":
            if base is None:
                raise InputError("--base: is missing; replacements need the scene file of their rooms")
            yield from read_replacements(source_path, base)
        case "scenes":
            yield from iterate_counted_scenes(source_path)


def filter_scenes(scenes: ImportStream, room_types: tuple[str, ...] = (), max_side: int | None = None) -> ImportStream:
    """Leave out scenes of other room types or sizes.

    Args:
      scenes: see `read_source`.
      room_types: room types of the scenes to keep; empty for all.
      max_side: cells along the longer side of the largest scene to keep; None for any.

    Yields:
      Scenes to keep, a note and counts for each skipped scene, and all errors, notes and counts.

    Raises:
      InputError: no scene remains.
    """
    # Remember why scenes are skipped, for the error where none remains.
    num_scenes = 0
    other_room_types: set[str] = set()
    excessive_sides: set[int] = set()
    for scene in scenes:
        if not isinstance(scene, Scene):
            yield scene
        elif room_types and scene.room_type not in room_types:
            other_room_types.add(scene.room_type)
            yield ImportNote(f"scenes are skipped, because their room type is not {' or '.join(room_types)}", 1)
            yield from _skip_scene(scene, "of other room types")
        elif max_side is not None and max(scene.reach.shape) > max_side:
            excessive_sides.add(max(scene.reach.shape))
            yield ImportNote(f"scenes are skipped, because they are longer than {max_side} cells", 1)
            yield from _skip_scene(scene, f"longer than {max_side} cells")
        else:
            num_scenes += 1
            yield scene

    # Tell which limit would have left a scene.
    if excessive_sides and num_scenes == 0:
        smallest_side = min(excessive_sides)
        raise InputError(f"--largest {max_side}: no scene is small enough; the smallest is {smallest_side} cells long")
    if other_room_types and num_scenes == 0:
        present_types = ", ".join(sorted(other_room_types))
        raise InputError(f"--room-types {' '.join(room_types)}: no scene has these types; there are {present_types}")


def _skip_scene(scene: Scene, reason: str) -> Iterator[ImportCount]:
    """Count a skipped scene, whose objects the importer has counted as read."""
    yield ImportCount("scenes", num_read=1, skipped=Counter({reason: 1}))
    yield ImportCount("objects", skipped=Counter({f"in scenes {reason}": len(scene.types)}))


def import_scenes(
    scenes: Iterable[Scene | InputError | ImportNote | ImportCount],
    source: str,
    out: Path,
    split: Split | None = None,
    val: tuple[str, ...] = (),
    test: tuple[str, ...] = (),
    categories: tuple[str, ...] | None = None,
    report: Callable[[InputError], None] = print,
) -> ImportSummary:
    """Write usable scenes to a scene file, unless it exists with other content.

    Args:
      scenes: see `read_source`.
      source: file or folder that the scenes were read from, for error messages.
      out: scene file to write (`*.jsonl.gz`).
      split: split of the scenes whose names match no pattern; None keeps the split with which they were read.
      val, test: patterns of scene names, such as `FloorPlan_Train11_*`, of these splits.
      categories: vocabulary that the types are compared with; None for that of the world that a scene stands for.
      report: called with the reason why a scene is refused.

    Raises:
      InputError: no scene can be used, a pattern matches none, or the file cannot be written or holds something else.
    """
    if not out.name.endswith(".jsonl.gz"):
        raise InputError(f"{out}: give a name that ends in .jsonl.gz")

    # Read all scenes before anything is written.
    summary = _collect_usable_scenes(scenes, source, categories, report)
    if not summary.scenes:
        problem = f"none of its {summary.num_refused} scenes can be used; fix the errors above"
        raise InputError(f"{source}: {problem}")

    # A pattern that matches no scene is a typing error.
    for name_pattern in (*val, *test):
        if not fnmatch.filter(summary.scenes, name_pattern):
            scene_names = reprlib.repr(sorted(summary.scenes))
            raise InputError(f"pattern {name_pattern!r}: matches no scene; the names are {scene_names}")

    # Assign the splits by name; `val` comes before `test`.
    divided_scenes: list[Scene] = []
    for name, scene in summary.scenes.items():
        if _fits_any(name, val):
            scene_split = "val"
        elif _fits_any(name, test):
            scene_split = "test"
        else:
            scene_split = split or scene.split
        divided_scenes.append(dataclasses.replace(scene, split=scene_split))
    try:
        write_scenes(out, divided_scenes, summary.account, replace=False)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); give another name") from error
    return summary


def _collect_usable_scenes(
    scenes: Iterable[Scene | InputError | ImportNote | ImportCount],
    source: str,
    categories: tuple[str, ...] | None,
    report: Callable[[InputError], None],
) -> ImportSummary:
    """Collect the scenes that can be used, and count all else."""
    account = {unit: ImportCount(unit) for unit in ("scenes", "objects")}
    summary = ImportSummary({}, 0, Counter(), Counter(), Counter(), account)
    num_refused = 0
    for scene in scenes:
        if isinstance(scene, ImportCount):
            account.setdefault(scene.unit, ImportCount(scene.unit)).add(scene)
            continue
        if isinstance(scene, ImportNote):
            summary.notes[scene.text] += scene.number
            continue

        # Refuse scenes that an importer or the following checks find unusable.
        account["scenes"].num_read += 1
        try:
            if isinstance(scene, InputError):
                raise scene
            vocabulary = categories or WORLDS[world_name_of_origin(scene.world)].task.categories
            _check_scene(scene, summary.scenes, vocabulary, source)
        except InputError as error:
            num_refused += 1
            account["scenes"].skipped["refused"] += 1
            if isinstance(scene, Scene):
                account["objects"].skipped[IN_REFUSED_SCENE] += len(scene.types)
            report(error)
            continue

        # Count the oddities of a usable scene, for the report after the import.
        summary.scenes[scene.name] = scene
        account["scenes"].num_kept += 1
        account["objects"].num_kept += len(scene.types)
        summary.unknown_type_counts.update(count_unknown_types([scene], vocabulary))
        num_unconnected = int(scene.reach.sum()) - len(standable_cells(scene.reach))
        if num_unconnected:
            summary.unconnected_cell_counts[scene.name] = num_unconnected
    return summary._replace(num_refused=num_refused)


def _check_scene(scene: Scene, earlier_scenes: dict[str, Scene], categories: tuple[str, ...], source: str) -> None:
    """Refuse a scene without categories, or of an earlier name."""
    location = f"{source}, scene {scene.name!r}"
    if scene.name in earlier_scenes:
        raise InputError(f"{location}: name is that of an earlier scene; import the two scenes into separate files")

    # Without an object of the vocabulary there is neither a goal nor anything to detect.
    if max(category_ids(scene.types, categories), default=-1) < 0:
        known_names = ", ".join(categories)
        raise InputError(
            f"{location}: no object has a known type; known types are {known_names} (see --world and --categories)"
        )


def _fits_any(scene_name: str, name_patterns: tuple[str, ...]) -> bool:
    return any(fnmatch.fnmatchcase(scene_name, pattern) for pattern in name_patterns)
