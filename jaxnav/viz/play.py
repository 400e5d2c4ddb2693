"""One evaluation episode of a finished run, step by step."""

from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.variants import table_row
from jaxnav.runs.directory import load_run
from jaxnav.runs.policies import EstimatorName, load_policies
from jaxnav.runs.replay import replay, scene_named
from jaxnav.runs.worlds import evaluation_world
from jaxnav.scenes.lattice import standable_cells
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
    form = None if policies.setting is None else policies.setting.form
    chosen = episodes.take(np.array([index]))
    (trace,) = replay(policies, world, chosen, table_row(variant, threshold, form, "argmax"))
    scene = scene_named(world, bank.names[episodes.scene[index]])
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
        policies=policies,
    )
