"""The layout gap D along walks, under several layout settings."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import first_states
from jaxnav.gaps import Signs
from jaxnav.layout import LayoutEstimator, LayoutState, Setting
from jaxnav.policies.acting import Acting, Agent, carried
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.policy import Params, Policy

#: The beliefs behind a gap: updated by what is seen (eq. 4), or left at the prior.
UPDATED, FROZEN = 0, 1


class GapTraces(NamedTuple):
    """Hold gaps along E episodes walked by N policies.

    Step t is after t actions, with the view there taken in.

    Attributes:
      gap: float32 [settings, 2, N, E, T + 1], layout gap D by setting and belief (`UPDATED`, `FROZEN`); of no meaning
        where the episode has ended.
      running: bool [N, E, T + 1], the episode has not ended before step t.
      episodes: the episodes.
    """

    gap: np.ndarray
    running: np.ndarray
    episodes: EpisodeList


def gap_traces(
    weights: Params,
    episodes: EpisodeList,
    params: EnvParams,
    acting: Acting,
    knowledge: Knowledge,
    settings: Sequence[str | Setting],
    setting_priors: jax.Array,
    num_steps: int,
    key: jax.Array,
) -> GapTraces:
    """Walk episodes with layout policies while several estimators watch.

    Actions are sampled, without sTDE. All settings see the same walks; only that of `acting` weighs the policies'
    input.

    Args:
      weights: parameters of the policies, leaves [N, ...].
      episodes: E episodes of one bank.
      params: of the environment with that bank.
      acting: how the policies act.
      knowledge: of the policies.
      settings: of the estimators that watch.
      setting_priors: float32 [settings, rooms, K, K], the prior of each.
      num_steps: T.
      key: policy n in episode e uses it folded with n, e and the time.
    """
    gap, running = _walks(
        weights, first_states(episodes), params, acting, knowledge, tuple(settings), setting_priors, num_steps, key
    )
    return GapTraces(np.asarray(gap).transpose(2, 3, 0, 4, 1), np.asarray(running).transpose(0, 2, 1), episodes)


@functools.partial(jax.jit, static_argnames=("acting", "settings", "num_steps"))
def _walks(
    weights: Params,
    start: State,
    params: EnvParams,
    acting: Acting,
    knowledge: Knowledge,
    settings: tuple[str | Setting, ...],
    setting_priors: jax.Array,
    num_steps: int,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the gaps and which episodes run.

    They are [N, T + 1, settings, 2, E] and [N, T + 1, E].
    """
    count, room = len(start.pose), params.room[start.scene]
    signs = jax.tree.map(lambda leaf: leaf[room], knowledge.signs)
    watchers = [(setting, prior[room], signs) for setting, prior in zip(settings, setting_priors, strict=True)]

    def walk(numbered: tuple[jax.Array, Params]) -> tuple[jax.Array, jax.Array]:
        number, policy_weights = numbered
        policy = acting.bind(policy_weights)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.fold_in(key, number), jnp.arange(count))

        def step(carry: tuple, _: None) -> tuple[tuple, tuple[jax.Array, jax.Array]]:
            agent, running, beliefs = carry
            presence = acting.env.row_format.presence(params.tables.rows[agent.state.pose])
            beliefs = [
                _watch(*watcher, pair, presence, start.goal) for watcher, pair in zip(watchers, beliefs, strict=True)
            ]
            next_agent, ended = _act(acting, policy, agent, knowledge, params, keys)
            gaps = jnp.stack([jnp.stack([belief.gap for belief in pair]) for pair in beliefs])
            return (next_agent, running & ~ended, beliefs), (gaps, running)

        beliefs = [_first_beliefs(*watcher) for watcher in watchers]
        agent = acting.begin(start, policy.initial_memory((count,)), knowledge, params)
        first = agent, jnp.ones(count, bool), beliefs
        return jax.lax.scan(step, first, length=num_steps + 1)[1]

    numbers = jnp.arange(jax.tree.leaves(weights)[0].shape[0])
    return jax.lax.map(walk, (numbers, weights))


def _act(
    acting: Acting, policy: Policy, agent: Agent, knowledge: Knowledge, params: EnvParams, keys: jax.Array
) -> tuple[Agent, jax.Array]:
    """Sample actions; return the agents after them, and which ended."""
    memory = carried(agent)
    decision = policy.decide(policy.pathways(*acting.view(agent, knowledge, params), memory), memory)
    step_keys = jax.vmap(jax.random.fold_in)(keys, agent.state.time)
    choice = jax.vmap(jax.random.categorical)(step_keys, decision.logits).astype(jnp.int32)
    after, taken = acting.step(agent, choice, knowledge, params, policy=policy, decision=decision)
    return after, taken.ended


def _first_beliefs(setting: str | Setting, priors: jax.Array, signs: Signs | None) -> tuple[LayoutState, LayoutState]:
    """Return both beliefs of each episode before anything is seen."""
    first = jax.vmap(lambda prior, signs: LayoutEstimator(prior, setting, signs).init())(priors, signs)
    return first, first


def _watch(
    setting: str | Setting,
    priors: jax.Array,
    signs: Signs | None,
    beliefs: tuple[LayoutState, LayoutState],
    presence: jax.Array,
    goal: jax.Array,
) -> tuple[LayoutState, LayoutState]:
    """Return both beliefs after a view of each episode.

    One is updated, the alpha of the other stays the prior.

    Args:
      setting: of the estimator.
      priors: float32 [E, K, K].
      signs: leaves [E, K, K]; None where no gap goes by them.
      beliefs: before the view, leaves [E, ...].
      presence: bool [E, K].
      goal: int32 [E].
    """

    def one(prior, signs, updated: LayoutState, frozen: LayoutState, seen: jax.Array, goal: jax.Array):
        estimator = LayoutEstimator(prior, setting, signs)
        return estimator.update(updated, seen, goal), estimator.update(frozen, seen, goal).replace(alpha=prior)

    return jax.vmap(one)(priors, signs, *beliefs, presence, goal)
