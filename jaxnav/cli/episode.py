"""The episode command: one evaluation episode of a trained run as a picture."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console

from jaxnav.cli.console import exit_code
from jaxnav.env.types import State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.playback import play
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.acting import Acting
from jaxnav.runs.directory import load_run
from jaxnav.runs.policies import load_policies
from jaxnav.runs.worlds import evaluation_world
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.viz.episode import Episode, draw_episode


@dataclasses.dataclass(frozen=True)
class EpisodeConfig:
    """A picture of one episode of a training run.

    Attributes:
      run: the run directory; its first seed acts, with the best action at every step.
      split: scenes to play in.
      index: of the episode in the list that `eval.py` fixes by default (of the first shard, where scenes are streamed).
      out: GIF (moving) or PNG (its end); default: episode.gif in the run directory.
      variant: `stde` takes experience out where the gap exceeds epsilon, `layout` keeps it, `baseline` has no layout.
      epsilon: threshold of sTDE.
      scenes: scene file to read instead of the run's own world or file.
      shift: layout shift of the scenes, from 0 to 1; default: the run's.
    """

    run: Annotated[Path, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    index: int = 0
    out: Path | None = None
    variant: Literal["stde", "layout", "baseline"] = "stde"
    epsilon: float = 0.5
    scenes: Path | None = None
    shift: float | None = None


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    config = tyro.cli(EpisodeConfig, args=arguments, prog="jaxnav episode", description="Draw one episode.")
    return exit_code(lambda console: draw(config, console))


def draw(config: EpisodeConfig, console: Console) -> None:
    """Play the episode and write its picture."""
    target = config.out or config.run / "episode.gif"
    if target.suffix not in (".gif", ".png"):
        raise InputError(f"--out {target}: give a name that ends in .gif or .png")
    episode = play_episode(config, console)
    draw_episode(episode, target)
    console.print(f"{len(episode.trace.pose)} steps; written to {target}", soft_wrap=True)


def play_episode(config: EpisodeConfig, console: Console) -> Episode:
    """Play the episode.

    Raises:
      InputError: no finished run, no such episode, or an impossible epsilon.
    """
    run = load_run(config.run)
    policies = load_policies(run)
    world = evaluation_world(run, config.split, config.scenes, config.shift, console)
    bank = world.banks[0]
    episodes = episode_list(bank)
    if not 0 <= config.index < len(episodes.goal):
        raise InputError(f"--index {config.index}: give a number from 0 to {len(episodes.goal) - 1}")
    index, goal = episodes.scene[config.index], episodes.goal[config.index]
    start = State(pose=episodes.pose[config.index], scene=index, goal=goal, time=jnp.int32(0))
    form = policies.setting.form
    epsilon = config.epsilon if config.variant == "stde" else None
    cell = inference_grid([table_row(config.variant, epsilon, form, "argmax")], run.seeds)
    cell = jax.tree.map(lambda leaf: leaf[0], cell)
    trace = play(
        cell,
        jax.tree.map(lambda leaf: leaf[cell.params], policies.params),
        start,
        Acting(world.env, policies.setting),
        policies.spec,
        world.params(0),
        policies.priors,
    )
    scenes = (world.scenes[i] for i in range(len(world.scenes)))
    scene = next(scene for scene in scenes if scene.name == bank.names[index])
    cells = cell_centres(scene, standable_cells(scene.reach))
    title = {"stde": f" with layout and sTDE, epsilon {config.epsilon:g}", "layout": " with layout", "baseline": ""}
    return Episode(
        trace=trace,
        scene=scene,
        places=cells[trace.pose // bank.task.rules.poses_per_cell - bank.first_cell[index]],
        rows=bank.rows[trace.pose],
        task=bank.task,
        goal=int(goal),
        best_length=int(episodes.best_length[config.index]),
        epsilon=float("inf") if epsilon is None else epsilon,
        title=f"{policies.spec.method.upper()}{title[config.variant]}  ·  {scene.name}",
    )
