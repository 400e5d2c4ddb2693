"""ORG whose training begins with a stage of imitation alone, for the search of guidance: `imitation_first:ORG`."""

import dataclasses
from typing import Any

import jax

from jaxnav.policies.method import Stage
from jaxnav.policies.methods import org
from jaxnav.policies.methods.imitation import expert_actions, imitation_loss

_IMITATION_SHARE = 0.2


def imitate(replay: Any, *_: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the cross-entropy of the policy's own logits to the actions of shortest paths."""
    return imitation_loss(replay.factual.logits, expert_actions(replay))


ORG = dataclasses.replace(org.ORG, stages=(Stage(_IMITATION_SHARE, imitate, uses_expert=True), Stage(0.8)))
