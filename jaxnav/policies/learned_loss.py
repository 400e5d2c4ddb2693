"""The loss that judges what an agent did without reward (SAVN: Wortsman et al., CVPR 2019)."""

from typing import Protocol

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear

#: Environment steps between two inner steps. The loss reads all of them.
WINDOW = 6
_CHANNELS = 10
_TINY = 1e-12  # below the square of any loss


class LearnedLoss(nnx.Module):
    """Judge a window without reward.

    Two causal convolutions along a row's entries, the window's steps being channels, and the length of the result.
    """

    def __init__(self, rngs: nnx.Rngs) -> None:
        self.first, self.second = Linear(2 * WINDOW, _CHANNELS, rngs=rngs), Linear(2 * _CHANNELS, 1, rngs=rngs)

    def __call__(self, rows: jax.Array) -> jax.Array:
        """Return the loss of rows float32 [..., W, L], at least 0."""
        entries = jnp.swapaxes(rows, -1, -2)
        inner = nnx.leaky_relu(self.first(_with_earlier(entries, 1)))
        outer = nnx.leaky_relu(self.second(_with_earlier(inner, 2)))
        return jnp.sqrt(jnp.square(outer).sum(axis=(-2, -1)) + _TINY)


class Judging(Protocol):
    """Hold a learned loss, as the experience of a method that adapts by it does."""

    learned_loss: LearnedLoss


def _with_earlier(entries: jax.Array, distance: int) -> jax.Array:
    """Join each entry [..., L, C] and the one so far before it."""
    earlier = jnp.concatenate([jnp.zeros_like(entries[..., :distance, :]), entries[..., :-distance, :]], axis=-2)
    return jnp.concatenate([earlier, entries], axis=-1)
