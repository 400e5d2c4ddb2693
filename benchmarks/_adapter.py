"""The environment and the policy's layers for other trainers.

The environment has gymnax's interface with auto-reset, the layers are flax.linen modules.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, Observation, State
from jaxnav.policies.features import NUM_FEATURES, features
from jaxnav.policies.methods.org import ORG
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.policies.stream import SELDOM
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS


class Slot(NamedTuple):
    """Hold an episode, its last action and its slot's counts."""

    state: State
    action: jax.Array
    episodes: jax.Array
    successes: jax.Array


class Adapter:
    """Offer gymnax's `reset` and `step` with auto-reset.

    An observation is one array, the previous action part of it. As in jaxnav's policy, that action is `NUM_ACTIONS` at
    the start of an episode.
    """

    def __init__(self, env: ObjectNav, encode: Callable[[Observation, jax.Array], jax.Array]) -> None:
        self.env, self.encode = env, encode

    def reset(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, Slot]:
        observation, state = self.env.reset(key, params)
        slot = Slot(state, jnp.int32(NUM_ACTIONS), jnp.int32(0), jnp.int32(0))
        return self.encode(observation, slot.action), slot

    def step(
        self, key: jax.Array, slot: Slot, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, Slot, jax.Array, jax.Array, dict[str, Any]]:
        observation, state, reward, terminated, truncated, info = self.env.step(key, slot.state, action, params)
        done = terminated | truncated
        previous = jnp.where(done, NUM_ACTIONS, action.astype(jnp.int32))
        slot = Slot(state, previous, slot.episodes + done, slot.successes + info["success"])
        return self.encode(observation, previous), slot, reward, done, {}


def ended(before: Slot, after: Slot) -> tuple[jax.Array, jax.Array]:
    """Count episodes and successes between two batches of slots."""
    return (after.episodes - before.episodes).sum(), (after.successes - before.successes).sum()


def packed(observation: Observation, action: jax.Array) -> jax.Array:
    """Pack row, goal and previous action as bytes."""
    return jnp.concatenate([observation.row, jnp.stack([observation.goal, action]).astype(jnp.uint8)])


def unpacked(array: jax.Array, row_format: RowFormat) -> jax.Array:
    """Turn batches of `packed` arrays into what `Torso` reads."""
    array = array.astype(jnp.uint8)  # a trainer may build its parameters with an array of floats
    observation = Observation(array[..., :-2], array[..., -2].astype(jnp.int32))
    return vector(observation, array[..., -1].astype(jnp.int32), row_format)


def vector(observation: Observation, action: jax.Array, row_format: RowFormat) -> jax.Array:
    """Join view, table and previous action, float32."""
    seen = features(observation.row, observation.goal, row_format)
    table = seen.table.reshape(*seen.table.shape[:-2], -1)
    return jnp.concatenate([seen.view, table, jax.nn.one_hot(action, NUM_ACTIONS)], axis=-1)


class CategoryMaps(nn.Module):
    """Map all rows, [..., K, M] -> [..., K m]."""

    sizes: Sizes

    @nn.compact
    def __call__(self, rows: jax.Array) -> jax.Array:
        inner = nn.relu(nn.Dense(self.sizes.row_hidden)(rows))
        maps = nn.relu(nn.Dense(self.sizes.row_outputs)(inner))
        return maps.reshape(*maps.shape[:-2], -1)


class Torso(nn.Module):
    """Embed an observation as `org`, [..., N] -> [..., H]."""

    spec: PolicySpec

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        sizes, num_categories = self.spec.sizes, self.spec.num_categories
        cells = x.shape[-1] - NUM_ACTIONS - num_categories * NUM_FEATURES
        view, table, previous = jnp.split(x, [cells, x.shape[-1] - NUM_ACTIONS], axis=-1)
        table = table.reshape(*table.shape[:-1], num_categories, NUM_FEATURES)
        visible, goal = table[..., 0], table[..., -1]
        embedding = nn.initializers.variance_scaling(1.0, "fan_in", "normal", out_axis=0)
        appearance, sought = (
            self.param(name, embedding, (num_categories, sizes.appearance)) for name in ("appearance", "sought")
        )
        mixing = nn.initializers.lecun_normal(batch_axis=0)
        mix = self.param("mix", mixing, (ORG.experience.sizes["relation_layers"], num_categories, num_categories))

        detections = CategoryMaps(sizes)(jnp.concatenate([visible[..., None] * appearance, table], axis=-1))
        relation = jnp.swapaxes(nn.relu(nn.Dense(num_categories)(table)), -1, -2)
        for kernel in mix:
            relation = nn.relu(relation @ kernel)
        aggregated = (relation * visible[..., None, :]) @ appearance
        experience = CategoryMaps(sizes)(jnp.concatenate([aggregated, table], axis=-1))
        scene = nn.relu(nn.Dense(sizes.view_outputs)(view))
        together = jnp.concatenate([scene, detections, goal @ sought, experience, previous], axis=-1)
        return nn.relu(nn.Dense(sizes.hidden)(together))


def action_head() -> nn.Dense:
    """Return the layer of logits, which choose Done seldom."""
    small = nn.initializers.variance_scaling(1e-4, "fan_in", "normal")
    return nn.Dense(NUM_ACTIONS, kernel_init=small, bias_init=_seldom_done)


def _seldom_done(key: jax.Array, shape: Any, dtype: Any = jnp.float32) -> jax.Array:
    return jnp.zeros(shape, dtype).at[DONE].set(SELDOM)
