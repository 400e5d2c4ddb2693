"""SAVN: `rgb` that adapts within the episode by a learned loss.

Source: M. Wortsman et al., *Learning to Learn How to Learn: Self-Adaptive Visual Navigation Using Meta-Learning*, CVPR
2019, and its released code. The steps and the loss are in `jaxnav.policies.adaptation`.

Kept: the policy has the network of `rgb` and takes a step of gradient descent on a learned loss every six decisions of
an episode; training differentiates the loss of PPO through these steps. Changed: only the fusing layer, the recurrent
core and the actor adapt, at a rate of 0.01, and training unrolls the steps of a rollout, not of a whole episode.
"""

import dataclasses

from flax import nnx

from jaxnav.policies.adaptation import LearnedLoss, LearnedLossAdaptation
from jaxnav.policies.method import Experience, Method
from jaxnav.policies.methods.rgb import NoExperience
from jaxnav.policies.spec import PolicySpec


class LearnedLossExperience(Experience):
    """Mixin that adds a learned loss to another experience; it must be the first base class."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.learned_loss = LearnedLoss(rngs)


class LearnedInteraction(LearnedLossExperience, NoExperience):
    """Empty experience, with a learned loss for the adaptation."""


SAVN = Method(LearnedInteraction, adaptation=LearnedLossAdaptation(), hosts_layout=False, name="savn")
#: Ablation: SAVN without adaptation.
UNADAPTED = dataclasses.replace(SAVN, adaptation=None)
#: First-order variant: training does not differentiate the inner gradient, except by the learned loss.
FIRST_ORDER = dataclasses.replace(SAVN, adaptation=LearnedLossAdaptation(second_order=False))
