"""A policy made of two: one with experience and one without, either of which can act."""

from typing import Any, cast

import jax.numpy as jnp

from jaxnav.numerics.rounding import round_to_grid
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import Decision, Pathways, PolicyInputs, PolicyState


class HandoverPolicy:
    """Policy with experience from which a removal of experience leaves another policy.

    As with two streams, experience is the difference that the first policy adds to the logits of the second: TDE
    (eq. 1) leaves the logits of the policy without experience, bit-identically, and the form `switch` of eq. 2 hands
    over to that policy. Both policies follow the whole episode, whichever acts. All methods work on batches.

    Attributes:
      with_experience: the policy with experience.
      without_experience: a policy without experience and without a tracker; the two share one spatial memory.
    """

    def __init__(self, with_experience: Policy, without_experience: Policy) -> None:
        self.with_experience = with_experience
        self.without_experience = without_experience

    def initial_memory(self, batch: tuple[int, ...] = ()) -> PolicyState:
        """Return the state of both policies at the start of an episode, their hidden states joined."""
        state_with = self.with_experience.initial_memory(batch)
        state_without = self.without_experience.initial_memory(batch)
        return state_with._replace(hidden=jnp.concatenate([state_with.hidden, state_without.hidden], axis=-1))

    def pathways(self, inputs: PolicyInputs, memory: PolicyState) -> Pathways:
        """Embed the inputs of both policies; arguments as in `Policy.pathways`.

        The experience is the pair of the two policies' pathways. Scene and goal are 1 [..., 1]; setting them to 0
        removes the policy without experience.
        """
        state_with, state_without = self._split_state(memory)
        # The policy with experience reads everything, the layout weights included.
        pathways_with = self.with_experience.pathways(inputs, state_with)
        # The policy without experience knows no layout and has no tracker.
        plain_inputs = inputs._replace(layout_weights=jnp.ones_like(inputs.layout_weights), reading=None)
        pathways_without = self.without_experience.pathways(plain_inputs, state_without)

        # Scene and goal are factors on the policy without experience, float32 [..., 1].
        ones = jnp.ones_like(inputs.layout_weights[..., :1])
        both_pathways: Any = (pathways_with, pathways_without)
        return Pathways(scene=ones, goal=ones, experience=both_pathways, gate=ones)

    def decide(self, pathways: Pathways, memory: PolicyState) -> Decision:
        """Return the logits of the policy that acts, with the value of the policy with experience."""
        state_with, state_without = self._split_state(memory)
        pathways_with, pathways_without = cast(tuple[Pathways, Pathways], pathways.experience)
        # Both policies decide at every step, whichever acts.
        output_with = self.with_experience.decide(pathways_with, state_with)
        output_without = self.without_experience.decide(pathways_without, state_without)

        # Rounded logits add and subtract without error, so removal restores the direct logits exactly.
        direct_logits = round_to_grid(output_without.logits)
        experience_logits = round_to_grid(output_with.logits) - direct_logits
        logits = pathways.scene * direct_logits + experience_logits

        # Both hidden states continue, joined in the order of `initial_memory`.
        hidden = jnp.concatenate([output_with.hidden, output_without.hidden], axis=-1)
        return output_with._replace(logits=logits, hidden=hidden)

    def _split_state(self, memory: PolicyState) -> tuple[PolicyState, PolicyState]:
        """Split the joined state into those of the two policies."""
        # The state of the policy with experience comes first.
        width_with = memory.hidden.shape[-1] - self.without_experience.hidden
        hidden_with, hidden_without = jnp.split(memory.hidden, [width_with], axis=-1)
        return memory._replace(hidden=hidden_with), PolicyState(hidden_without, memory.action)


#: Either kind of policy that an agent loop can run.
Decider = Policy | HandoverPolicy
