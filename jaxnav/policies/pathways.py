"""The causal graph of the paper as types.

S (what is seen) ---------> A
G (what is sought) -------> A
S, G --> Z (experience) --> A
"""

from typing import Any, NamedTuple

import jax

from jaxnav.causal import do
from jaxnav.scenes.task import NUM_ACTIONS


class Pathways(NamedTuple):
    """Hold the embeddings on the three pathways into the action.

    With streams, scene and experience end with a 1: 0 removes the stream.

    Attributes:
      scene: float32 [..., S], the direct pathway S -> A: what lies around.
      goal: float32 [..., G], the direct pathway G -> A: detections and what is sought, without experience.
      experience: float32 [..., Z], the mediator Z: what the method makes of scene and goal by experience.
      gate: float32 [..., 1], factor on the logit of Done; no pathway, so interventions leave it as it is.
      reading: what the method's tracker read, for its adaptation, leaves [...]; no pathway either.
    """

    scene: jax.Array
    goal: jax.Array
    experience: jax.Array
    gate: jax.Array
    reading: Any = None


class Memory(NamedTuple):
    """Hold what a policy carries through an episode.

    Attributes:
      hidden: float32 [..., H], recurrent state; zeros at the start. With streams [..., 2 H], the direct one's first.
      action: int32 [...], the previous action; `NO_ACTION` at the start.
      fast: fast weights of the method's adaptation, leaves [...]; None without one.
      experienced: float32 [...], 0 in episodes that go without experience in training, otherwise 1; None where the
        decision has no stream of experience.
    """

    hidden: jax.Array
    action: jax.Array
    fast: Any = None
    experienced: jax.Array | None = None


def zero_experience(pathways: Pathways, experienced: jax.Array | None) -> Pathways:
    """Zero the experience where `experienced` is 0.

    Args:
      pathways: leaves [..., ...].
      experienced: float32 [...], 0 or 1; None keeps all.
    """
    if experienced is None:
        return pathways
    return do(pathways, experience=experienced[..., None] * pathways.experience)


class Decision(NamedTuple):
    """Hold the outcome of one decision.

    Attributes:
      logits: float32 [..., A].
      value: float32 [...], estimated return.
      hidden: float32 [..., H], recurrent state after the decision; with streams [..., 2 H].
      fast: fast weights after the decision; None without adaptation.
      experienced: that of the memory.
    """

    logits: jax.Array
    value: jax.Array
    hidden: jax.Array
    fast: Any = None
    experienced: jax.Array | None = None

    def memory(self, action: jax.Array) -> Memory:
        """Return the memory after an action int32 [...] that followed."""
        return Memory(self.hidden, action, self.fast, self.experienced)


NO_ACTION = NUM_ACTIONS
