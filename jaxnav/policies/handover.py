"""A policy made of two: one with experience and a fallback without it, either of which can act.

Handover to a layout-blind policy uses this class, and so does the controlled direct effect (CDE), whose fallback is the
policy itself under do(Z = 0).
"""

from typing import Any, ClassVar, cast

import jax.numpy as jnp

from jaxnav.causal import do
from jaxnav.numerics.rounding import round_to_grid
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import Decision, Pathways, PolicyInputs, PolicyState


class HandoverPolicy:
    """Policy with experience from which a removal of experience leaves a fallback policy.

    As with two streams, experience is the difference that the first policy adds to the logits of the fallback: TDE
    (eq. 1) leaves the logits of the fallback, bit-identically, and the form `switch` of eq. 2 hands over to it. With
    the logits a of the policy and a0 of the fallback, the form `paper` is a - s (a - a0). Both policies follow the
    whole episode, each with a memory of its own, whichever acts. All methods work on batches.

    The fallback is a layout-blind policy, or the policy itself under do(Z = 0) throughout the episode. The logits a0
    of the latter hold the controlled direct effect of scene and goal; experience dropout trains them.

    Attributes:
      primary: the policy with experience.
      fallback: the policy that a removal leaves. A layout-blind one has no tracker, and the two share one spatial
        memory.
      is_same_network: True if the fallback is `primary` under do(Z = 0).
    """

    has_additive_scores: ClassVar[bool] = False
    num_scene_factors: ClassVar[int] = 1  # the scene is the factor of the fallback

    def __init__(self, primary: Policy, layout_blind: Policy | None = None) -> None:
        """Pair two policies.

        Args:
          primary: the policy with experience.
          layout_blind: the fallback; None for `primary` under do(Z = 0).
        """
        self.primary = primary
        self.fallback = primary if layout_blind is None else layout_blind
        self.is_same_network = layout_blind is None

    def initial_memory(self, batch: tuple[int, ...] = ()) -> PolicyState:
        """Return the state of both policies at the start of an episode, their hidden states joined."""
        primary_state = self.primary.initial_memory(batch)
        fallback_state = self.fallback.initial_memory(batch)
        hidden = jnp.concatenate([primary_state.hidden, fallback_state.hidden], axis=-1)
        # The fallback takes the place of the counterfactual branch.
        return primary_state._replace(
            hidden=hidden, fast=(primary_state.fast, fallback_state.fast), counterfactual_hidden=None
        )

    def pathways(self, inputs: PolicyInputs, memory: PolicyState) -> Pathways:
        """Embed the inputs of both policies; arguments as in `Policy.pathways`.

        The experience is the pair of the two policies' pathways. Scene and goal are 1 [..., 1]; a scene of 0 removes
        the fallback, whatever the goal.
        """
        primary_state, fallback_state = self._split_state(memory)
        # The policy with experience reads everything, the layout weights included.
        primary_pathways = self.primary.pathways(inputs, primary_state)
        if self.is_same_network:
            fallback_pathways = do(self.fallback.pathways(inputs, fallback_state), experience=0.0)
        else:
            # The layout-blind policy knows no layout and has no tracker.
            plain_inputs = inputs._replace(layout_weights=jnp.ones_like(inputs.layout_weights), reading=None)
            fallback_pathways = self.fallback.pathways(plain_inputs, fallback_state)

        # The scene is a factor on the fallback, float32 [..., 1].
        ones = jnp.ones_like(inputs.layout_weights[..., :1])
        both_pathways: Any = (primary_pathways, fallback_pathways)
        return Pathways(scene=ones, goal=ones, experience=both_pathways, gate=ones)

    def decide(self, pathways: Pathways, memory: PolicyState) -> Decision:
        """Return the logits of the policy that acts, with the value of the policy with experience."""
        primary_state, fallback_state = self._split_state(memory)
        primary_pathways, fallback_pathways = cast(tuple[Pathways, Pathways], pathways.experience)
        # Both policies decide at every step, whichever acts.
        primary_output = self.primary.decide(primary_pathways, primary_state)
        fallback_output = self.fallback.decide(fallback_pathways, fallback_state)

        # Rounded logits add and subtract without error, so removal restores the direct logits exactly.
        direct_logits = round_to_grid(fallback_output.logits)
        experience_logits = round_to_grid(primary_output.logits) - direct_logits
        logits = pathways.scene * direct_logits + experience_logits

        # Both memories continue, joined in the order of `initial_memory`.
        hidden = jnp.concatenate([primary_output.hidden, fallback_output.hidden], axis=-1)
        fast = (primary_output.fast, fallback_output.fast)
        return primary_output._replace(logits=logits, hidden=hidden, fast=fast)

    def _split_state(self, memory: PolicyState) -> tuple[PolicyState, PolicyState]:
        """Split the joined state into those of the two policies."""
        # The state of the policy with experience comes first.
        fallback_width = self.fallback.initial_memory().hidden.shape[-1]
        primary_width = memory.hidden.shape[-1] - fallback_width
        primary_hidden, fallback_hidden = jnp.split(memory.hidden, [primary_width], axis=-1)
        primary_fast, fallback_fast = memory.fast
        primary_state = memory._replace(hidden=primary_hidden, fast=primary_fast)
        return primary_state, PolicyState(fallback_hidden, memory.action, fallback_fast)


#: Either kind of policy that an agent loop can run.
Decider = Policy | HandoverPolicy
