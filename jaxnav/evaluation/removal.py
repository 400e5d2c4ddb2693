"""Removal of experience from a decision: sTDE (eq. 2), TDE (eq. 1), and the controls that they are compared with.

sTDE and TDE subtract the counterfactual logits: do(S = 0, G = 0) with the factual experience Z, and with the factual
memory or a memory of its own (`PolicyState.counterfactual_hidden`). The controlled direct effect (CDE) uses the same
equations: a `HandoverPolicy` whose fallback is the policy under do(Z = 0) keeps the logits of the fallback.

An `InferenceConfig` says how one entry of an evaluation grid turns a decision into logits to act by. At every step
`decide_counterfactually` decides without the direct pathways, or `control_logits` in a grid with controls. `select_gap`
picks the layout gap, and `apply_removal` combines both with the factual logits. Every field of the configuration is a
traced array, so one compilation serves all entries.
"""

import enum
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import FORMS, removal_weight, remove_experience, tde
from jaxnav.choices import Form
from jaxnav.evaluation.replacements import other_running_episode
from jaxnav.policies.agent_loop import decide_counterfactually
from jaxnav.policies.handover import Decider
from jaxnav.policies.pathways import Pathways, PolicyState

# Constants folded into the key of a step.
_SCENE_TAG = 0
_GOAL_TAG = 1
# Constant folded into the key of an episode. Its time steps are folded into the same key, and are smaller; see also
# `jaxnav.evaluation.replacements`.
_NOISE_TAG = 2**30


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
    random and kept as long as both run (the last running episode keeps its own belief); `MEAN`, the mean of all running
    episodes; `GIVEN`, the constant `given_gap` during steps [gap_begin, gap_end), 0 otherwise.
    """

    OWN = 0
    OTHER = 1
    MEAN = 2
    GIVEN = 3


class InferenceConfig(struct.PyTreeNode):
    """Inference of one entry of an evaluation grid, leaves []; or of all C entries, leaves [C].

    Experience is removed by equation 2 with the threshold `epsilon`, or completely; with epsilon = inf equation 2
    removes nothing. The fields from `gap_source` to `removed_source`, and `replaces_factual`, are controls of sTDE.

    Attributes:
      policy_index: int32, index of the policy's parameters.
      epsilon: float32, threshold of soft removal (eq. 2).
      remove_completely: bool, remove by equation 1, which leaves the TDE; with a `HandoverPolicy`, the CDE or the
        decision of the layout-blind fallback.
      form: int32, index of the form of eq. 2 in `causal.FORMS`.
      use_layout: bool, use the layout's weights; otherwise they are ones.
      greedy: bool, take the best action instead of sampling.
      act_randomly: bool, sample the choices of the policy uniformly; with macro-actions these are targets, not actions.
      gap_source: int32, a `GapSource`.
      given_gap: float32, the gap of `GapSource.GIVEN` from step `gap_begin` to before step `gap_end`; 0 at other times.
      gap_begin, gap_end: int32, steps.
      direct_noise: float32, upper bound of the uniform noise that replaces scene and goal; 0 sets them to zero, as in
        sTDE.
      removed_source: int32, a `RemovedLogits`.
      replaced_part: int32, a `ReplacedPart` (`jaxnav.evaluation.replacements`), the part that is replaced at every
        step.
      replaces_factual: bool, False to replace the part in the counterfactual decision alone.
      max_room_episodes: int32, number of episodes of each room type that the entry runs, the first in the list; the
        outcomes of the remaining ones are undefined, see `select_first_episodes`.
    """

    policy_index: jax.Array
    epsilon: jax.Array
    remove_completely: jax.Array
    form: jax.Array
    use_layout: jax.Array
    greedy: jax.Array
    act_randomly: jax.Array
    gap_source: jax.Array
    given_gap: jax.Array
    gap_begin: jax.Array
    gap_end: jax.Array
    direct_noise: jax.Array
    removed_source: jax.Array
    replaced_part: jax.Array
    replaces_factual: jax.Array
    max_room_episodes: jax.Array


class InferenceTrace(NamedTuple):
    """Inference of one step, leaves [E, ...].

    Attributes:
      layout_weights: float32 [K], the layout's weights for the goal (eq. 7); ones without the layout.
      gap: float32, layout gap at the step; after `select_gap` if experience may be removed.
      removal_weight: float32, weight of the removed logits.
      factual_logits: float32 [A], logits before the removal; of replaced inputs if the entry replaces a part.
      removed_logits: float32 [A], logits to remove; equal to `factual_logits` if nothing can be removed.
      action_logits: float32 [A], logits that chose the action.
    """

    layout_weights: jax.Array
    gap: jax.Array
    removal_weight: jax.Array
    factual_logits: jax.Array
    removed_logits: jax.Array
    action_logits: jax.Array


def control_logits(
    config: InferenceConfig,
    policy: Decider,
    pathways: Pathways,
    memory: PolicyState,
    episode_keys: jax.Array,
    step_keys: jax.Array,
) -> jax.Array:
    """Logits to remove from E decisions in a grid with controls, float32 [E, A].

    Args:
      config: configuration of the grid entry; without controls the result is that of
        `decide_counterfactually`.
      policy: policy with the entry's parameters.
      pathways, memory: inputs of the factual decisions, leaves [E, ...].
      episode_keys, step_keys: PRNG keys [E] of the episodes and of their current step; folded further.
    """
    scene = _direct_value(config, pathways.scene, step_keys, _SCENE_TAG, policy.num_scene_factors)
    goal = _direct_value(config, pathways.goal, step_keys, _GOAL_TAG)
    logits = decide_counterfactually(policy, pathways, memory, scene, goal).logits

    def sample_noise() -> jax.Array:
        noise = _sample_rows(episode_keys, _NOISE_TAG, logits.shape[1:], jax.random.normal)
        return logits.std(axis=-1, keepdims=True) * noise

    # One branch per member of `RemovedLogits`.
    branches = (lambda: logits, lambda: jnp.zeros_like(logits), sample_noise)
    return jax.lax.switch(config.removed_source, branches)


def _direct_value(
    config: InferenceConfig, pathway: jax.Array, step_keys: jax.Array, tag: int, num_factors: int = 0
) -> jax.Array:
    """Value of a direct pathway, float32 [E, ...]: zeros, or the uniform noise of the control.

    The last `num_factors` entries are factors of a stream, which are 1 beside the noise.
    """

    def sample_noise() -> jax.Array:
        noise = config.direct_noise * _sample_rows(step_keys, tag, pathway.shape[1:], jax.random.uniform)
        return noise.at[..., noise.shape[-1] - num_factors :].set(1.0)

    # Entries run one by one, so `cond` samples only if needed.
    return jax.lax.cond(config.direct_noise > 0, sample_noise, lambda: jnp.zeros_like(pathway))


def _sample_rows(keys: jax.Array, tag: int, row_shape: tuple[int, ...], sampler: Callable[..., jax.Array]) -> jax.Array:
    """Sample float32 [E, *row_shape], each row with a key of its own."""
    row_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, tag)
    return jax.vmap(lambda key: sampler(key, row_shape))(row_keys)


def select_gap(
    config: InferenceConfig, gap: jax.Array, running: jax.Array, episode_keys: jax.Array, time: jax.Array
) -> jax.Array:
    """Select the layout gaps that weigh the removal, float32 [E].

    Args:
      config: configuration of the grid entry.
      gap: float32 [E], gaps of the episodes' own beliefs.
      running: bool [E], episodes that have not ended.
      episode_keys: PRNG keys [E] of the episodes; folded further.
      time: int32 [E], steps so far.
    """
    in_given_window = (time >= config.gap_begin) & (time < config.gap_end)
    # One branch per member of `GapSource`.
    branches = (
        lambda: gap,
        lambda: gap[other_running_episode(running, episode_keys)],
        lambda: jnp.broadcast_to(jnp.mean(gap, where=running), gap.shape),
        lambda: jnp.where(in_given_window, config.given_gap, 0.0),
    )
    return jax.lax.switch(config.gap_source, branches)


def apply_removal(
    config: InferenceConfig,
    logits: jax.Array,
    removed_logits: jax.Array,
    gap: jax.Array,
    has_additive_scores: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """Remove experience from logits by equation 1 or 2.

    Args:
      config: configuration of the grid entry.
      logits: float32 [E, A], factual logits.
      removed_logits: float32 [E, A], logits to remove.
      gap: float32 [E], layout gaps.
      has_additive_scores: as in `remove_experience`.

    Returns:
      Logits float32 [E, A], and the weight float32 [E] of the removed ones.
    """

    # The form is a traced index. Entries run one by one, so `switch` computes the selected form alone.
    def remove_softly(form: Form) -> tuple[jax.Array, jax.Array]:
        weight = removal_weight(gap, config.epsilon, form)
        soft_logits = remove_experience(
            logits, removed_logits, gap, config.epsilon, form, has_additive_scores=has_additive_scores
        )
        return soft_logits, weight

    branches = [functools.partial(remove_softly, form) for form in FORMS]
    soft_logits, soft_weight = jax.lax.switch(config.form, branches)

    corrected_logits = jnp.where(config.remove_completely, tde(logits, removed_logits), soft_logits)
    weight = jnp.where(config.remove_completely, 1.0, soft_weight)
    return corrected_logits, weight
