"""The scenes commands: import scenes to a file, show one as a picture, print statistics of a file."""

import dataclasses
import difflib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from jaxnav.choices import Split, WorldName
from jaxnav.cli.console import (
    HELP_OPTIONS,
    make_result_console,
    parse_arguments,
    print_table,
    refuse_unwritable,
    run_command,
)
from jaxnav.errors import InputError
from jaxnav.plain_console import escape_control_chars
from jaxnav.scenes.files.importing import SceneFormat
from jaxnav.scenes.worlds import WORLDS, SceneSource

if TYPE_CHECKING:
    from jaxnav.scenes.files.importing import ImportSummary


#: An import prints this many refused scenes, and counts the rest.
MAX_PRINTED_REFUSALS = 10


@dataclasses.dataclass(frozen=True)
class ImportConfig:
    """Options of the scenes import command.

    Attributes:
      format: format of the source. `procthor`: houses as JSON or JSON lines. `ai2thor`: metadata of the controller with
        reachable positions, a file or a folder of files. `scene-data`: the offline folders of SAVN, ORG and L-sTDE.
        `habitat`: an ObjectNav split or one of its files. `replacements`: places of movable objects in the rooms of
        `--base`. `scenes`: a scene file, to divide it into splits.
      source: file or folder to read; with `--from-controller`, names of scenes, separated by commas.
      out: scene file to write (`*.jsonl.gz`). A file with other scenes is never replaced.
      split: split of the scenes that match none of the patterns `--val` and `--test`. By default, scenes of a scene
        file keep their split, and all others are of split train.
      val: patterns of scene names, such as `FloorPlan_Val1_*`, that become the split val.
      test: patterns of scene names that become the split test.
      room_types: room types of the scenes to keep, such as `house`. The default is all.
      largest: largest number of cells along the longer side of a scene to keep. The default is any number.
      world: world whose categories are compared with the object types. By default, the scenes decide.
      categories: categories to compare with the object types, instead of those of a world.
      assets: asset database of ProcTHOR (`procthor/databases/asset-database.json` of github.com/allenai/procthor), for
        types and sizes of objects.
      agent_part: keep only the part of a ProcTHOR house that is connected with the agent's position in the file. By
        default, the largest connected part is kept.
      maps: semantic floor maps for Habitat episodes (`*_info.pbz2`).
      from_controller: read from an installed `ai2thor` simulator instead of files.
      base: scene file with the rooms in which objects are placed again, for `replacements`.
    """

    format: SceneFormat
    source: str
    out: Path
    split: Split | None = None
    val: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    room_types: tuple[str, ...] = ()
    largest: int | None = None
    world: WorldName | None = None
    categories: tuple[str, ...] | None = None
    assets: Path | None = None
    agent_part: bool = False
    maps: Path | None = None
    from_controller: bool = False
    base: Path | None = None


@dataclasses.dataclass(frozen=True)
class ShowConfig(SceneSource):
    """Options of the scenes show command.

    Attributes:
      scene: name of the scene to draw. The default is the first scene.
      index: number of the scene to draw, from 0, instead of its name.
      pose: x and z in metres and the heading in degrees of the camera, which looks level. The default is the pose from
        which the most categories are detected.
      out: PNG to write. The default is the name of the scene, in the working directory.
    """

    scene: str | None = None
    index: int | None = None
    pose: tuple[float, float, float] | None = None
    out: Path | None = None


