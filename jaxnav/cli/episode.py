"""The episode command: one evaluation episode as a picture."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import exit_code
from jaxnav.errors import InputError
from jaxnav.runs.policies import EstimatorName
from jaxnav.viz import require_pictures


@dataclasses.dataclass(frozen=True)
class EpisodeConfig:
    """Draw one episode of a training run.

    Attributes:
      run: the run directory; its first seed acts, with the best action at every step.
      split: scenes to play in.
      index: of the episode in the default list of an evaluation (of the first shard, where scenes are streamed).
      out: GIF (moving) or PNG (its end); default: episode.gif in the run directory.
      variant: `stde` takes experience out where the gap exceeds epsilon, `layout` keeps it, `baseline` has no layout.
      epsilon: threshold of sTDE.
      setting: layout estimator to use instead of the run's, as of `eval`.
      scenes: scene file to read instead of the run's own world or file.
      shift: layout shift of the scenes, from 0 to 1; default: the run's.
      map: draw what the agent's own map holds instead, the block it chose and its way there (PNG; methods that search
        with a map).
      step: at which the map is drawn, from 1; default: the last.
    """

    run: Annotated[Path, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    index: int = 0
    out: Path | None = None
    variant: Literal["stde", "layout", "baseline"] = "stde"
    epsilon: float = 0.5
    setting: EstimatorName | None = None
    scenes: Path | None = None
    shift: float | None = None
    map: bool = False
    step: int | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 0, or 2 after bad input."""
    config = tyro.cli(EpisodeConfig, args=arguments, prog="jaxnav episode", description="Draw one episode.")
    return exit_code(lambda console: draw(config, console))


def draw(config: EpisodeConfig, console: Console) -> None:
    """Play the episode and write its picture."""
    require_pictures()
    from jaxnav.viz.episode import draw_episode
    from jaxnav.viz.play import play_episode
    from jaxnav.viz.search import search_at
    from jaxnav.viz.search_map import draw_search

    path = config.out or config.run / ("map.png" if config.map else "episode.gif")
    if path.suffix not in ((".png",) if config.map else (".gif", ".png")):
        raise InputError(f"--out {path}: give a name that ends in {'.png' if config.map else '.gif or .png'}")
    if config.step is not None and not config.map:
        raise InputError(f"--step {config.step}: is for the map; give --map too")
    episode = play_episode(
        config.run,
        config.split,
        config.index,
        config.variant,
        config.epsilon,
        config.setting,
        config.scenes,
        config.shift,
        console,
    )
    if config.map:
        step = len(episode.trace.pose) if config.step is None else config.step
        draw_search(episode, search_at(episode, step - 1), step - 1, path)
    else:
        draw_episode(episode, path)
    console.print(f"{len(episode.trace.pose)} steps; written to {path}", soft_wrap=True)
