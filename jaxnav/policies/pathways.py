"""The causal graph of the paper as types: what a decision is made from, and what an intervention may replace.

S (what is seen) ---------> A
G (what is sought) -------> A
S, G --> Z (experience) --> A
"""

from typing import NamedTuple

import jax

from jaxnav.scenes.task import NUM_ACTIONS


class Pathways(NamedTuple):
    """The embeddings on the three pathways into the action.

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
    """What an agent carries through its episode.

    Attributes:
      hidden: float32 [..., H], recurrent state; zeros at the start.
      action: int32 [...], the previous action; `NUM_ACTIONS` at the start.
    """

    hidden: jax.Array
    action: jax.Array


class Decision(NamedTuple):
    """The outcome of one decision.

    Attributes:
      logits: float32 [..., A].
      value: float32 [...], estimated return.
      hidden: float32 [..., H], recurrent state after the decision.
    """

    logits: jax.Array
    value: jax.Array
    hidden: jax.Array


NO_ACTION = NUM_ACTIONS
