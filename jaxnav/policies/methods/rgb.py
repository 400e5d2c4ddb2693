"""RGB+RL: detections without a model of experience (A3C in the paper)."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.policies.features import Features
from jaxnav.policies.methods.base import Experience, Method
from jaxnav.policies.spec import PolicySpec


class NoExperience(Experience):
    """Make no experience: Z is empty."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.width = 0

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> jax.Array:
        """Return experience of no width."""
        return jnp.zeros((*weights.shape[:-1], 0), jnp.float32)


RGB = Method(NoExperience)
