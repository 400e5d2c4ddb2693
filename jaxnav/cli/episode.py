"""The episode command: draw one evaluation episode, or the map that a searching agent made in it."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.runs.policies import EstimatorName, is_policy
from jaxnav.viz import require_plotting_packages


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
    """Run the command and return its exit code."""
    config = parse_arguments(EpisodeConfig, arguments, "jaxnav episode", "Draw one episode.")
    return run_command(lambda console: _draw(config, console))


def _draw(config: EpisodeConfig, console: Console) -> None:
    """Play the episode and write its picture."""
    require_plotting_packages()
    from jaxnav.viz.episode import draw_episode, play_episode
    from jaxnav.viz.search import draw_search, take_snapshot

    # Check the options before anything is played.
    path = config.out or _default_path(config)
    suffixes = (".png",) if config.map else (".gif", ".png")
    if path.suffix not in suffixes:
        raise InputError(f"--out {path}: give a name that ends in {' or '.join(suffixes)}")
    if config.step is not None and not config.map:
        raise InputError(f"--step {config.step}: is for the map; give --map too")
    if config.map and len(config.shift) > 1:
        raise InputError("--map: is drawn at one layout shift; give one --shift")

    episodes = play_episode(
        config.source,
        split=config.split,
        index=config.index,
        variant=config.variant,
        epsilon=config.epsilon,
        estimator=config.setting,
        scenes=config.scenes,
        shifts=config.shift or (None,),
        console=console,
    )
    num_steps = max(len(episode.trace.pose) for episode in episodes)
    if config.map:
        # Steps are counted from 1 in the option, from 0 in the trace.
        step = (num_steps if config.step is None else config.step) - 1
        draw_search(episodes[0], take_snapshot(episodes[0], step), step, path)
    else:
        draw_episode(episodes, path)
    console.print(f"{num_steps} steps; written to {path}")


def _default_path(config: EpisodeConfig) -> Path:
    """Return the picture's path in the run directory or, for a policy, in the working directory."""
    folder = Path() if is_policy(config.source) else Path(config.source)
    return folder / ("map.png" if config.map else "episode.gif")
