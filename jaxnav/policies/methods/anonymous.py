"""The agent that cannot know any layout: the reference for what experience is worth."""

import jax.numpy as jnp

from jaxnav.policies.features import Features
from jaxnav.policies.methods.base import Method
from jaxnav.policies.methods.rgb import NoExperience


def goal_alone(features: Features) -> Features:
    """Keep the view and the goal's own detection.

    The detection becomes that of a single category without a name, K = 1: which goal it is, what else is detected, and
    so every co-occurrence, is gone.
    """
    row = (features.goal[..., None] * features.table).sum(axis=-2, keepdims=True)
    return Features(
        view=features.view,
        visible=(features.goal * features.visible).sum(axis=-1, keepdims=True),
        table=row,
        goal=jnp.ones_like(features.goal[..., :1]),
    )


ANONYMOUS = Method(NoExperience, perceive=goal_alone, hosts_layout=False)
