"""The scenes commands: import scenes to a file, show one as a picture, print statistics of a file."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from jaxnav.cli.console import escape_parser_output, make_result_console, refuse_unwritable, run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.scene_statistics import compute_scene_statistics
from jaxnav.runs.policies import load_policies
from jaxnav.runs.run import load_run_config
from jaxnav.scenes.categories import format_most_common
from jaxnav.scenes.files.importing import (
    ImportSummary,
    SceneFormat,
    SceneSplit,
    filter_scenes,
    import_scenes,
    read_source,
)
from jaxnav.scenes.worlds import WORLDS, SceneSource
from jaxnav.viz import require_plotting_packages
from jaxnav.viz.scene_tables import scene_remarks, scene_tables


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
      room_types: of the scenes to keep, such as `house`; default: all.
      largest: cells along the longer side of the largest scene to keep (`shape` in the file); default: any.
      world: world whose vocabulary the types are compared with; default: that which the scenes stand for.
      categories: vocabulary to compare with instead.
      assets: asset database of ProcTHOR (`procthor/databases/asset-database.json` of github.com/allenai/procthor), for
        types and sizes.
      agent_part: of ProcTHOR houses only what is connected with the agent's place in the file, instead of the largest
        connected part.
      maps: semantic floor maps for Habitat episodes (`*_info.pbz2`).
      from_controller: read from an installed `ai2thor` simulator instead of from files.
      base: scene file with the rooms that re-placements are of.
    """

    format: SceneFormat
    source: str
    out: Path
    split: SceneSplit = "train"
    val: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    room_types: tuple[str, ...] = ()
    largest: int | None = None
    world: Literal["rooms", "apartments", "houses"] | None = None
    categories: tuple[str, ...] | None = None
    assets: Path | None = None
    agent_part: bool = False
    maps: Path | None = None
    from_controller: bool = False
    base: Path | None = None


@dataclasses.dataclass(frozen=True)
class ShowConfig(SceneSource):
    """Draw a picture of one scene.

    Attributes:
      scene: name of the scene; default: the first.
      index: its number instead, from 0; a generated world also has scenes beyond its usual number.
      pose: x and z in metres and heading in degrees of the level camera; default: what detects most categories.
      out: PNG to write; default: the scene's name in the working directory.
    """

    scene: str | None = None
    index: int | None = None
    pose: tuple[float, float, float] | None = None
    out: Path | None = None


@dataclasses.dataclass(frozen=True)
class StatsConfig(SceneSource):
    """Print statistics of scenes.

    Attributes:
      run: a finished run; its categories and rules count, and the scenes are compared with its layout priors.
    """

    run: Path | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    with escape_parser_output():
        config = tyro.extras.subcommand_cli_from_dict(
            {"import": ImportConfig, "show": ShowConfig, "stats": StatsConfig},
            args=arguments,
            prog="jaxnav scenes",
            config=(tyro.conf.PositionalRequiredArgs,),
        )
    if isinstance(config, ImportConfig):
        return run_command(lambda console: _import(config, console))
    if isinstance(config, ShowConfig):
        return run_command(lambda console: _show(config, console))
    return run_command(lambda console: _print_statistics(config, console))


def _import(config: ImportConfig, console: Console) -> None:
    """Import scenes, and print which were refused and which objects are of unknown types."""

    def report_refusal(error: InputError) -> None:
        console.print(f"refused: {error}", style="yellow")

    # Read and select the scenes, and write them by split.
    scenes = read_source(
        config.format,
        config.source,
        config.split,
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

    # Print guesses and omissions line by line; the last line counts the scenes.
    for warning in _import_warnings(summary):
        console.print(warning, style="yellow")
    if summary.unknown_type_counts:
        num_objects = summary.unknown_type_counts.total()
        types = format_most_common(summary.unknown_type_counts)
        console.print(f"objects of unknown types, which only block the sight: {num_objects:,}, of them {types}")
    counts = f"{len(summary.scenes)} scenes imported, {summary.num_refused} refused"
    console.print(f"{counts}; written to {config.out}")


def _import_warnings(summary: ImportSummary) -> Iterator[str]:
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
    require_plotting_packages()
    from jaxnav.viz.scene import draw_scene

    # Pictures of one scene at two layout shifts have different names.
    scene = config.select_scene(config.scene, config.index)
    shift_suffix = f"-shift-{config.shift:g}" if config.shift else ""
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
    # The run or the world gives categories and rules; only a run has layout priors.
    if config.run and config.world:
        raise InputError("--world, --run: both are given, but the run has a world; leave --world out")
    run_config = load_run_config(config.run) if config.run else None
    if run_config:
        task = run_config.task
        world = run_config.world
        priors = np.asarray(load_policies(run_config).knowledge.layout, np.float64)
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
        result_console.print(table, "")
    for remark in scene_remarks(statistics, task):
        result_console.print(remark)
