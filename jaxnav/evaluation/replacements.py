"""Replacement of one part of a decision by the part of another episode.

How much of a decision depends on a part, such as the detections of other categories within experience? A replacement
takes this part from another running episode at the same step and keeps the rest. The new part is a value that the
policy meets in its own episodes; a deleted part, such as Z = 0, is not.

`replace_part` makes the pathways and the memory of one such decision. `jaxnav.evaluation.decision_share` counts the
decisions that change; `InferenceConfig.replaced_part` replaces a part in every step of an episode.
"""

import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxnav.env.objectnav import EnvParams
from jaxnav.numerics.trees import take_rows
from jaxnav.policies.agent_loop import Agent, AgentLoop, policy_memory
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


def replace_part(
    part: ReplacedPart,
    partner: jax.Array,
    pathways: Pathways,
    inputs: PolicyInputs,
    *,
    uses_layout: jax.Array,
    policy: Policy,
    agent: Agent,
    agent_loop: AgentLoop,
    knowledge: Knowledge,
    env_params: EnvParams,
) -> tuple[Pathways, PolicyState]:
    """Replace one part of E decisions.

    Args:
      part: the replaced part.
      partner: int [E], for each episode the index of the episode whose part it gets.
      pathways: factual pathways, leaves [E, ...].
      inputs: inputs of the factual pathways.
      uses_layout: bool [], False where the layout weights are ones; they then stay ones.
      policy: the policy that decides.
      agent: agents of the E episodes.
      agent_loop, knowledge, env_params: as in `jaxnav.evaluation.grid.infer_and_act`.

    Returns:
      Pathways and memory of the changed decisions, leaves [E, ...].
    """
    memory = policy_memory(agent)
    partner_pathways = take_rows(pathways, partner)

    def with_weights(weights: jax.Array) -> Pathways:
        """Pathways whose experience has other layout weights."""
        changed_weights = jnp.where(uses_layout, weights, inputs.layout_weights)
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
            if not policy.method.reads_memory:
                return pathways, partner_memory
            experience = policy.pathways(inputs, partner_memory).experience
            return pathways._replace(experience=experience), partner_memory


def select_part(
    parts: tuple[ReplacedPart, ...], part_index: jax.Array, change: Callable[[ReplacedPart], tuple]
) -> tuple:
    """Apply `change` to the part that a traced index selects.

    Args:
      parts: the parts that may be selected; only their changes are compiled.
      part_index: int32 [], a `ReplacedPart`; `NONE` if it is not among the parts.
      change: function from a part to arrays, whose shapes do not depend on the part.
    """
    all_parts = (ReplacedPart.NONE, *parts)
    branch_of_part = [all_parts.index(part) if part in all_parts else 0 for part in ReplacedPart]
    branches = [lambda part=part: change(part) for part in all_parts]
    return jax.lax.switch(jnp.asarray(branch_of_part)[part_index], branches)