@dataclasses.dataclass(frozen=True)
class StatsConfig(SceneSource):
    """Options of the scenes stats command.

    Attributes:
      run: run directory of a finished training. Its categories and rules are used, and the scenes are compared with its
        layout priors.
    """

    run: Path | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command that the first argument names and return its exit code; 2 for an unknown one."""
    name, *command_arguments = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in HELP_OPTIONS:
        print(_HELP)
        return 0
    if name not in COMMANDS:
        matches = difflib.get_close_matches(name, COMMANDS, n=1)
        advice = f"did you mean {matches[0]!r}?" if matches else f"choose one of {', '.join(COMMANDS)}"
        print(escape_control_chars(f"error: scenes: unknown command {name!r}; {advice}"), file=sys.stderr)
        return 2

    kind, command, summary = COMMANDS[name]
    description = f"{summary[0].upper()}{summary[1:]}."
    return run_command(command, lambda: parse_arguments(kind, command_arguments, f"jaxnav scenes {name}", description))


def _import(config: ImportConfig, console: Console) -> None:
    """Import scenes, and print which were refused and which objects are of unknown types."""
    from jaxnav.scenes.categories import format_most_common
    from jaxnav.scenes.files.importing import filter_scenes, import_scenes, read_source

    refusals: list[InputError] = []

    def report_refusal(error: InputError) -> None:
        """Print the first refusals; a file of another format may have thousands."""
        refusals.append(error)
        if len(refusals) <= MAX_PRINTED_REFUSALS:
            console.print(f"refused: {error}", style="yellow")
        elif len(refusals) == MAX_PRINTED_REFUSALS + 1:
            console.print("refused: further scenes, which are only counted", style="yellow")

    # Read and select the scenes, and write them by split.
    scenes = read_source(
        config.format,
        config.source,
        config.split or "train",
        assets=config.assets,
        maps=config.maps,
        from_controller=config.from_controller,
        base=config.base,
        agent_part=config.agent_part,
    )
    categories = config.categories
    if not categories and config.world:
        categories = WORLDS[config.world].task.categories
    scenes = filter_scenes(scenes, config.room_types, config.largest)
    summary = import_scenes(
        scenes, config.source, config.out, config.split, config.val, config.test, categories or None, report_refusal
    )

    # Print what was read, guesses and omissions line by line; the last line counts the scenes.
    for import_count in summary.account.values():
        console.print(str(import_count))
    for warning in _import_warnings(summary):
        console.print(warning, style="yellow")
    if summary.unknown_type_counts:
        num_objects = summary.unknown_type_counts.total()
        types = format_most_common(summary.unknown_type_counts)
        console.print(f"objects of unknown types, which only block the sight: {num_objects:,}, of them {types}")
    counts = f"{len(summary.scenes)} scenes imported, {summary.num_refused} refused"
    console.print(f"{counts}; written to {config.out}")


def _import_warnings(summary: "ImportSummary") -> Iterator[str]:
    """Yield a line for each kind of values guessed, objects moved or cells skipped by an import."""
    for text, count in summary.notes.items():
        yield f"{count:,} {text}"

    unconnected = summary.unconnected_cell_counts
    if unconnected:
        num_cells = {name: int(scene.reach.sum()) for name, scene in summary.scenes.items()}
        ((worst_scene, worst_count),) = unconnected.most_common(1)
        yield (
            f"{unconnected.total():,} of {sum(num_cells.values()):,} cells in {len(unconnected)} scenes are not "
            "connected with the largest part and not used; "
            f"most in {worst_scene}, {worst_count} of {num_cells[worst_scene]}"
        )


def _show(config: ShowConfig, console: Console) -> None:
    """Draw a scene and write the picture."""
    from jaxnav.viz import require_plotting_packages

    require_plotting_packages()
    from jaxnav.viz.scene import draw_scene

    # Pictures of one scene in different layouts have different names.
    scene = config.select_scene(config.scene, config.index)
    shift_suffix = ""
    if config.shift:
        shift_suffix = f"-shift-{config.shift:g}"
        if config.shift_by != ShowConfig.shift_by:
            shift_suffix += f"-by-{config.shift_by}"
        if config.seed != ShowConfig.seed:
            shift_suffix += f"-seed-{config.seed}"
    path = config.out or Path(re.sub(r"[^\w.-]", "_", scene.name) + shift_suffix + ".png")
    if path.suffix != ".png":
        raise InputError(f"--out {path}: give a name that ends in .png")
    with refuse_unwritable(f"--out {path}", "name"):
        draw_scene(scene, config.task, path, config.pose, config.shift)
    if config.file in WORLDS:
        _warn_beyond_usual_number(config, console)
    console.print(f"{scene.name} at layout shift {config.shift:g}, drawn by the rules of {config.world_name}")
    console.print(f"written to {path}")


def _warn_beyond_usual_number(config: ShowConfig, console: Console) -> None:
    """Print a line if the index lies beyond the scenes that training and evaluation use by default."""
    split = config.split or "val"
    usual_number = WORLDS[config.file].counts[split]
    if config.index is not None and config.index >= usual_number:
        console.print(
            f"--index {config.index}: {config.file} has {usual_number} scenes of {split} by default; a run uses this "
            f"scene only with --worlds.num-{split} {config.index + 1} or more",
            style="yellow",
        )


def _print_statistics(config: StatsConfig, console: Console) -> None:
    """Compile the scenes of a file and print their statistics."""
    import numpy as np
    from rich.progress import track

    from jaxnav.evaluation.scene_statistics import compute_scene_statistics
    from jaxnav.runs.policies import load_policies
    from jaxnav.runs.run import load_run_config
    from jaxnav.viz.scene_tables import scene_remarks, scene_tables

    # The run or the world gives categories and rules; only a run has layout priors.
    if config.run and config.world:
        raise InputError("--world, --run: both are given, but the run has a world; omit --world")
    run_config = load_run_config(config.run) if config.run else None
    if run_config:
        task = run_config.task
        world = run_config.world
        priors = np.asarray(load_policies(run_config).knowledge.priors, np.float64)
    else:
        task = config.task
        world = config.world_name
        priors = None

    # Compile scene by scene, with a progress bar.
    scenes = config.open(task)
    scene_iterator = (scenes[index] for index in range(len(scenes)))
    scenes_with_progress = track(
        scene_iterator, "compiling", len(scenes), console=console, transient=True, disable=not console.is_terminal
    )
    statistics = [compute_scene_statistics(scene, task) for scene in scenes_with_progress]

    result_console = make_result_console()
    result_console.print(f"{config.file}: {len(statistics)} scenes, by the categories and rules of {world}")
    for title, table in scene_tables(statistics, task, priors).items():
        result_console.print(title, style="bold")
        print_table(result_console, table)
        result_console.print()
    for remark in scene_remarks(statistics, task):
        result_console.print(remark)


#: Options, function and summary of each command.
COMMANDS: dict[str, tuple[type, Callable[[Any, Console], None], str]] = {
    "import": (ImportConfig, _import, "import scenes of a simulator or dataset to a scene file"),
    "show": (ShowConfig, _show, "draw a picture of one scene"),
    "stats": (StatsConfig, _print_statistics, "print statistics of scenes"),
}

_HELP = (
    "usage: jaxnav scenes COMMAND [OPTIONS]\n\n"
    + "".join(f"  {name:11} {summary}\n" for name, (_, _, summary) in COMMANDS.items())
    + "\nEach has its own help: jaxnav scenes COMMAND --help"
)
