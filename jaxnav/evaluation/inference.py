"""Inference: sTDE, what it is compared with, and its controls."""

import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import do, removal_weight, stde, tde
from jaxnav.policies.pathways import Memory, Pathways
from jaxnav.policies.policy import Policy


class Branch(enum.IntEnum):
    """Name where the logits that are removed come from.

    The policy's counterfactual decision; zeros (nothing but a change of temperature); or normal noise, the
    same throughout an episode, with the standard deviation of the counterfactual logits.
    """

    COUNTERFACTUAL = 0
    ZEROS = 1
    NOISE = 2


class Inference(struct.PyTreeNode):
    """Say how parameters are used, leaves [] or [C].

    Experience is removed by sTDE (eq. 2) with the threshold `epsilon`, or by TDE (eq. 1) where `hard` holds; neither
    has an effect with epsilon = inf. The last four are controls.

    Attributes:
      params: int32, index of the parameters.
      epsilon: float32.
      hard: bool, TDE.
      residual: bool, combine in the residual form rather than in the paper's.
      layout: bool, multiply the layout's weights in; otherwise they are ones.
      greedy: bool, take the best action rather than sample.
      uniform: bool, ignore the policy and act at random.
      gap: float32, a constant in place of the episode's layout gap; NaN for the episode's.
      intervention: float32, scene and goal are set to uniform random numbers below this; 0 in sTDE.
      shuffled: bool, take the gap of the next running episode of the list at the same time.
      branch: int32, the logits that are removed: a `Branch`.
    """

    params: jax.Array
    epsilon: jax.Array
    hard: jax.Array
    residual: jax.Array
    layout: jax.Array
    greedy: jax.Array
    uniform: jax.Array
    gap: jax.Array
    intervention: jax.Array
    shuffled: jax.Array
    branch: jax.Array


def remove(
    cell: Inference, logits: jax.Array, counterfactual: jax.Array, gap: jax.Array, running: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Remove experience from logits as a cell says.

    Args:
      cell: how to infer.
      logits: float32 [E, A], factual.
      counterfactual: float32 [E, A], to remove.
      gap: float32 [E], layout gaps.
      running: bool [E], episodes that have not ended.

    Returns:
      Logits float32 [E, A], and the weight float32 [E] of what was removed.
    """
    gap = jnp.where(jnp.isnan(cell.gap), gap, cell.gap)
    gap = jnp.where(cell.shuffled, gap[_next_running(running)], gap)
    residual, paper = (stde(logits, counterfactual, gap, cell.epsilon, form) for form in ("residual", "paper"))
    soft = jnp.where(cell.residual, residual, paper)
    removed = jnp.where(cell.hard, tde(logits, counterfactual), soft)
    return removed, jnp.where(cell.hard, 1.0, removal_weight(gap, cell.epsilon))


def counterfactual_logits(
    cell: Inference, policy: Policy, pathways: Pathways, memory: Memory, keys: jax.Array, step_keys: jax.Array
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
        lambda: (
            logits.std(axis=-1, keepdims=True) * draw(keys, 2**30, logits, jax.random.normal)
        ),  # no time is that late
    )
    return jax.lax.switch(cell.branch, branches)


def _next_running(running: jax.Array) -> jax.Array:
    """Return for each running episode the next one, int [E].

    Cyclically; of no meaning for episodes that have ended.
    """
    order = jnp.argsort(~running)  # stable: those that run first
    place = jnp.cumsum(running) - 1
    return order[(place + 1) % jnp.maximum(running.sum(), 1)]
