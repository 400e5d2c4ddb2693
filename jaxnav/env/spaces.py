"""Spaces of observations and actions, by the conventions of gymnax."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp


class Space(Protocol):
    """Describe a set of values."""

    def sample(self, key: jax.Array) -> Any:
        """Draw a value; the key is consumed."""
        ...

    def contains(self, x: Any) -> jax.Array:
        """Return whether a value is in the space, bool []."""
        ...


@dataclasses.dataclass(frozen=True)
class Discrete:
    """Hold the whole numbers from 0 to n - 1.

    Attributes:
      n: how many.
      shape: of an array of them.
      dtype: in which they are drawn; others of whole numbers are contained too.
    """

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw a number uniformly; the key is consumed."""
        return jax.random.randint(key, self.shape, 0, self.n, self.dtype)

    def contains(self, x: Any) -> jax.Array:
        """Return whether a number is in the space, bool []."""
        x = jnp.asarray(x)
        if x.shape != self.shape or not jnp.issubdtype(x.dtype, jnp.integer):
            return jnp.bool_(False)
        return jnp.all((x >= 0) & (x < self.n))


@dataclasses.dataclass(frozen=True)
class Box:
    """Hold arrays of whole numbers within bounds.

    Attributes:
      low, high: least and greatest entry.
      shape: of the array.
      dtype: of its entries.
    """

    low: int
    high: int
    shape: tuple[int, ...]
    dtype: Any

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw entries uniformly; the key is consumed."""
        return jax.random.randint(key, self.shape, self.low, self.high + 1, jnp.int32).astype(self.dtype)

    def contains(self, x: Any) -> jax.Array:
        """Return whether an array is in the space, bool []."""
        x = jnp.asarray(x)
        if x.shape != self.shape or x.dtype != self.dtype:
            return jnp.bool_(False)
        return jnp.all((x >= self.low) & (x <= self.high))


@dataclasses.dataclass(frozen=True)
class Dict:
    """Hold values by name.

    Attributes:
      spaces: of the values.
    """

    spaces: Mapping[str, Space]

    def sample(self, key: jax.Array) -> dict[str, Any]:
        """Draw every value; the key is consumed."""
        keys = jax.random.split(key, len(self.spaces))
        return {name: space.sample(k) for (name, space), k in zip(self.spaces.items(), keys, strict=True)}

    def contains(self, x: Any) -> jax.Array:
        """Return whether every value is in its space, bool [].

        Args:
          x: a mapping, or an object with the names as attributes, such as an `Observation`.
        """
        values = x if isinstance(x, Mapping) else getattr(x, "__dict__", {})
        if values.keys() != self.spaces.keys():
            return jnp.bool_(False)
        return jnp.stack([space.contains(values[name]) for name, space in self.spaces.items()]).all()
