"""RGB+RL: reinforcement learning on detections, without a model of experience.

The module also defines the method of layout-blind agents:
  `anonymous`: a layout-blind agent, which sees free and blocked cells and the detection of its goal alone.

Source: the baseline *RGB+RL* of Zhang et al., *Layout-based Causal Inference for Object Navigation*, CVPR 2023.

Kept: detections and view reach the policy directly and Z is empty. Changed: the view is a plan of the floor seen ahead,
as depth would give it, and the learner is PPO in place of A3C.

`anonymous` has no counterpart in the paper. Its networks receive the view and the goal's detection, as the detection of
one nameless category, so it cannot learn any layout: the gain of a method over `anonymous` is the value of experience.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.policies.features import Features
from jaxnav.policies.method import Experience, Method
from jaxnav.policies.spec import PolicySpec


class NoExperience(Experience):
    """Empty experience: Z has no entries."""

    is_empty = True

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.width = 0

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> jax.Array:
        """Return the empty experience, float32 [..., 0]."""
        return jnp.zeros((*weights.shape[:-1], 0), jnp.float32)


def keep_goal_detection(features: Features) -> Features:
    """Keep the view and the detection of the goal.

    The features have a single nameless category, K = 1. The goal's name and all detections of other categories, and
    with them every co-occurrence, are removed.
    """
    goal_row = (features.goal[..., None] * features.table).sum(axis=-2, keepdims=True)
    return Features(
        view=features.view,
        visible=(features.goal * features.visible).sum(axis=-1, keepdims=True),
        table=goal_row,
        goal=jnp.ones_like(features.goal[..., :1]),
    )


RGB = Method(NoExperience, name="rgb")
ANONYMOUS = Method(NoExperience, perceive=keep_goal_detection, hosts_layout=False, name="anonymous")
