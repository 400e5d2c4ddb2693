"""A policy made of two: one with experience and one that is layout-blind, either of which can act."""

from typing import Any, cast

import jax.numpy as jnp

from jaxnav.numerics.rounding import round_to_grid
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import Decision, Pathways, PolicyInputs, PolicyState


class HandoverPolicy:
    """Policy with experience from which a removal of experience leaves another policy.

    As with two streams, experience is the difference that the first policy adds to the logits of the second: TDE
    (eq. 1) leaves the logits of the layout-blind policy, bit-identically, and the form `switch` of eq. 2 hands
    over to that policy. Both policies follow the whole episode, whichever acts. All methods work on batches.

    Attributes:
      experienced: the policy with experience.
      layout_blind: a layout-blind policy without a tracker; the two share one spatial memory.
    """

    def __init__(self, experienced: Policy, layout_blind: Policy) -> None:
        self.experienced = experienced
        self.layout_blind = layout_blind

    def initial_memory(self, batch: tuple[int, ...] = ()) -> PolicyState:
        """Return the state of both policies at the start of an episode, their hidden states joined."""
        experienced_state = self.experienced.initial_memory(batch)
        layout_blind_state = self.layout_blind.initial_memory(batch)
        hidden = jnp.concatenate([experienced_state.hidden, layout_blind_state.hidden], axis=-1)
        return experienced_state._replace(hidden=hidden)

    def pathways(self, inputs: PolicyInputs, memory: PolicyState) -> Pathways:
        """Embed the inputs of both policies; arguments as in `Policy.pathways`.

        The experience is the pair of the two policies' pathways. Scene and goal are 1 [..., 1]; setting them to 0
        removes the layout-blind policy.
        """
        experienced_state, layout_blind_state = self._split_state(memory)
        # The policy with experience reads everything, the layout weights included.
        experienced_pathways = self.experienced.pathways(inputs, experienced_state)
        # The layout-blind policy knows no layout and has no tracker.
        plain_inputs = inputs._replace(layout_weights=jnp.ones_like(inputs.layout_weights), reading=None)
        layout_blind_pathways = self.layout_blind.pathways(plain_inputs, layout_blind_state)

        # Scene and goal are factors on the layout-blind policy, float32 [..., 1].
        ones = jnp.ones_like(inputs.layout_weights[..., :1])
        both_pathways: Any = (experienced_pathways, layout_blind_pathways)
        return Pathways(scene=ones, goal=ones, experience=both_pathways, gate=ones)

    def decide(self, pathways: Pathways, memory: PolicyState) -> Decision:
        """Return the logits of the policy that acts, with the value of the policy with experience."""
        experienced_state, layout_blind_state = self._split_state(memory)
        experienced_pathways, layout_blind_pathways = cast(tuple[Pathways, Pathways], pathways.experience)
        # Both policies decide at every step, whichever acts.
        experienced_output = self.experienced.decide(experienced_pathways, experienced_state)
        layout_blind_output = self.layout_blind.decide(layout_blind_pathways, layout_blind_state)

        # Rounded logits add and subtract without error, so removal restores the direct logits exactly.
        direct_logits = round_to_grid(layout_blind_output.logits)
        experience_logits = round_to_grid(experienced_output.logits) - direct_logits
        logits = pathways.scene * direct_logits + experience_logits

        # Both hidden states continue, joined in the order of `initial_memory`.
        hidden = jnp.concatenate([experienced_output.hidden, layout_blind_output.hidden], axis=-1)
        return experienced_output._replace(logits=logits, hidden=hidden)

    def _split_state(self, memory: PolicyState) -> tuple[PolicyState, PolicyState]:
        """Split the joined state into those of the two policies."""
        # The state of the policy with experience comes first.
        experienced_width = memory.hidden.shape[-1] - self.layout_blind.hidden
        experienced_hidden, layout_blind_hidden = jnp.split(memory.hidden, [experienced_width], axis=-1)
        return memory._replace(hidden=experienced_hidden), PolicyState(layout_blind_hidden, memory.action)


#: Either kind of policy that an agent loop can run.
Decider = Policy | HandoverPolicy
