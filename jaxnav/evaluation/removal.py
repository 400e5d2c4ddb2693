"""Removal of experience from a decision: sTDE (eq. 2), TDE (eq. 1), and the controls that they are compared with.

The subtracted logits are the counterfactual ones, to which experience alone contributes.

An `InferenceConfig` says how one cell of an evaluation grid turns a decision into logits to act by. At every step
`counterfactual_logits` decides without the direct pathways, `select_gap` picks the layout gap, and `apply_removal`
combines both with the factual logits. All three are traced: one compilation serves every configuration.
"""

import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import FORMS, do, removal_weight, stde, tde
from jaxnav.policies.handover import Decider
from jaxnav.policies.pathways import Pathways, PolicyState

# Purposes folded into an episode's key; no time step is that late.
_NOISE, _ORDER = 2**30, 2**30 + 1


class RemovedLogits(enum.IntEnum):
    """Origin of the logits that are removed.

    `COUNTERFACTUAL`: the policy's counterfactual decision. Controls: `ZEROS`, which only changes the temperature;
    `NOISE`, normal noise with the standard deviation of the counterfactual logits, fixed within an episode.
    """

    COUNTERFACTUAL = 0
    ZEROS = 1
    NOISE = 2


class GapSource(enum.IntEnum):
    """Origin of the layout gap of a step.

    `OWN`: the episode's own belief. Controls: `OTHER`, the belief of another running episode at the same time, drawn at
    random and kept as long as both run (the own one in the last episode that runs); `MEAN`, the mean of all running
    episodes; `GIVEN`, a number fixed beforehand, within [gap_begin, gap_end).
    """

    OWN = 0
    OTHER = 1
    MEAN = 2
    GIVEN = 3


class InferenceConfig(struct.PyTreeNode):
    """Inference of one cell of an evaluation grid, leaves []; or of all C cells, leaves [C].

    Experience is removed by sTDE (eq. 2) with the threshold `epsilon`, or by TDE (eq. 1) where `use_tde` holds; with
    epsilon = inf sTDE removes nothing. The fields from `gap_source` on are controls.

    Attributes:
      policy_index: int32, index of the policy's parameters.
      epsilon: float32, threshold of sTDE.
      use_tde: bool, remove by TDE instead.
      form: int32, index of the form of eq. 2 in `causal.FORMS`.
      use_layout: bool, multiply the layout's weights in; otherwise they are ones.
      greedy: bool, take the best action rather than sample.
      act_randomly: bool, ignore the policy.
      gap_source: int32, a `GapSource`.
      given_gap: float32, the gap of `GapSource.GIVEN` from step `gap_begin` to before step `gap_end`; 0 at other times.
      gap_begin, gap_end: int32, steps.
      intervention: float32, upper bound of the uniform random numbers that scene and goal are set to; 0 in sTDE.
      removed: int32, a `RemovedLogits`.
    """

    policy_index: jax.Array
    epsilon: jax.Array
    use_tde: jax.Array
    form: jax.Array
    use_layout: jax.Array
    greedy: jax.Array
    act_randomly: jax.Array
    gap_source: jax.Array
    given_gap: jax.Array
    gap_begin: jax.Array
    gap_end: jax.Array
    intervention: jax.Array
    removed: jax.Array


