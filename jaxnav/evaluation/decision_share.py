"""Decision shares: how many decisions change when one part is replaced by that of another episode.

A decision counts as changed when its best action changes and the KL divergence from the factual to the changed action
probabilities exceeds `MIN_KL`, so that near ties do not count. The *partner difference* of a part is the share of
decisions that differ between the parts of two other episodes (partners). Share and partner difference are equal if the
episode's own part and the rest of the decision are independent.

`ShareProbe` runs a small batch of the evaluation's episodes and replaces parts of their decisions on the way. Episodes
follow the factual decisions; replaced decisions are only compared. `share_interval` turns the counts into a share with
an interval.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnav.causal import do
from jaxnav.env.objectnav import EnvParams, State
from jaxnav.evaluation.grid import infer_and_act
from jaxnav.evaluation.removal import InferenceConfig
from jaxnav.evaluation.replacements import (
    PARTNER_PARTS,
    DecisionContext,
    ReplacedPart,
    embed_decision_inputs,
    other_running_episode,
    replace_part,
)
from jaxnav.evaluation.statistics import Clusters, Interval, jackknife_interval, run_clusters
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.agent_loop import Agent, AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params, Policy

#: Smallest KL divergence, in nats, of a decision that counts as changed.
MIN_KL = 0.02
#: The stride between probes doubles whenever 32 initial strides have passed, at most three times.
_STRIDES_PER_DOUBLING = 32
_MAX_DOUBLINGS = 3
#: Number of running episodes below which nothing is counted: an episode and two different partners.
_MIN_RUNNING = 3


class ShareCounts(NamedTuple):
    """Weighted numbers of decisions by episode, leaves [..., E] and [..., E, P] for P parts.

    Late steps, at which few episodes still run, are probed more rarely. The weight of a probed decision is its stride
    over the initial stride, so that the decisions that it stands for count too.

    Attributes:
      weighted_decisions: int32 [..., E], all probed decisions.
      changed: int32 [..., E, P], decisions that change when the part is replaced.
      partner_differences: int32 [..., E, P], decisions that differ between two partners; 0 for a part that is not
        replaced by a partner's.
      deleted: int32 [..., E], decisions that change with Z = 0.
    """

    weighted_decisions: jax.Array
    changed: jax.Array
    partner_differences: jax.Array
    deleted: jax.Array


def is_changed(logits: jax.Array, changed_logits: jax.Array) -> jax.Array:
    """True where the best action differs and the KL divergence exceeds `MIN_KL`.

    Args:
      logits: float32 [..., A], logits of p.
      changed_logits: float32 [..., A], logits of q; the divergence is KL(p || q).

    Returns:
      bool [...].
    """
    log_probs = jax.nn.log_softmax(logits)
    changed_log_probs = jax.nn.log_softmax(changed_logits)
    kl = optax.losses.kl_divergence_with_log_targets(changed_log_probs, log_probs)
    return (logits.argmax(axis=-1) != changed_logits.argmax(axis=-1)) & (kl > MIN_KL)


def count_changes(
    context: DecisionContext,
    agent: Agent,
    counted: jax.Array,
    partners: tuple[jax.Array, jax.Array],
    parts: Sequence[ReplacedPart],
) -> ShareCounts:
    """Replace every part of one decision of each of E episodes.

    Args:
      context: policy and world of the decisions.
      agent: agents of the episodes.
      counted: bool [E], decisions to count.
      partners: for each episode the indices of two other episodes, int [E] each; their parts are the replacements.
      parts: the P parts.

    Returns:
      Counts of 0 or 1, leaves [E] and [E, P].
    """
    policy = context.policy
    factual = embed_decision_inputs(agent, context)
    factual_logits = policy.decide(factual.pathways, factual.memory).logits

    def decide_with_part(part: ReplacedPart, partner: jax.Array) -> jax.Array:
        """Logits with the part of the partner."""
        changed_pathways, changed_memory = replace_part(part, partner, factual, context)
        return policy.decide(changed_pathways, changed_memory).logits

    # Replace every part once, and those of partners twice.
    changed_columns = []
    difference_columns = []
    for part in parts:
        changed_logits = decide_with_part(part, partners[0])
        changed_columns.append(is_changed(factual_logits, changed_logits))
        is_different = jnp.zeros_like(counted)
        if part in PARTNER_PARTS:
            is_different = is_changed(changed_logits, decide_with_part(part, partners[1]))
        difference_columns.append(is_different)

    # For comparison: the decision with Z = 0.
    without_experience = do(factual.pathways, experience=0.0)
    deleted_logits = policy.decide(without_experience, factual.memory).logits
    return ShareCounts(
        weighted_decisions=counted.astype(jnp.int32),
        changed=(jnp.stack(changed_columns, axis=-1) & counted[:, None]).astype(jnp.int32),
        partner_differences=(jnp.stack(difference_columns, axis=-1) & counted[:, None]).astype(jnp.int32),
        deleted=(is_changed(factual_logits, deleted_logits) & counted).astype(jnp.int32),
    )


class ShareProbe:
    """Measurement of decision shares; one compilation serves all grids and banks of equal shapes."""

    def __init__(self, agent_loop: AgentLoop, parts: Sequence[ReplacedPart], probe_stride: int = 1) -> None:
        """Prepare the compiled function.

        Args:
          agent_loop: environment, policy specification and layout estimator, without a fallback.
          parts: the P parts to replace.
          probe_stride: steps from one probe to the next in the early part of an episode.
        """
        self._agent_loop = agent_loop
        self._parts = tuple(parts)
        # Macro-actions have few decision steps, so all of them are probed.
        has_macro_actions = agent_loop.method is not None and agent_loop.method.control.interval > 1
        self._probe_stride = 1 if has_macro_actions else probe_stride
        self._max_doublings = 0 if has_macro_actions else _MAX_DOUBLINGS
        self._compiled_run = jax.jit(self._run_grid)

    def __call__(
        self,
        grid: InferenceConfig,
        policy_params: Params,
        initial_states: State,
        env_params: EnvParams,
        knowledge: Knowledge,
        key: jax.Array,
    ) -> ShareCounts:
        """Run all entries of a grid over the episodes of one bank and count changed decisions.

        Args:
          grid: leaves [C]; the entries remove and replace nothing.
          policy_params: parameters of all policies, leaves [N, ...].
          initial_states: initial states of E episodes.
          env_params: parameters of the environment.
          knowledge: layout priors and statistics from before training.
          key: typed PRNG key []; policy index, episode and time are folded in.

        Returns:
          Counts, leaves [C, E] and [C, E, P].
        """
        counts = self._compiled_run(grid, policy_params, initial_states, env_params, knowledge, key)
        return jax.tree.map(np.asarray, counts)

    def _run_grid(
        self,
        grid: InferenceConfig,
        policy_params: Params,
        initial_states: State,
        env_params: EnvParams,
        knowledge: Knowledge,
        key: jax.Array,
    ) -> ShareCounts:
        """Run all entries of a grid over the episodes of one bank; jitted."""

        def run_entry(config: InferenceConfig) -> ShareCounts:
            policy = self._agent_loop.bind(jax.tree.map(lambda leaf: leaf[config.policy_index], policy_params))
            policy_key = jax.random.fold_in(key, config.policy_index)
            return self._run_episodes(config, policy, initial_states, env_params, knowledge, policy_key)

        return jax.lax.map(run_entry, grid)

    def _run_episodes(
        self,
        config: InferenceConfig,
        policy: Policy,
        initial_states: State,
        env_params: EnvParams,
        knowledge: Knowledge,
        key: jax.Array,
    ) -> ShareCounts:
        """Run the episodes of one entry, and probe some of its steps."""
        agent_loop = self._agent_loop
        num_episodes = len(initial_states.pose)
        episode_keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num_episodes))
        context = DecisionContext(policy, config.use_layout, agent_loop, knowledge, env_params)

        def probe_decisions(agent: Agent, running: jax.Array, counted: jax.Array) -> ShareCounts:
            partners = (
                other_running_episode(running, episode_keys, distance=1),
                other_running_episode(running, episode_keys, distance=2),
            )
            return count_changes(context, agent, counted, partners, self._parts)

        def step(carry: tuple[Agent, jax.Array, jax.Array, ShareCounts]):
            # Only decisions that take effect count.
            agent, running, time, counts = carry
            is_decision_step = agent_loop.is_decision_step(agent)
            counted = running if is_decision_step is None else running & is_decision_step

            # Probe every `stride`-th step; the stride grows with the time.
            num_doublings = jnp.minimum(time // (_STRIDES_PER_DOUBLING * self._probe_stride), self._max_doublings)
            stride = self._probe_stride * 2**num_doublings
            new_counts = jax.lax.cond(
                (time % stride == 0) & counted.any(),
                probe_decisions,
                lambda *_: jax.tree.map(jnp.zeros_like, counts),
                agent,
                running,
                counted,
            )
            weight = stride // self._probe_stride
            counts = jax.tree.map(lambda total, new: total + weight * new, counts, new_counts)

            # The factual decision acts. Ended episodes keep their agent.
            next_agent, result, _ = infer_and_act(config, context, agent, running, episode_keys, can_remove=False)
            return tree_where(running, next_agent, agent), running & ~result.ended, time + 1, counts

        # Start all episodes, and stop when too few are left to be partners.
        agent = agent_loop.start_from(initial_states, policy.initial_memory((num_episodes,)), knowledge, env_params)
        by_episode = jnp.zeros(num_episodes, jnp.int32)
        by_part = jnp.zeros((num_episodes, len(self._parts)), jnp.int32)
        no_counts = ShareCounts(
            weighted_decisions=by_episode, changed=by_part, partner_differences=by_part, deleted=by_episode
        )
        start = (agent, jnp.ones(num_episodes, bool), jnp.int32(0), no_counts)
        *_, counts = jax.lax.while_loop(lambda carry: carry[1].sum() >= _MIN_RUNNING, step, start)
        return counts


def share_interval(
    counted: np.ndarray, weighted_decisions: np.ndarray, scenes: Clusters, *, trained: bool = True
) -> Interval:
    """Compute the share of decisions, in percent, with its interval over scenes and training runs.

    Args:
      counted: int [S, E], weighted number of the decisions to count, by training run and episode.
      weighted_decisions: int [S, E], weighted number of all probed decisions.
      scenes: clusters of the E episodes.
      trained: True to generalize to other training runs; False for the interval of these policies in other scenes.

    Returns:
      The share over all runs, with that of every training run in `seeds`; NaN without decisions.
    """
    # Numerator and denominator leave out the same run and the same scene.
    runs = run_clusters(len(weighted_decisions))
    counted_replicates = runs.weights.T @ counted @ scenes.weights
    decision_replicates = runs.weights.T @ weighted_decisions @ scenes.weights
    if not weighted_decisions.any():
        return Interval(float("nan"))
    # Leaving out the only run leaves no decision; `jackknife_interval` then ignores the replicate.
    share_replicates = 100.0 * counted_replicates / np.maximum(decision_replicates, np.finfo(float).tiny)

    # With fixed policies only scenes are left out.
    if not trained:
        return jackknife_interval(share_replicates[0], scenes)

    seed_shares = 100.0 * counted.sum(axis=1) / np.maximum(weighted_decisions.sum(axis=1), 1)
    return jackknife_interval(
        share_replicates,
        scenes,
        runs,
        std=float(seed_shares.std(ddof=1)) if len(seed_shares) > 1 else float("nan"),
        seeds=tuple(seed_shares.tolist()),
    )
