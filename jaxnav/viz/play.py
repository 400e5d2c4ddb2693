"""One evaluation episode of a policy, at one or several layout shifts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.playback import Trace
from jaxnav.evaluation.variants import table_row
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import load_run
from jaxnav.runs.packaged import as_run, is_policy
from jaxnav.runs.policies import EstimatorName, Policies, load_policies
from jaxnav.runs.replay import replay, scene_named
from jaxnav.runs.worlds import CompiledWorld, evaluation_shift, evaluation_world
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.viz.panel import Episode

Variant = Literal["stde", "layout", "baseline"]


def play_episode(
    source: str | Path,
    split: str = "val",
    index: int = 0,
    variant: Variant = "stde",
    epsilon: float = 0.5,
    setting: EstimatorName | None = None,
    scenes: Path | None = None,
    shifts: Sequence[float | None] = (None,),
    console: Console | None = None,
) -> list[Episode]:
    """Play one episode of an evaluation, at every layout shift.

    Room, goal and start are the same at every shift. The first seed acts, with the best action at every step. With
    several shifts all episodes of the list are played, and the console gets how many are found where.

    Args:
      source: directory of a finished run, folder of an exported policy, or name of one that comes with the package.
      split: scenes to play in.
      index: of the episode in the default list of an evaluation (of the first shard, where scenes are streamed).
      variant: `stde` removes experience where the gap exceeds epsilon, `layout` keeps it, `baseline` has no layout.
      epsilon: threshold of sTDE, at least 0.
      setting: layout estimator to use instead of the run's; see `Policies.estimating`.
      scenes: scene file to read instead of the run's world or file.
      shifts: layout shifts of the scenes, from 0 to 1; None for the run's.
      console: gets messages; None for silence.

    Raises:
      InputError: no finished run and no policy, no such episode, a goal that cannot be reached at some shift, or an
        impossible epsilon.
    """
    console = console or Console(quiet=True)
    config, policies = _opened(source, "baseline" if variant == "baseline" else "layout")
    policies = policies.estimating(setting)
    worlds = [evaluation_world(config, split, scenes, shift, console) for shift in shifts]
    episodes = episode_list(worlds[0].banks[0])
    if not 0 <= index < len(episodes.goal):
        raise InputError(f"--index {index}: give a number from 0 to {len(episodes.goal) - 1}")
    lists = [_in_world(episodes, world) for world in worlds]
    everywhere = np.all([each.best_length > 0 for each in lists], axis=0)
    if not everywhere[index]:
        raise InputError(f"--index {index}: at some --shift the goal cannot be reached; give another")
    chosen = np.flatnonzero(everywhere) if len(shifts) > 1 else np.array([index])
    form = None if policies.setting is None else policies.setting.form
    row = table_row(variant, epsilon if variant == "stde" else None, form, "argmax")
    traces = [
        replay(policies, *where, row) for where in zip(worlds, (each.take(chosen) for each in lists), strict=True)
    ]
    applied = [evaluation_shift(config, scenes, shift) for shift in shifts]
    if len(shifts) > 1:
        _tell(np.array([[trace.success for trace in each] for each in traces]), applied, console)
    place = int(np.searchsorted(chosen, index))
    title = {"stde": f" with layout and sTDE, epsilon {epsilon:g}", "layout": " with layout", "baseline": ""}
    name = f"{policies.spec.method.upper()}{title[variant]}"
    return [
        _episode(each[place], world, listed, index, np.inf if row.epsilon is None else epsilon, name, shift, policies)
        for each, world, listed, shift in zip(traces, worlds, lists, applied, strict=True)
    ]


def _opened(source: str | Path, arm: str) -> tuple[RunConfig, Policies]:
    """Open a run, or an exported policy."""
    if not is_policy(source):
        config = load_run(Path(source))
        return config, load_policies(config, config.arms if arm in config.arms else (arm,))
    config, policies = as_run(source)
    if arm not in config.arms:
        raise InputError(f"{source}: is a policy of the arm {config.arms[0]!r}; choose another --variant")
    return config, policies


def _in_world(episodes: EpisodeList, world: CompiledWorld) -> EpisodeList:
    """Return the same scenes, goals and starts with the world's L*."""
    return episodes._replace(best_length=world.banks[0].best_length[episodes.pose, episodes.goal])


def _tell(success: np.ndarray, shifts: Sequence[float], console: Console) -> None:
    """Tell how many episodes, bool [shifts, E], are found where."""
    for i, shift in enumerate(shifts):
        alone = success[i] & ~np.delete(success, i, axis=0).any(axis=0)
        console.print(f"shift {shift:g}: {success[i].sum()} of {success.shape[1]} found, {alone.sum()} only there")


def _episode(
    trace: Trace,
    world: CompiledWorld,
    episodes: EpisodeList,
    index: int,
    epsilon: float,
    name: str,
    shift: float,
    policies: Policies,
) -> Episode:
    bank = world.banks[0]
    scene = scene_named(world, bank.names[episodes.scene[index]])
    cells = trace.pose // bank.task.rules.poses_per_cell - bank.first_cell[episodes.scene[index]]
    return Episode(
        trace=trace,
        scene=scene,
        places=cell_centres(scene, standable_cells(scene.reach))[cells],
        rows=bank.rows[trace.pose],
        task=bank.task,
        goal=int(episodes.goal[index]),
        best_length=int(episodes.best_length[index]),
        epsilon=epsilon,
        title=f"{name}  ·  {scene.name}",
        shift=shift,
        policies=policies,
    )
