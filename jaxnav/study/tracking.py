"""Does the gap D follow the layout? Its course step by step (paper, Fig. 6b), and whether it tells a shift."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import first_states
from jaxnav.layout import LayoutEstimator, LayoutState, Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.policy import Params
from jaxnav.study.association import RESAMPLES, interval, scene_draws, weight_below

#: The beliefs behind a gap: updated by what is seen (eq. 4), or left at the prior.
UPDATED, FROZEN = 0, 1


class GapTraces(NamedTuple):
    """Gaps along E episodes walked by N policies; step t is after t actions, with the view there taken in.

    Attributes:
      gap: float32 [settings, 2, N, E, T + 1], layout gap D by setting and belief (`UPDATED`, `FROZEN`); of no meaning
        where the episode has ended.
      running: bool [N, E, T + 1], the episode has not ended before step t.
      episodes: the episodes.
    """

    gap: np.ndarray
    running: np.ndarray
    episodes: EpisodeList


class Course(NamedTuple):
    """A figure for each step over the episodes that still run, with its 95 % interval.

    Attributes:
      mean, low, high: float64 [settings, 2, T + 1]; NaN where nothing runs.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def gap_traces(
    weights: Params,
    episodes: EpisodeList,
    params: EnvParams,
    acting: Acting,
    spec: PolicySpec,
    priors: jax.Array,
    settings: Sequence[str | Setting],
    setting_priors: jax.Array,
    num_steps: int,
    key: jax.Array,
) -> GapTraces:
    """Walk episodes with layout policies, actions sampled and no sTDE, while estimators of several settings watch.

    All settings see the same walks; only that of `acting` weighs the policies' input.

    Args:
      weights: parameters of the policies, leaves [N, ...].
      episodes: E episodes of one bank.
      params: of the environment with that bank.
      acting: environment and the policies' layout setting.
      spec: sizes of the policies.
      priors: float32 [rooms, K, K], the policies' own.
      settings: of the estimators that watch.
      setting_priors: float32 [settings, rooms, K, K], the prior of each.
      num_steps: T.
      key: policy n in episode e uses it folded with n, e and the time.
    """
    gap, running = _walks(
        weights, first_states(episodes), params, acting, spec, priors, tuple(settings), setting_priors, num_steps, key
    )
    return GapTraces(np.asarray(gap).transpose(2, 3, 0, 4, 1), np.asarray(running).transpose(0, 2, 1), episodes)


