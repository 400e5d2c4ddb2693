"""One evaluation episode of a finished run, step by step."""

from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.env.types import State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.playback import Trace, play
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.runs.directory import load_run
from jaxnav.runs.policies import EstimatorName, Policies, load_policies
from jaxnav.runs.worlds import CompiledWorld, evaluation_world
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.viz.episode import Episode

Variant = Literal["stde", "layout", "baseline"]


def play_episode(
    run: Path,
    split: str = "val",
    index: int = 0,
    variant: Variant = "stde",
    epsilon: float = 0.5,
    setting: EstimatorName | None = None,
    scenes: Path | None = None,
    shift: float | None = None,
    console: Console | None = None,
) -> Episode:
    """Play one episode of a run's evaluation.

    The first seed acts, with the best action at every step.

    Args:
      run: directory of a finished run.
      split: scenes to play in.
      index: of the episode in the default list of an evaluation (of the first shard, where scenes are streamed).
      variant: `stde` removes experience where the gap exceeds epsilon, `layout` keeps it, `baseline` has no layout.
      epsilon: threshold of sTDE, at least 0.
      setting: layout estimator to use instead of the run's; see `Policies.estimating`.
      scenes: scene file to read instead of the run's world or file.
      shift: layout shift of the scenes, from 0 to 1; None for the run's.
      console: gets messages about the scenes; None for silence.

    Raises:
      InputError: no finished run, no such episode, or an impossible epsilon.
    """
    settings = load_run(run)
    arm = "baseline" if variant == "baseline" else "layout"
    policies = load_policies(settings, settings.arms if arm in settings.arms else (arm,)).estimating(setting)
    world = evaluation_world(settings, split, scenes, shift, console or Console(quiet=True))
    bank = world.banks[0]
    episodes = episode_list(bank)
    if not 0 <= index < len(episodes.goal):
        raise InputError(f"--index {index}: give a number from 0 to {len(episodes.goal) - 1}")
    threshold = epsilon if variant == "stde" else None
    trace = _trace(policies, world, episodes, index, variant, threshold)
    scene = _scene(world, bank.names[episodes.scene[index]])
    cells = trace.pose // bank.task.rules.poses_per_cell - bank.first_cell[episodes.scene[index]]
    title = {"stde": f" with layout and sTDE, epsilon {epsilon:g}", "layout": " with layout", "baseline": ""}
    return Episode(
        trace=trace,
        scene=scene,
        places=cell_centres(scene, standable_cells(scene.reach))[cells],
        rows=bank.rows[trace.pose],
        task=bank.task,
        goal=int(episodes.goal[index]),
        best_length=int(episodes.best_length[index]),
        epsilon=np.inf if threshold is None else threshold,
        title=f"{policies.spec.method.upper()}{title[variant]}  ·  {scene.name}",
    )


def _trace(
    policies: Policies,
    world: CompiledWorld,
    episodes: EpisodeList,
    index: int,
    variant: Variant,
    epsilon: float | None,
) -> Trace:
    """Play an episode of the first bank, first seed."""
    pose, scene, goal = episodes.pose[index], episodes.scene[index], episodes.goal[index]
    form = None if policies.setting is None else policies.setting.form
    row = table_row(variant, epsilon, form, "argmax")
    inference = jax.tree.map(lambda leaf: leaf[0], inference_grid([row], policies.arms, policies.seeds))
    return play(
        inference,
        jax.tree.map(lambda leaf: leaf[inference.params], policies.params),
        State(pose=pose, scene=scene, goal=goal, time=jnp.int32(0)),
        policies.acting(world.env),
        world.params(0),
        policies.knowledge,
    )


def _scene(world: CompiledWorld, name: str) -> Scene:
    scenes = (world.scenes[i] for i in range(len(world.scenes)))
    return next(scene for scene in scenes if scene.name == name)
