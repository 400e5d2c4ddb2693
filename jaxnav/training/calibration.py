"""Calibration of the layout estimator on random walks."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.errors import InputError
from jaxnav.layout import Reduction, Setting, prior_from_counts
from jaxnav.policies.acting import Acting, Agent
from jaxnav.policies.methods import Knowledge
from jaxnav.scenes.task import DONE

#: What a gap should be like in the training layouts, after Fig. 6b: large in the first three views that the belief
#: takes in, well under the paper's threshold of 0.5 twenty steps later.
EARLY, LATE, LATE_STEP = 0.75, 0.25, 20
EARLY_VIEWS = 3
STRENGTHS = (5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 56.0, 80.0)
REDUCTIONS: tuple[Reduction, ...] = ("mean_visible", "sum")


def layout_priors(counts: jax.Array, setting: str | Setting) -> jax.Array:
    """Make the layout priors of exploration's counts.

    Every pair starts with one sighting (the all-ones Dirichlet). A room type that training has no scene of gets the
    prior of all its scenes together.

    Args:
      counts: float32 [rooms, K, K], see `Exploration`.
      setting: of the estimator.

    Returns:
      float32 [rooms, K, K], the prior of each room type.
    """
    met = counts.any(axis=(1, 2), keepdims=True)
    counts = jnp.where(met, counts, counts.sum(axis=0, keepdims=True))
    return jax.vmap(lambda room: prior_from_counts(room + 1.0, setting))(counts)


class Calibration(NamedTuple):
    """Hold the chosen setting, and how its gap runs.

    Attributes:
      setting: with the chosen strength and reduction.
      early: median gap of the first three views taken in.
      late: median gap at step 20.
    """

    setting: Setting
    early: float
    late: float


def calibrate(
    env: ObjectNav,
    params: EnvParams,
    counts: jax.Array,
    setting: Setting,
    key: jax.Array,
    strengths: Sequence[float] = STRENGTHS,
    reductions: Sequence[Reduction] = REDUCTIONS,
    num_walks: int = 256,
) -> Calibration:
    """Choose strength and reduction of the estimator.

    The gap is to run as in the paper's Fig. 6b where the layout is as trained. Of all pairs the one with the least
    |early - 0.75| + |late - 0.25| is taken, early and late being medians over the same random walks without Done.

    Args:
      env: the environment.
      params: of the training scenes.
      counts: float32 [rooms, K, K], from `explore`.
      setting: the estimator's other choices.
      key: consumed.
      strengths, reductions: to choose from.
      num_walks: parallel walks.

    Raises:
      InputError: no walk shows two categories together.
    """
    choices = [dataclasses.replace(setting, strength=strength) for strength in strengths]
    priors = jnp.stack([layout_priors(counts, chosen) for chosen in choices])
    calibrations = []
    for reduction in reductions:
        reduced = dataclasses.replace(setting, reduction=reduction)  # the strength only enters by the priors
        gaps = partial(_gaps, reduced, env=env, key=key, num_walks=num_walks)
        early, late = jax.jit(jax.vmap(gaps, (0, None)))(priors, params)
        calibrations += [
            Calibration(dataclasses.replace(reduced, strength=chosen.strength), _median(e), float(np.median(f)))
            for chosen, e, f in zip(choices, np.asarray(early), np.asarray(late), strict=True)
        ]
    if all(np.isnan(one.early) for one in calibrations):
        raise InputError("layout: no random walk shows two categories together, so nothing can be calibrated")
    return min(calibrations, key=lambda one: abs(one.early - EARLY) + abs(one.late - LATE))


def _gaps(
    setting: Setting, priors: jax.Array, params: EnvParams, env: ObjectNav, key: jax.Array, num_walks: int
) -> tuple[jax.Array, jax.Array]:
    """Return mean early gap and late gap, [num_walks].

    The early one is NaN where nothing was accepted.
    """
    start_key, walk_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
    actions = jax.random.randint(walk_key, (LATE_STEP, num_walks), 0, DONE)
    acting, knowledge = Acting(env, setting=setting), Knowledge(priors)

    def alpha(agent: Agent) -> jax.Array:
        assert agent.perceived.layout is not None
        return agent.perceived.layout.alpha

    def step(agent: Agent, action: jax.Array) -> tuple[Agent, tuple[jax.Array, jax.Array]]:
        after, _ = acting.step(agent, action, knowledge, params)
        return after, (acting.gap(after), (alpha(after) != alpha(agent)).any(axis=(1, 2)))

    agent = acting.start(start_key, num_walks, None, knowledge, params)
    prior = priors[params.room[agent.state.scene]]
    first = acting.gap(agent), (alpha(agent) != prior).any(axis=(1, 2))
    _, later = jax.lax.scan(step, agent, actions)
    gap, accepted = (jnp.concatenate([a[None], b]) for a, b in zip(first, later, strict=True))
    early = accepted & (jnp.cumsum(accepted, axis=0) <= EARLY_VIEWS)
    return jnp.where(early, gap, 0.0).sum(axis=0) / early.astype(jnp.float32).sum(axis=0), gap[-1]


def _median(values: np.ndarray) -> float:
    """Return the median of defined values, NaN without any."""
    defined = values[np.isfinite(values)]
    return float(np.median(defined)) if len(defined) else float("nan")
