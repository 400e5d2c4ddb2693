"""Spaces of observations and actions, by the conventions of gymnax.

`Discrete` and `Box` hold integers, `Dict` combines named spaces. `contains` returns a traced bool, so that spaces can
be checked inside jitted code.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp


class Space(Protocol):
    """Set of values that can be sampled and tested for membership."""

    def sample(self, key: jax.Array) -> Any:
        """Sample a value; the key is consumed."""
        ...

    def contains(self, x: Any) -> jax.Array:
        """Return True where a value is in the space, bool []."""
        ...


@dataclasses.dataclass(frozen=True)
class Discrete:
    """Integers from 0 to n - 1.

    Attributes:
      n: number of values.
      shape: shape of an array of values; () for single values.
      dtype: dtype of samples; `contains` accepts every integer dtype.
    """

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32

    def sample(self, key: jax.Array) -> jax.Array:
        """Sample uniformly; the key is consumed."""
        return jax.random.randint(key, self.shape, 0, self.n, self.dtype)

    def contains(self, x: Any) -> jax.Array:
        """Return True where a value is in the space, bool []."""
        # Shape and dtype are known when the code is traced, the range is not.
        x = jnp.asarray(x)
        if x.shape != self.shape or not jnp.issubdtype(x.dtype, jnp.integer):
            return jnp.bool_(False)
        return jnp.all((x >= 0) & (x < self.n))


@dataclasses.dataclass(frozen=True)
class Box:
    """Integer arrays within bounds.

    Attributes:
      low: least entry.
      high: greatest entry.
      shape: shape of the arrays.
      dtype: dtype of the entries.
    """

    low: int
    high: int
    shape: tuple[int, ...]
    dtype: Any

    def sample(self, key: jax.Array) -> jax.Array:
        """Sample entries uniformly; the key is consumed."""
        # The upper end of `randint` is exclusive, and may exceed the dtype of the entries.
        return jax.random.randint(key, self.shape, self.low, self.high + 1, jnp.int32).astype(self.dtype)

    def contains(self, x: Any) -> jax.Array:
        """Return True where an array is in the space, bool []."""
        # Shape and dtype are known when the code is traced, the bounds are not.
        x = jnp.asarray(x)
        if x.shape != self.shape or x.dtype != self.dtype:
            return jnp.bool_(False)
        return jnp.all((x >= self.low) & (x <= self.high))


@dataclasses.dataclass(frozen=True)
class Dict:
    """Named values.

    Attributes:
      spaces: space of each value, by name.
    """

    spaces: Mapping[str, Space]

    def sample(self, key: jax.Array) -> dict[str, Any]:
        """Sample every value; the key is consumed."""
        # One key for each space, in the order of the names.
        space_keys = jax.random.split(key, len(self.spaces))
        named_samples = {}
        for (name, space), space_key in zip(self.spaces.items(), space_keys, strict=True):
            named_samples[name] = space.sample(space_key)
        return named_samples

    def contains(self, x: Any) -> jax.Array:
        """Return True where every value is in its space, bool [].

        Args:
          x: a mapping, or an object with the names as attributes, for example an `Observation`.
        """
        # Other or missing names are known when the code is traced.
        named_values = x if isinstance(x, Mapping) else getattr(x, "__dict__", {})
        if named_values.keys() != self.spaces.keys():
            return jnp.bool_(False)

        # One traced bool for each value, [number of spaces].
        member_flags = []
        for name, space in self.spaces.items():
            member_flags.append(space.contains(named_values[name]))
        return jnp.stack(member_flags).all()
