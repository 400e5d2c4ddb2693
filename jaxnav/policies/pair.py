"""Two policies, one with experience and one without, of which either can act."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.env.types import Observation
from jaxnav.numerics.rounding import rounded
from jaxnav.policies.pathways import Decision, Memory, Pathways
from jaxnav.policies.policy import Policy


class Pair:
    """Decide as a policy with experience, so that removal leaves another.

    As with two streams, experience is what the one adds to the other's logits: TDE (eq. 1) leaves the logits of the
    policy without experience to the bit, and the form `switch` of eq. 2 hands over to it. Both follow the
    whole episode, whichever acts. Works on batches.

    Attributes:
      agent: with experience.
      without: without any, and without a tracker; its spatial memory is the agent's.
    """

    def __init__(self, agent: Policy, without: Policy) -> None:
        self.agent, self.without = agent, without

    def initial_memory(self, batch: tuple[int, ...] = ()) -> Memory:
        """Return the memory at the start of an episode."""
        agent, without = self.agent.initial_memory(batch), self.without.initial_memory(batch)
        return agent._replace(hidden=jnp.concatenate([agent.hidden, without.hidden], axis=-1))

    def pathways(
        self, observation: Observation, weights: jax.Array, reading: Any, surroundings: jax.Array | None, memory: Memory
    ) -> Pathways:
        """Embed for both, which are the experience of the pair.

        Scene and goal are 1 [..., 1]; 0 takes the policy without experience out. Arguments: see `Policy.pathways`.
        """
        agent, without = self._split(memory)
        both: Any = (
            self.agent.pathways(observation, weights, reading, surroundings, agent),
            self.without.pathways(observation, jnp.ones_like(weights), None, surroundings, without),
        )
        one = jnp.ones_like(weights[..., :1])
        return Pathways(scene=one, goal=one, experience=both, gate=one)

    def decide(self, pathways: Pathways, memory: Memory) -> Decision:
        """Return action logits, and the value by experience."""
        (knowing, unknowing), (own, other) = self._split(memory), _both(pathways)
        agent, without = self.agent.decide(own, knowing), self.without.decide(other, unknowing)
        direct = rounded(without.logits)
        logits = pathways.scene * direct + (rounded(agent.logits) - direct)
        return agent._replace(logits=logits, hidden=jnp.concatenate([agent.hidden, without.hidden], axis=-1))

    def _split(self, memory: Memory) -> tuple[Memory, Memory]:
        """Return the memories of both."""
        agent, without = jnp.split(memory.hidden, [memory.hidden.shape[-1] - self.without.hidden], axis=-1)
        return memory._replace(hidden=agent), Memory(without, memory.action)


#: What decides in an evaluation.
Decider = Policy | Pair


def _both(pathways: Pathways) -> tuple[Pathways, Pathways]:
    """Return the pathways of both policies."""
    both: Any = pathways.experience
    return both
