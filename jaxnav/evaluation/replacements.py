"""Replacement of one part of a decision by the part of another episode.

How much of a decision depends on a part, such as the detections of other categories within experience? A replacement
takes this part from another running episode at the same step and keeps the rest. The new part is a value that the
policy meets in its own episodes; a deleted part, such as Z = 0, is not.

`embed_decision_inputs` embeds the inputs of a decision, and `replace_part` makes the pathways and the memory of the
decision with another part. `jaxnav.evaluation.decision_share` counts the
decisions that change; `InferenceConfig.replaced_part` replaces a part in every step of an episode.
"""

import enum
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams
from jaxnav.numerics.trees import take_rows
from jaxnav.policies.agent_loop import Agent, AgentLoop, policy_memory
from jaxnav.policies.handover import Decider
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import Pathways, PolicyInputs, PolicyState


class ReplacedPart(enum.IntEnum):
    """Part of a decision that can be replaced: by the part of another episode at the same step, except for weights.

    `NONE`: nothing. `OTHER_CATEGORIES`: the detections of all categories but the goal within experience. `EXPERIENCE`:
    all of Z. `PRIOR_WEIGHTS`: w, by the w of the layout prior. `UNIFORM_WEIGHTS`: w, by equal weights off the goal; the
    goal keeps its weight. `SCENE_AND_GOAL`: both direct pathways. `MEMORY`: recurrent state, previous action and fast
    weights.
    """

    NONE = 0
    OTHER_CATEGORIES = 1
    EXPERIENCE = 2
    PRIOR_WEIGHTS = 3
    UNIFORM_WEIGHTS = 4
    SCENE_AND_GOAL = 5
    MEMORY = 6


#: Parts whose replacement comes from a partner episode.
PARTNER_PARTS = (
    ReplacedPart.OTHER_CATEGORIES,
    ReplacedPart.EXPERIENCE,
    ReplacedPart.SCENE_AND_GOAL,
    ReplacedPart.MEMORY,
)
#: Parts that only policies with layout weights have.
WEIGHT_PARTS = (ReplacedPart.PRIOR_WEIGHTS, ReplacedPart.UNIFORM_WEIGHTS)


# Constant folded into the key of an episode. Its time steps are folded into the same key, and are smaller; see also
# `jaxnav.evaluation.removal`.
_ORDER_TAG = 2**30 + 1


class DecisionContext(NamedTuple):
    """Policy and world of a decision: all that it depends on but the agents.

    Attributes:
      policy: policy with the parameters of the grid entry.
      use_layout: bool [], whether the policy reads the layout weights; otherwise they are ones.
      agent_loop: runs policy and environment.
      knowledge: layout priors and statistics from before training.
      env_params: parameters of the environment.
    """

    policy: Decider
    use_layout: jax.Array
    agent_loop: AgentLoop
    knowledge: Knowledge
    env_params: EnvParams


class DecisionInputs(NamedTuple):
    """Agents of E episodes with pathways and memory from which they decide, leaves [E, ...].

    Attributes:
      agent: the agents.
      inputs: inputs of the pathways.
      pathways: scene, goal and experience.
      memory: memory of the policy before the decision.
    """

    agent: Agent
    inputs: PolicyInputs
    pathways: Pathways
    memory: PolicyState


def embed_decision_inputs(agent: Agent, context: DecisionContext) -> DecisionInputs:
    """Embed the inputs of agents in E episodes."""
    inputs = context.agent_loop.policy_inputs(agent, context.knowledge, context.env_params)
    inputs = inputs._replace(layout_weights=jnp.where(context.use_layout, inputs.layout_weights, 1.0))
    memory = policy_memory(agent)
    return DecisionInputs(agent, inputs, context.policy.pathways(inputs, memory), memory)


