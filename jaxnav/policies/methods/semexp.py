"""Goal-oriented semantic exploration (Chaplot et al., NeurIPS 2020)."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.numerics.product import Linear
from jaxnav.policies.features import Features
from jaxnav.policies.methods.base import Experience, Method
from jaxnav.policies.methods.home import check_home, learn_home
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import SIDE, MapReading, MapTracker
from jaxnav.policies.semantic_map import EXPLORED, FREE, VISITED, WALL
from jaxnav.policies.spec import PolicySpec

_FLAGS = EXPLORED, FREE, WALL, VISITED


class MappedCategories(Experience):
    """Relate what was seen in each block of the map to the goal.

    What the map tells of floor and walls, and the compass, enter by the scene.
    """

    sizes: ClassVar[Mapping[str, int]] = {"block_outputs": 8}
    blocks: ClassVar[int] = SIDE**2
    geometry: ClassVar[int] = len(_FLAGS) * blocks + 2

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        outputs = self.size(spec, "block_outputs")
        self.relate = Linear(2 * spec.sizes.appearance, outputs, rngs=rngs)
        self.width = self.blocks * outputs

    @staticmethod
    def geometry_inputs(reading: MapReading) -> jax.Array:
        """Return the floor, walls and ways of each block, and the compass."""
        flags = [(reading.blocks & flag > 0).astype(jnp.float32) for flag in _FLAGS]
        return jnp.concatenate([*flags, reading.compass], axis=-1)

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: MapReading) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        shifts = np.arange(weights.shape[-1], dtype=np.uint32).reshape((1,) * reading.blocks.ndim + (-1,))
        bits = reading.blocks[..., None] >> shifts & np.uint32(1)
        seen = (bits.astype(jnp.float32) * weights[..., None, :]) @ appearance
        goal = jnp.broadcast_to((features.goal @ appearance)[..., None, :], seen.shape)
        blocks = nnx.relu(self.relate(jnp.concatenate([seen, goal], axis=-1)))
        return blocks.reshape(*blocks.shape[:-2], self.width)


SEMEXP = Method(MappedCategories, tracker=MapTracker(), learn=learn_home, control=LocalPolicy(), check=check_home)
#: The control that it must beat: the nearest frontier, whatever is chosen.
NEAREST = dataclasses.replace(SEMEXP, control=LocalPolicy(nearest=True))
