"""The scenes commands: import, show and stats."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from jaxnav.cli.console import exit_code, harmless, result_console
from jaxnav.errors import InputError
from jaxnav.evaluation.scene_statistics import scene_statistics
from jaxnav.runs.directory import load_run
from jaxnav.runs.policies import load_policies
from jaxnav.scenes.categories import most_common
from jaxnav.scenes.files.importing import Format, ImportSummary, Split, import_scenes, read_format, select
from jaxnav.scenes.sources import SceneSource
from jaxnav.scenes.worlds import WORLDS
from jaxnav.viz import require_pictures
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

    format: Format
    source: str
    out: Path
    split: Split = "train"
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
      index: its number instead, from 0.
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
    """Run the command; return 0, or 2 after bad input."""
    with harmless():
        config = tyro.extras.subcommand_cli_from_dict(
            {"import": ImportConfig, "show": ShowConfig, "stats": StatsConfig},
            args=arguments,
            prog="jaxnav scenes",
            config=(tyro.conf.PositionalRequiredArgs,),
        )
    if isinstance(config, ImportConfig):
        return exit_code(lambda console: convert(config, console))
    if isinstance(config, ShowConfig):
        return exit_code(lambda console: show(config, console))
    return exit_code(lambda console: print_statistics(config, console))


def convert(config: ImportConfig, console: Console) -> None:
    """Import scenes and print what was refused or unknown."""

    def report(error: InputError) -> None:
        console.print(f"refused: {error}", style="yellow")

    scenes = read_format(
        config.format,
        config.source,
        config.split,
        assets=config.assets,
        maps=config.maps,
        from_controller=config.from_controller,
        base=config.base,
        agent_part=config.agent_part,
    )
    categories = config.categories or (WORLDS[config.world].task.categories if config.world else None)
    scenes = select(scenes, config.room_types, config.largest)
    summary = import_scenes(
        scenes, config.source, config.out, config.split, config.val, config.test, categories, report
    )
    for told in _told(summary):
        console.print(told, style="yellow")
    if summary.unknown:
        objects, types = summary.unknown.total(), most_common(summary.unknown)
        told = f"objects of unknown types, which only block the sight: {objects:,}, of them {types}"
        console.print(told)
    counts = f"{len(summary.scenes)} scenes imported, {summary.refused} refused"
    console.print(f"{counts}; written to {config.out}")


def _told(summary: ImportSummary) -> Iterator[str]:
    """Yield what an import guessed, moved or left out."""
    yield from (f"{count:,} {text}" for text, count in summary.notes.items())
    if summary.unconnected:
        cells = {name: int(scene.reach.sum()) for name, scene in summary.scenes.items()}
        ((name, most),) = summary.unconnected.most_common(1)
        yield (
            f"{summary.unconnected.total():,} of {sum(cells.values()):,} cells in {len(summary.unconnected)} scenes "
            f"are not connected with the largest part and not used; most in {name}, {most} of {cells[name]}"
        )


def show(config: ShowConfig, console: Console) -> None:
    """Draw a scene and write the picture."""
    require_pictures()
    from jaxnav.viz.scene import draw_scene

    scene = config.select(config.scene, config.index)
    path = config.out or Path(re.sub(r"[^\w.-]", "_", scene.name) + ".png")
    if path.suffix != ".png":
        raise InputError(f"--out {path}: give a name that ends in .png")
    try:
        draw_scene(scene, config.task, path, config.pose)
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror}); give another name") from error
    console.print(f"{scene.name} drawn by the rules of {config.world_name}")
    console.print(f"written to {path}")


def print_statistics(config: StatsConfig, console: Console) -> None:
    """Print the statistics of scenes."""
    if config.run and config.world:
        raise InputError("--world, --run: both are given, but the run has a world; leave --world out")
    run = load_run(config.run) if config.run else None
    task = run.task if run else config.task
    priors = np.asarray(load_policies(run).knowledge.layout, np.float64) if run else None
    scenes = config.open(task)
    each = (scenes[i] for i in range(len(scenes)))
    bar = track(each, "compiling", len(scenes), console=console, transient=True, disable=not console.is_terminal)
    statistics = [scene_statistics(scene, task) for scene in bar]
    out = result_console()
    world = run.world if run else config.world_name
    out.print(f"{config.file}: {len(statistics)} scenes, by the categories and rules of {world}")
    for title, table in scene_tables(statistics, task, priors).items():
        out.print(title, style="bold")
        out.print(table, "")
    for remark in scene_remarks(statistics, task):
        out.print(remark)