@functools.partial(jax.jit, static_argnames=("acting", "spec", "settings", "num_steps"))
def _walks(
    weights: Params,
    start: State,
    params: EnvParams,
    acting: Acting,
    spec: PolicySpec,
    priors: jax.Array,
    settings: tuple[str | Setting, ...],
    setting_priors: jax.Array,
    num_steps: int,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Gaps [N, T + 1, settings, 2, E] and who runs [N, T + 1, E]."""
    env, count = acting.env, len(start.pose)
    room = params.room[start.scene]

    def walk(own: tuple[jax.Array, Params]) -> tuple[jax.Array, jax.Array]:
        number, own_weights = own
        policy = bind(spec, own_weights)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.fold_in(key, number), jnp.arange(count))

        def step(carry: tuple, _: None) -> tuple[tuple, tuple[jax.Array, jax.Array]]:
            agent, running, beliefs = carry
            presence = env.row_format.presence(params.tables.rows[agent.state.pose])
            beliefs = [
                _watch(setting, prior[room], belief, presence)
                for setting, prior, belief in zip(settings, setting_priors, beliefs, strict=True)
            ]
            observation, layout_weights = acting.observe(agent, params)
            decision = policy.decide(policy.pathways(observation, layout_weights), agent.memory)
            step_keys = jax.vmap(jax.random.fold_in)(keys, agent.state.time)
            action = jax.vmap(jax.random.categorical)(step_keys, decision.logits).astype(jnp.int32)
            state, _reward, terminated, truncated = jax.vmap(env.advance, (0, 0, None))(agent.state, action, params)
            layout = acting.believe(agent.layout, state, params, priors)
            following = Agent(state=state, layout=layout, memory=Memory(hidden=decision.hidden, action=action))
            gaps = jnp.stack([jnp.stack([belief.gap for belief in pair]) for pair in beliefs])
            return (following, running & ~(terminated | truncated), beliefs), (gaps, running)

        unseen = [_unseen(setting, prior[room]) for setting, prior in zip(settings, setting_priors, strict=True)]
        first = acting.begin(start, policy, params, priors), jnp.ones(count, bool), unseen
        return jax.lax.scan(step, first, length=num_steps + 1)[1]

    numbers = jnp.arange(jax.tree.leaves(weights)[0].shape[0])
    return jax.lax.map(walk, (numbers, weights))


def _unseen(setting: str | Setting, priors: jax.Array) -> tuple[LayoutState, LayoutState]:
    """Both beliefs of each episode before anything is seen, from priors float32 [E, K, K]."""
    first = jax.vmap(lambda prior: LayoutEstimator(prior, setting).init())(priors)
    return first, first


def _watch(
    setting: str | Setting, priors: jax.Array, beliefs: tuple[LayoutState, LayoutState], presence: jax.Array
) -> tuple[LayoutState, LayoutState]:
    """Both beliefs after a view of each episode: the updated one, and the one whose alpha stays the prior.

    Args:
      setting: of the estimator.
      priors: float32 [E, K, K].
      beliefs: before the view, leaves [E, ...].
      presence: bool [E, K].
    """

    def one(prior: jax.Array, updated: LayoutState, frozen: LayoutState, seen: jax.Array):
        estimator = LayoutEstimator(prior, setting)
        return estimator.update(updated, seen), estimator.update(frozen, seen).replace(alpha=prior)

    return jax.vmap(one)(priors, *beliefs, presence)


def auc(positive: np.ndarray, negative: np.ndarray) -> float:
    """Probability that a positive value exceeds a negative one, ties counted half (area under the ROC curve).

    Args:
      positive: real [P], at least one.
      negative: real [Q], at least one.
    """
    return float(_auc(positive, negative, np.ones((len(positive), 1)), np.ones((len(negative), 1)))[0])


def auc_by_step(
    shifted: GapTraces, unshifted: GapTraces, generator: np.random.Generator, resamples: int = RESAMPLES
) -> Course:
    """AUC of the gap at each step: does it tell episodes of shifted scenes from others, among those that still run?

    A resample draws scenes within each room type, twins together, and policies, which both sides share.

    Args:
      shifted: traces at the greater shift.
      unshifted: of the same policies, settings and number of steps, at the smaller one.
      generator: of the resamples.
      resamples: their number.
    """
    return _course(_auc, [shifted, unshifted], generator, resamples)


def mean_by_step(traces: GapTraces, generator: np.random.Generator, resamples: int = RESAMPLES) -> Course:
    """Mean gap at each step over the episodes that still run; resamples as in `auc_by_step`.

    Args:
      traces: the gaps.
      generator: of the resamples.
      resamples: their number.
    """
    return _course(_mean, [traces], generator, resamples)


def _auc(positive: np.ndarray, negative: np.ndarray, weights: np.ndarray, others: np.ndarray) -> np.ndarray:
    """AUC [R] of values [P] and [Q] weighted by [P, R] and [Q, R]; NaN where one side weighs nothing."""
    wins = np.einsum("pr,pr->r", weights, weight_below(positive, negative, others), dtype=np.float64)
    return _ratio(wins, weights.sum(axis=0, dtype=np.float64) * others.sum(axis=0, dtype=np.float64))


def _mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean [R] of values [P] weighted by [P, R]; NaN where nothing weighs."""
    return _ratio((values @ weights).astype(np.float64), weights.sum(axis=0, dtype=np.float64))


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator > 0)


def _course(
    statistic: Callable[..., np.ndarray], sides: list[GapTraces], generator: np.random.Generator, resamples: int
) -> Course:
    """A statistic of the gaps of every side and of their weights, at each step.

    The weight of an episode in a resample is how often its scene is drawn times how often its policy is.
    """
    policies = len(sides[0].running)
    drawn = np.ones((policies, 1 + resamples), np.float32)
    drawn[:, 1:] = generator.multinomial(policies, np.full(policies, 1 / policies), resamples).T
    draws = [drawn[:, None] * scenes for scenes in scene_draws([own.episodes for own in sides], generator, resamples)]
    settings, beliefs, *_, steps = sides[0].gap.shape
    figures = np.empty((3, settings, beliefs, steps))
    for step in range(steps):
        running = [own.running[..., step] for own in sides]
        weights = [draw[runs] for draw, runs in zip(draws, running, strict=True)]
        for setting, belief in np.ndindex(settings, beliefs):
            gaps = [own.gap[setting, belief, ..., step][runs] for own, runs in zip(sides, running, strict=True)]
            own = interval(statistic(*gaps, *weights))
            figures[:, setting, belief, step] = np.array([own["mean"], *own["ci95"]], np.float64)
    return Course(*figures)