def replace_part(
    part: ReplacedPart, partner: jax.Array, factual: DecisionInputs, context: DecisionContext
) -> tuple[Pathways, PolicyState]:
    """Replace one part of E decisions.

    Args:
      part: the replaced part.
      partner: int [E], for each episode the index of the episode whose part it gets.
      factual: the decisions.
      context: policy and world of the decisions; a `HandoverPolicy` has no parts to replace.

    Returns:
      Pathways and memory of the changed decisions, leaves [E, ...].
    """
    policy, use_layout, agent_loop, knowledge, env_params = context
    agent, inputs, pathways, memory = factual
    assert isinstance(policy, Policy)
    partner_pathways = take_rows(pathways, partner)

    def with_weights(weights: jax.Array) -> Pathways:
        """Pathways whose experience has other layout weights; without the layout, they stay ones."""
        changed_weights = jnp.where(use_layout, weights, inputs.layout_weights)
        changed_inputs = inputs._replace(layout_weights=changed_weights)
        return pathways._replace(experience=policy.pathways(changed_inputs, memory).experience)

    match part:
        case ReplacedPart.NONE:
            return pathways, memory
        case ReplacedPart.OTHER_CATEGORIES:
            # Rows and readings of the partners, read for the goals of the episodes themselves.
            partner_observation = inputs.observation.replace(row=inputs.observation.row[partner])
            partner_perception = take_rows(agent.perception, partner)
            partner_inputs = PolicyInputs(
                observation=partner_observation,
                layout_weights=inputs.layout_weights,
                reading=agent_loop.read_tracker(partner_perception, agent.state.goal, knowledge),
            )
            mixed = policy.pathways(inputs, memory, partner_inputs=partner_inputs)
            return pathways._replace(experience=mixed.experience), memory
        case ReplacedPart.EXPERIENCE:
            return pathways._replace(experience=partner_pathways.experience), memory
        case ReplacedPart.PRIOR_WEIGHTS:
            return with_weights(agent_loop.prior_weights(agent, knowledge, env_params)), memory
        case ReplacedPart.UNIFORM_WEIGHTS:
            num_categories = inputs.layout_weights.shape[-1]
            is_goal = jax.nn.one_hot(agent.state.goal, num_categories, dtype=bool)
            return with_weights(jnp.where(is_goal, inputs.layout_weights, 1.0 / (num_categories - 1))), memory
        case ReplacedPart.SCENE_AND_GOAL:
            return pathways._replace(scene=partner_pathways.scene, goal=partner_pathways.goal), memory
        case ReplacedPart.MEMORY:
            # Experience that reads the memory is computed again.
            partner_memory = take_rows(memory, partner)
            if not policy.experience.reads_memory:
                return pathways, partner_memory
            experience = policy.pathways(inputs, partner_memory).experience
            return pathways._replace(experience=experience), partner_memory


def apply_selected_part(
    parts: tuple[ReplacedPart, ...], part_index: jax.Array, change: Callable[[ReplacedPart], tuple]
) -> tuple:
    """Apply `change` to the part that a traced index selects.

    Args:
      parts: the parts that may be selected; only their changes are compiled.
      part_index: int32 [], a `ReplacedPart`; `NONE` if it is not among the parts.
      change: function from a part to arrays, whose shapes do not depend on the part.
    """
    # One branch per compiled part; the first one stands for all parts that are not compiled.
    compiled_parts = (ReplacedPart.NONE, *parts)
    branch_of_part = np.zeros(len(ReplacedPart), np.int32)
    branches = []
    for branch_index, part in enumerate(compiled_parts):
        branch_of_part[part] = branch_index
        branches.append(functools.partial(change, part))
    return jax.lax.switch(jnp.asarray(branch_of_part)[part_index], branches)


def other_running_episode(running: jax.Array, episode_keys: jax.Array, distance: int = 1) -> jax.Array:
    """Index of another running episode for each running one, int [E]; undefined for ended episodes.

    The other episode is the next one in a cyclic order. The order depends only on the keys, so two paired episodes stay
    paired while both run, also when the batch shrinks.

    Args:
      running: bool [E], episodes that have not ended. With `distance` or fewer, an episode may be paired with itself.
      episode_keys: PRNG keys [E] of the episodes; folded further.
      distance: number of steps in the cyclic order.
    """
    # Ended episodes sort last: their score is 1.
    score = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, _ORDER_TAG)))(episode_keys)
    cyclic_order = jnp.argsort(jnp.where(running, score, 1.0))
    # The rank of each episode is the inverse permutation.
    rank = jnp.zeros_like(cyclic_order).at[cyclic_order].set(jnp.arange(len(cyclic_order)))
    next_rank = (rank + distance) % jnp.maximum(running.sum(), 1)
    return cyclic_order[next_rank]
