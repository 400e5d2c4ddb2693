"""Inference: sTDE, what it is compared with, and its controls."""

import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import FORMS, do, removal_weight, stde, tde
from jaxnav.policies.pair import Decider
from jaxnav.policies.pathways import Memory, Pathways

#: Folded into an episode's key; no time is that late.
_NOISE, _ORDER = 2**30, 2**30 + 1


class Branch(enum.IntEnum):
    """Name where the logits that are removed come from.

    The policy's counterfactual decision; zeros (nothing but a change of temperature); or normal noise, the
    same throughout an episode, with the standard deviation of the counterfactual logits.
    """

    COUNTERFACTUAL = 0
    ZEROS = 1
    NOISE = 2


class Source(enum.IntEnum):
    """Name where the layout gap of a step comes from.

    The episode's own belief; the belief of another running episode at the same time, at random, the same one as long as
    both run; the mean of all running episodes, which has their course over time and nothing of the episode; or a number
    given beforehand, from one step to another.
    """

    OWN = 0
    OTHER = 1
    MEAN = 2
    GIVEN = 3


class Inference(struct.PyTreeNode):
    """Say how parameters are used, leaves [] or [C].

    Experience is removed by sTDE (eq. 2) with the threshold `epsilon`, or by TDE (eq. 1) where `hard` holds; neither
    has an effect with epsilon = inf. The last six are controls.

    Attributes:
      params: int32, index of the parameters.
      epsilon: float32.
      hard: bool, TDE.
      form: int32, index of the form in `causal.FORMS`.
      layout: bool, multiply the layout's weights in; otherwise they are ones.
      greedy: bool, take the best action rather than sample.
      uniform: bool, ignore the policy and act at random.
      source: int32, where the layout gap comes from: a `Source`.
      gap: float32, the gap that is given; from step `begin` to before step `end`, 0 at other times.
      begin, end: int32, steps.
      intervention: float32, scene and goal are set to uniform random numbers below this; 0 in sTDE.
      branch: int32, the logits that are removed: a `Branch`.
    """

    params: jax.Array
    epsilon: jax.Array
    hard: jax.Array
    form: jax.Array
    layout: jax.Array
    greedy: jax.Array
    uniform: jax.Array
    source: jax.Array
    gap: jax.Array
    begin: jax.Array
    end: jax.Array
    intervention: jax.Array
    branch: jax.Array


class Inferred(NamedTuple):
    """Hold how actions were inferred at one step, leaves [E, ...].

    Attributes:
      layout: float32 [K], the layout's weights for the goal (eq. 7); ones without the layout.
      gap: float32, layout gap by which experience was removed.
      weight: float32, of the logits that were removed.
      factual: float32 [A], logits of the decision.
      counterfactual: float32 [A], logits to remove; those of the decision where nothing can be removed.
      corrected: float32 [A], logits that chose the action.
    """

    layout: jax.Array
    gap: jax.Array
    weight: jax.Array
    factual: jax.Array
    counterfactual: jax.Array
    corrected: jax.Array


def gap_used(cell: Inference, gap: jax.Array, running: jax.Array, keys: jax.Array, time: jax.Array) -> jax.Array:
    """Return the layout gaps that a cell removes experience by.

    Args:
      cell: how to infer.
      gap: float32 [E], of the episodes' beliefs.
      running: bool [E], episodes that have not ended.
      keys: [E], of the episodes; folded further.
      time: int32 [E], steps taken.

    Returns:
      float32 [E].
    """
    sources = (
        lambda: gap,
        lambda: gap[_other_running(running, keys)],
        lambda: jnp.broadcast_to(jnp.mean(gap, where=running), gap.shape),
        lambda: jnp.where((time >= cell.begin) & (time < cell.end), cell.gap, 0.0),
    )
    return jax.lax.switch(cell.source, sources)


def remove(
    cell: Inference, logits: jax.Array, counterfactual: jax.Array, gap: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Remove experience from logits as a cell says.

    Args:
      cell: how to infer.
      logits: float32 [E, A], factual.
      counterfactual: float32 [E, A], to remove.
      gap: float32 [E], layout gaps.

    Returns:
      Logits float32 [E, A], and the weight float32 [E] of what was removed.
    """
    soft = jnp.stack([stde(logits, counterfactual, gap, cell.epsilon, form) for form in FORMS])[cell.form]
    weight = jnp.stack([removal_weight(gap, cell.epsilon, form) for form in FORMS])[cell.form]
    removed = jnp.where(cell.hard, tde(logits, counterfactual), soft)
    return removed, jnp.where(cell.hard, 1.0, weight)


def counterfactual_logits(
    cell: Inference, policy: Decider, pathways: Pathways, memory: Memory, keys: jax.Array, step_keys: jax.Array
) -> jax.Array:
    """Return the logits to remove from E decisions.

    The counterfactual decision shares experience and memory with the factual one; the memory after it is dropped.

    Args:
      cell: how to infer.
      policy: with the cell's parameters.
      pathways, memory: of the factual decisions, [E].
      keys, step_keys: [E], of the episodes, and of their present step; folded further.

    Returns:
      float32 [E, A].
    """

    def draw(keys: jax.Array, purpose: int, like: jax.Array, how: Callable[..., jax.Array]) -> jax.Array:
        folded = jax.vmap(jax.random.fold_in, (0, None))(keys, purpose)
        return jax.vmap(lambda key: how(key, like.shape[1:]))(folded)

    def value(purpose: int, field: jax.Array) -> jax.Array:
        return jax.lax.cond(
            cell.intervention > 0,
            lambda: cell.intervention * draw(step_keys, purpose, field, jax.random.uniform),
            lambda: jnp.zeros_like(field),
        )

    changed = do(pathways, scene=value(0, pathways.scene), goal=value(1, pathways.goal))
    logits = policy.decide(changed, memory).logits
    branches = (
        lambda: logits,
        lambda: jnp.zeros_like(logits),
        lambda: logits.std(axis=-1, keepdims=True) * draw(keys, _NOISE, logits, jax.random.normal),
    )
    return jax.lax.switch(cell.branch, branches)


def _other_running(running: jax.Array, keys: jax.Array) -> jax.Array:
    """Return for each running episode another one, int [E].

    It is the next one, cyclically, in an order drawn from the keys; of no meaning for episodes that have ended.
    """
    rank = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, _ORDER)))(keys)
    order = jnp.argsort(jnp.where(running, rank, 1.0))  # those that run first
    place = jnp.zeros_like(order).at[order].set(jnp.arange(len(order)))
    return order[(place + 1) % jnp.maximum(running.sum(), 1)]
