"""Meta-learned adaptation without reward (SAVN: Wortsman et al., CVPR 2019)."""

import dataclasses

from flax import nnx

from jaxnav.policies.adaptation import LearnedSteps
from jaxnav.policies.learned_loss import LearnedLoss
from jaxnav.policies.methods.base import Experience, Method
from jaxnav.policies.methods.rgb import NoExperience
from jaxnav.policies.spec import PolicySpec


class WithLearnedLoss(Experience):
    """Add a learned loss to another experience, before which it is inherited."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.learned_loss = LearnedLoss(rngs)


class LearnedInteraction(WithLearnedLoss, NoExperience):
    """Make no experience; a learned loss stands by."""


SAVN = Method(LearnedInteraction, adaptation=LearnedSteps(), hosts_layout=False)
#: The ablation that it must beat: the same network, never adapted.
UNADAPTED = dataclasses.replace(SAVN, adaptation=None)
#: SAVN whose training does not differentiate the inner gradient but by the learned loss.
FIRST_ORDER = dataclasses.replace(SAVN, adaptation=LearnedSteps(second_order=False))
