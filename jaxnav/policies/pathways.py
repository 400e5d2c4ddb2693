"""The paper's causal graph as types.

    S (surroundings without objects) --> A
    G (detections and goal) -----------> A
    S, G --> Z (experience) -----------> A

`Pathways` holds the three embeddings that lead to the action A, `Decision` what the policy makes of them, and
`PolicyState` what it carries from step to step.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxnav.env.objectnav import Observation
from jaxnav.scenes.task import NUM_ACTIONS

#: The previous action at the start of an episode.
NO_ACTION = NUM_ACTIONS


class PolicyInputs(NamedTuple):
    """Inputs of a policy at one step, leaves [...] of a batch or of one decision.

    Attributes:
      observation: packed row and goal.
      layout_weights: float32 [..., K], the layout's weights for the goal, its column of w (eq. 7); ones disable the
        layout.
      reading: output of the method's tracker, a pytree; None without a tracker.
      surroundings: uint8 [..., M], states of the map cells around the agent (unknown, blocked, free or visited); None
        without a spatial memory.
    """

    observation: Observation
    layout_weights: jax.Array
    reading: Any = None
    surroundings: jax.Array | None = None


class Pathways(NamedTuple):
    """Embeddings on the three pathways into the action.

    In `StreamsPolicy`, scene and experience end with a 1, a factor on a stream's outputs: scene = 0 silences the whole
    direct stream, which also reads the goal, and experience = 0 silences the experience stream.

    Attributes:
      scene: float32 [..., S], the direct pathway S -> A: the surroundings without objects.
      goal: float32 [..., G], the direct pathway G -> A: detections and the goal, without experience.
      experience: float32 [..., Z], the mediator Z: what the method makes of scene and goal by experience; with streams
        followed by a second embedding of the view. In `HandoverPolicy` it is the pair of the pathways of both policies.
      gate: float32 [..., 1], factor on the logit of Done; not a pathway, so interventions do not change it.
      reading: reading of the method's tracker, for its adaptation, leaves [...]; also not a pathway.
    """

    scene: jax.Array
    goal: jax.Array
    experience: jax.Array
    gate: jax.Array
    reading: Any = None


class EncodedPathways(NamedTuple):
    """What `Policy.encode` computes without the memory; `Policy.attend` makes it `Pathways`.

    Attributes:
      scene, goal, gate, reading: as in `Pathways`.
      experience: output of the method's `Experience.encode`: float32 [..., Z], or a pytree of the method's own if its
        experience reads the memory.
      view: float32 [..., V + 1], the embedding of the view for the experience stream, and a 1; None without streams.
    """

    scene: jax.Array
    goal: jax.Array
    experience: Any
    gate: jax.Array
    reading: Any = None
    view: jax.Array | None = None


class PolicyState(NamedTuple):
    """Memory of a policy within an episode.

    Attributes:
      hidden: float32 [..., H], recurrent state; zeros at the start. With streams [..., 2 H], that of the direct stream
        first.
      action: int32 [...], the previous action; `NO_ACTION` at the start.
      fast: fast weights of the method's adaptation, leaves [...]; None without one.
      use_experience: float32 [...], 0 in training episodes without experience, otherwise 1; None where all episodes
        have experience.
      counterfactual_hidden: float32 [..., H], recurrent state of the counterfactual branch, which has read the factual
        experience and no direct pathway since the start; None where that branch reads the factual recurrent state.
    """

    hidden: jax.Array
    action: jax.Array
    fast: Any = None
    use_experience: jax.Array | None = None
    counterfactual_hidden: jax.Array | None = None

    def counterfactual_state(self) -> "PolicyState":
        """Memory of the counterfactual branch: with its own recurrent state if it has one, else the factual one."""
        if self.counterfactual_hidden is None:
            return self
        return self._replace(hidden=self.counterfactual_hidden, counterfactual_hidden=None)


class Decision(NamedTuple):
    """Outcome of one decision.

    Attributes:
      logits: float32 [..., A].
      value: float32 [...], estimated return.
      hidden: float32 [..., H], recurrent state after the decision; with streams [..., 2 H].
      fast: fast weights after the decision; None without adaptation.
      use_experience: `use_experience` of the memory.
      counterfactual_hidden: float32 [..., H], recurrent state of the counterfactual branch after the decision; None
        where that branch has no memory of its own.
    """

    logits: jax.Array
    value: jax.Array
    hidden: jax.Array
    fast: Any = None
    use_experience: jax.Array | None = None
    counterfactual_hidden: jax.Array | None = None

    def next_state(self, action: jax.Array) -> PolicyState:
        """Return the memory for the next step, given the action int32 [...] that was taken."""
        return PolicyState(
            hidden=self.hidden,
            action=action,
            fast=self.fast,
            use_experience=self.use_experience,
            counterfactual_hidden=self.counterfactual_hidden,
        )


PathwaysT = TypeVar("PathwaysT", Pathways, EncodedPathways)


def mask_experience(pathways: Pathways, use_experience: jax.Array | None) -> Pathways:
    """Set the experience to zero where `use_experience` is 0.

    Args:
      pathways: leaves [..., ...].
      use_experience: float32 [...], 0 or 1; None keeps all.
    """
    if use_experience is None:
        return pathways
    return pathways._replace(experience=use_experience[..., None] * pathways.experience)


def mask_direct_pathways(pathways: PathwaysT, use_direct: jax.Array | None) -> PathwaysT:
    """Set both direct pathways to zero where `use_direct` is False.

    Args:
      pathways: leaves [..., ...].
      use_direct: bool [...]; None keeps all.
    """
    if use_direct is None:
        return pathways
    masked_scene = jnp.where(use_direct[..., None], pathways.scene, 0.0)
    masked_goal = jnp.where(use_direct[..., None], pathways.goal, 0.0)
    return pathways._replace(scene=masked_scene, goal=masked_goal)
