"""The sweep: every epsilon and every seed in one compiled call."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import together
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.variants import table_row
from jaxnav.runs.directory import Run
from jaxnav.runs.evaluate import check_seed, run_rows
from jaxnav.runs.worlds import evaluation_world


class Sweep(NamedTuple):
    """Hold a sweep over X thresholds, S seeds, E episodes.

    Attributes:
      epsilon: float64 [X].
      sr, spl: float64 [X, S, E], in [0, 1].
      dts: float64 [X, S, E], metres.
      outcome: how the episodes went, leaves [X, S, E].
      compilations: that it took; 1 where the scenes are in memory.
    """

    epsilon: np.ndarray
    sr: np.ndarray
    spl: np.ndarray
    dts: np.ndarray
    outcome: Outcome
    compilations: int


def sweep(
    run: Run,
    epsilon: Sequence[float] | np.ndarray,
    params: Any = None,
    *,
    split: str = "val",
    scenes: Path | None = None,
    shift: float | None = None,
    episodes: int = 1000,
    decoding: Decoding = "argmax",
    form: Form | None = None,
    seed: int = 0,
) -> Sweep:
    """Evaluate every threshold and seed in one compiled call.

    Args:
      run: a finished run with the arm `layout`.
      epsilon: thresholds [X]; at 1 or more nothing is removed.
      params: parameters of your own, leaves [S, ...]; None for the run's.
      split, scenes, shift, episodes, form, seed: as in `jaxnav.evaluate`.
      decoding: `argmax` for best actions, `sample` for sampled ones.

    Raises:
      InputError: no finished run, a run without the arm `layout`, or an impossible argument.
    """
    check_seed(seed)
    policies = run.policies(("layout",))
    if policies.setting is None:
        raise InputError(f"{run.config.run_dir}: its layout arm has no layout setting; train the run anew")
    if not len(epsilon):
        raise InputError("epsilon: give at least one number")
    form = policies.setting.form if form is None else form
    arms, params = run.config.arms, policies.params if params is None else params
    # Random numbers depend on the place of the parameters: once for every arm, they stand where `evaluate` has them.
    stacked = jax.tree.map(lambda leaf: jnp.concatenate([jnp.asarray(leaf)] * len(arms)), params)
    policies = policies._replace(params=stacked, arms=arms)
    rows = [table_row("stde", float(threshold), form, decoding) for threshold in epsilon]
    world = evaluation_world(run.config, split, scenes, shift, Console(quiet=True))
    lists, outcome, compilations = run_rows(rows, policies, world, episodes, seed)
    metrics = episode_metrics(outcome, together(lists).best_length)
    sr, spl, dts = (metrics[name] for name in ("sr", "spl", "dts"))
    return Sweep(np.asarray(epsilon, np.float64), sr, spl, dts, outcome, compilations)
