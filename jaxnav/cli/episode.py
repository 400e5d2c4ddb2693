"""The episode command: one evaluation episode as a picture."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import command_line, exit_code
from jaxnav.errors import InputError
from jaxnav.runs.packaged import is_policy
from jaxnav.runs.policies import EstimatorName
from jaxnav.viz import require_pictures


@dataclasses.dataclass(frozen=True)
class EpisodeConfig:
    """Draw one episode, at one or several layout shifts side by side.

    Attributes:
      source: a run directory, the folder of an exported policy, or a policy of the package (`rooms-org`). The first
        seed acts, with the best action at every step.
      split: scenes to play in.
      index: of the episode in the default list of an evaluation (of the first shard, where scenes are streamed).
      out: GIF (moving) or PNG (its end); default: episode.gif in the run directory or, of a policy, here.
      variant: `stde` takes experience out where the gap exceeds epsilon, `layout` keeps it, `baseline` has no layout.
      epsilon: threshold of sTDE.
      setting: layout estimator to use instead of the run's, as of `eval`.
      scenes: scene file to read instead of the run's own world or file.
      shift: layout shifts of the scenes, from 0 to 1, a panel each; default: the run's. With several, all episodes of
        the list are played, and how many are found where is told.
      map: draw what the agent's own map holds instead, the block it chose and its way there (PNG; methods that search
        with a map).
      step: at which the map is drawn, from 1; default: the last.
    """

    source: Annotated[str, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    index: int = 0
    out: Path | None = None
    variant: Literal["stde", "layout", "baseline"] = "stde"
    epsilon: float = 0.5
    setting: EstimatorName | None = None
    scenes: Path | None = None
    shift: tuple[float, ...] = ()
    map: bool = False
    step: int | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 0, or 2 after bad input."""
    config = command_line(EpisodeConfig, arguments, "jaxnav episode", "Draw one episode.")
    return exit_code(lambda console: draw(config, console))


def draw(config: EpisodeConfig, console: Console) -> None:
    """Play the episode and write its picture."""
    require_pictures()
    from jaxnav.viz.episode import draw_episode
    from jaxnav.viz.play import play_episode
    from jaxnav.viz.search import search_at
    from jaxnav.viz.search_map import draw_search

    name, endings = ("map.png", (".png",)) if config.map else ("episode.gif", (".gif", ".png"))
    path = config.out or (Path() if is_policy(config.source) else Path(config.source)) / name
    if path.suffix not in endings:
        raise InputError(f"--out {path}: give a name that ends in {' or '.join(endings)}")
    if config.step is not None and not config.map:
        raise InputError(f"--step {config.step}: is for the map; give --map too")
    if config.map and len(config.shift) > 1:
        raise InputError("--map: is drawn at one layout shift; give one --shift")
    episodes = play_episode(
        config.source,
        config.split,
        config.index,
        config.variant,
        config.epsilon,
        config.setting,
        config.scenes,
        config.shift or (None,),
        console,
    )
    steps = max(len(each.trace.pose) for each in episodes)
    if config.map:
        step = (steps if config.step is None else config.step) - 1
        draw_search(episodes[0], search_at(episodes[0], step), step, path)
    else:
        draw_episode(episodes, path)
    console.print(f"{steps} steps; written to {path}")