class InferenceTrace(NamedTuple):
    """Inference of one step, leaves [E, ...].

    Attributes:
      layout: float32 [K], the layout's weights for the goal (eq. 7); ones without the layout.
      gap: float32, layout gap at the step; after `select_gap` where experience may be removed.
      weight: float32, weight of the removed logits.
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


def counterfactual_logits(
    config: InferenceConfig,
    policy: Decider,
    pathways: Pathways,
    memory: PolicyState,
    episode_keys: jax.Array,
    step_keys: jax.Array,
) -> jax.Array:
    """Return the logits to remove from E decisions, float32 [E, A].

    The counterfactual decision shares experience and memory with the factual one; its updated memory is discarded.

    Args:
      config: of the grid cell.
      policy: with the cell's parameters.
      pathways, memory: of the factual decisions, [E].
      episode_keys, step_keys: [E], of the episodes, and of their present step; folded further.
    """

    def sample(keys: jax.Array, purpose: int, like: jax.Array, sampler: Callable[..., jax.Array]) -> jax.Array:
        """Sample an array of a given shape [E, ...], each row with a key of its own."""
        purpose_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, purpose)
        return jax.vmap(lambda key: sampler(key, like.shape[1:]))(purpose_keys)

    def intervention_value(purpose: int, pathway: jax.Array) -> jax.Array:
        """Zeros, or random numbers where the control asks for them."""
        return jax.lax.cond(
            config.intervention > 0,
            lambda: config.intervention * sample(step_keys, purpose, pathway, jax.random.uniform),
            lambda: jnp.zeros_like(pathway),
        )

    # do(S = 0, G = 0) with the factual experience and memory.
    scene_value = intervention_value(0, pathways.scene)
    goal_value = intervention_value(1, pathways.goal)
    counterfactual_pathways = do(pathways, scene=scene_value, goal=goal_value)
    logits = policy.decide(counterfactual_pathways, memory).logits

    # One branch per member of `RemovedLogits`.
    branches = (
        lambda: logits,
        lambda: jnp.zeros_like(logits),
        lambda: logits.std(axis=-1, keepdims=True) * sample(episode_keys, _NOISE, logits, jax.random.normal),
    )
    return jax.lax.switch(config.removed, branches)


def select_gap(
    config: InferenceConfig, gap: jax.Array, running: jax.Array, episode_keys: jax.Array, time: jax.Array
) -> jax.Array:
    """Select the layout gaps to remove experience by, float32 [E].

    Args:
      config: of the grid cell.
      gap: float32 [E], of the episodes' own beliefs.
      running: bool [E], episodes that have not ended.
      episode_keys: [E]; folded further.
      time: int32 [E], steps so far.
    """
    is_given_time = (time >= config.gap_begin) & (time < config.gap_end)
    # One branch per member of `GapSource`.
    branches = (
        lambda: gap,
        lambda: gap[_other_running_episode(running, episode_keys)],
        lambda: jnp.broadcast_to(jnp.mean(gap, where=running), gap.shape),
        lambda: jnp.where(is_given_time, config.given_gap, 0.0),
    )
    return jax.lax.switch(config.gap_source, branches)


def apply_removal(
    config: InferenceConfig, logits: jax.Array, counterfactual: jax.Array, gap: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Remove experience from logits by equation 1 or 2.

    Args:
      config: of the grid cell.
      logits: float32 [E, A], factual.
      counterfactual: float32 [E, A], to remove.
      gap: float32 [E], layout gaps.

    Returns:
      Logits float32 [E, A], and the weight float32 [E] of the removed ones.
    """
    # The form is traced: compute all three and pick one.
    soft_logits = jnp.stack([stde(logits, counterfactual, gap, config.epsilon, form) for form in FORMS])[config.form]
    soft_weight = jnp.stack([removal_weight(gap, config.epsilon, form) for form in FORMS])[config.form]

    corrected_logits = jnp.where(config.use_tde, tde(logits, counterfactual), soft_logits)
    weight = jnp.where(config.use_tde, 1.0, soft_weight)
    return corrected_logits, weight


def _other_running_episode(running: jax.Array, episode_keys: jax.Array) -> jax.Array:
    """Return for each running episode the index of another one, int [E]; meaningless for ended episodes.

    The other one is the next, cyclically, in an order drawn from the keys, so that pairs outlast the end of other
    episodes.
    """
    score = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, _ORDER)))(episode_keys)
    running_first = jnp.argsort(jnp.where(running, score, 1.0))
    rank = jnp.zeros_like(running_first).at[running_first].set(jnp.arange(len(running_first)))
    next_rank = (rank + 1) % jnp.maximum(running.sum(), 1)
    return running_first[next_rank]
