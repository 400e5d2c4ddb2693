"""The causal graph of the paper as types.

S (what is seen) ---------> A
G (what is sought) -------> A
S, G --> Z (experience) --> A
"""

from typing import Any, NamedTuple

import jax

from jaxnav.scenes.task import NUM_ACTIONS


class Pathways(NamedTuple):
    """Hold the embeddings on the three pathways into the action.

    Attributes:
      scene: float32 [..., S], the direct pathway S -> A: what lies around.
      goal: float32 [..., G], the direct pathway G -> A: detections and what is sought, without experience.
      experience: float32 [..., Z], the mediator Z: what the method makes of scene and goal by experience.
      gate: float32 [..., 1], factor on the logit of Done; no pathway, so interventions leave it as it is.
    """

    scene: jax.Array
    goal: jax.Array
    experience: jax.Array
    gate: jax.Array


class Memory(NamedTuple):
    """Hold what a policy carries through an episode.

    Attributes:
      hidden: float32 [..., H], recurrent state; zeros at the start.
      action: int32 [...], the previous action; `NO_ACTION` at the start.
      fast: fast weights of the method's adaptation, leaves [...]; None without one.
    """

    hidden: jax.Array
    action: jax.Array
    fast: Any = None


class Decision(NamedTuple):
    """Hold the outcome of one decision.

    Attributes:
      logits: float32 [..., A].
      value: float32 [...], estimated return.
      hidden: float32 [..., H], recurrent state after the decision.
      fast: fast weights after the decision; None without adaptation.
    """

    logits: jax.Array
    value: jax.Array
    hidden: jax.Array
    fast: Any = None

    def memory(self, action: jax.Array) -> Memory:
        """Return the memory after an action int32 [...] that followed."""
        return Memory(hidden=self.hidden, action=action, fast=self.fast)


NO_ACTION = NUM_ACTIONS
