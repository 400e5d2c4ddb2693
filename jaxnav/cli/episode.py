"""The episode command: draw one evaluation episode, or the map that a searching agent made in it."""

import dataclasses
from pathlib import Path

from rich.console import Console

from jaxnav.choices import EstimatorName, PlayedVariant, ShiftKind, Split
from jaxnav.cli.console import parse_arguments, run_command
from jaxnav.errors import InputError
from jaxnav.progress import show_activity
from jaxnav.store.files import expand_home

DESCRIPTION = "Draw one evaluation episode as a GIF or a PNG."


@dataclasses.dataclass(frozen=True)
class EpisodeConfig:
    """Options of the episode command.

    Attributes:
      source: run directory, folder of an exported policy, or name of a packaged policy, such as `rooms-org`. The first
        seed acts, and takes the best action at each step.
      split: scenes to play in.
      index: number of the episode, from 0, in the list of 1,000 episodes of `jaxnav eval`. If scenes are streamed, this
        is the list of the first shard.
      out: GIF to write, with at most 60 frames, or PNG, which shows the end. The default is `episode.gif` (with
        `--map`, `map.png`) in the run directory or, for a policy, in the working directory.
      variant: uses of the experience, with a row of panels for each. `stde` removes it where the layout gap exceeds
        epsilon, `scde` does so towards the decision without experience (for runs with `--ppo.experience` below 1),
        `layout` never removes it, and `baseline` has no layout weights.
      epsilon: threshold of the removal, at least 0.
      setting: layout estimator to use instead of that of the run; `jaxnav list settings` describes them.
      scenes: scene file to use instead of the scenes of the run.
      shift: layout shifts of the scenes, each from 0 (as in training) to 1, with one panel for each. The default is the
        shift of the run. With several shifts or variants, all episodes of the list are played and the numbers of
        successes are printed.
      shift_by: categories that exchange their places under a shift. `size`: neighbours in size, drawn for each scene.
        `context`: the ones whose exchange misleads most, fitted to the training scenes and equal in all scenes.
      map: draw the agent's map, its target and its planned path, with a row for each `--shift`; for the method `belief`
        also the probability of the goal, before and after the removal of experience. This needs a method that searches
        with a map (`semexp`, `belief`), and writes a PNG.
      step: step at which the map is drawn, from 1. Shorter episodes show their end. The default is the last step.
    """

    source: str
    split: Split = "val"
    index: int = 0
    out: Path | None = None
    variant: tuple[PlayedVariant, ...] = ("stde",)
    epsilon: float = 0.5
    setting: EstimatorName | None = None
    scenes: Path | None = None
    shift: tuple[float, ...] = ()
    shift_by: ShiftKind = "size"
    map: bool = False
    step: int | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(_draw, lambda: parse_arguments(EpisodeConfig, arguments, "jaxnav episode", DESCRIPTION))


def _draw(config: EpisodeConfig, console: Console) -> None:
    """Play the episode and write its picture."""
    from jaxnav.viz import require_plotting_packages

    require_plotting_packages()
    from jaxnav.viz.episode import draw_episode, play_episode
    from jaxnav.viz.search import draw_search, take_snapshot

    # Check the options before anything is played.
    path = config.out or _default_path(config)
    suffixes = (".png",) if config.map else (".gif", ".png")
    if path.suffix not in suffixes:
        raise InputError(f"--out {path}: give a name that ends in {' or '.join(suffixes)}")
    if config.step is not None and not config.map:
        raise InputError(f"--step {config.step}: applies to the map only; add --map")
    if not config.variant or len(set(config.variant)) < len(config.variant):
        raise InputError(f"--variant {' '.join(config.variant)}: give one or more different variants")
    if len(set(config.shift)) < len(config.shift):
        raise InputError(f"--shift {' '.join(map(str, config.shift))}: give different shifts")
    if config.map and len(config.variant) > 1:
        raise InputError("--map: the map is drawn of one variant; give one --variant")

    episodes = play_episode(
        config.source,
        split=config.split,
        index=config.index,
        variants=config.variant,
        epsilon=config.epsilon,
        estimator=config.setting,
        scenes=config.scenes,
        shifts=config.shift or (None,),
        shift_by=config.shift_by,
        console=console,
    )
    num_steps = max(len(episode.trace.pose) for episode in episodes)
    if config.map:
        # Steps are counted from 1 in the option, from 0 in the trace.
        step = (num_steps if config.step is None else config.step) - 1
        if not 0 <= step < num_steps:
            raise InputError(f"--step {step + 1}: give a number from 1 to {num_steps}")
        with show_activity(console, "drawing the map"):
            snapshots = [take_snapshot(episode, min(step, len(episode.trace.pose) - 1)) for episode in episodes]
            draw_search(episodes, snapshots, step, path)
    else:
        with show_activity(console, "drawing the episode"):
            draw_episode(episodes, path)
    console.print(f"{num_steps} steps; written to {path}")


def _default_path(config: EpisodeConfig) -> Path:
    """Return the picture's path in the run directory or, for a policy, in the working directory."""
    from jaxnav.runs.policies import is_policy

    folder = Path() if is_policy(config.source) else expand_home(config.source)
    return folder / ("map.png" if config.map else "episode.gif")
