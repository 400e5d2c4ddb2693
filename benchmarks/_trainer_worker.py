"""A trainer in a process of its own, and the environment and the policy's layers for other trainers than jaxnav's.

The environment has gymnax's interface with auto-reset, the layers are flax.linen modules.
"""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation, State
from jaxnav.policies.features import NUM_FEATURES, unpack_features
from jaxnav.policies.methods.org import ORG
from jaxnav.policies.network import INITIAL_DONE_LOGIT
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS

# The process


def serve(train: Callable[[Any], Any], state: Any) -> None:
    """Compile a trainer, then train once per line of stdin, and answer each with a line of JSON.

    Args:
      train: one training call, from a state to the state after some updates.
      state: to begin with; donated.
    """
    compiled = jax.jit(train, donate_argnums=0).lower(state).compile()
    print("null", flush=True)
    for _ in sys.stdin:
        state = jax.block_until_ready(compiled(state))
        print("null", flush=True)


# The environment


class EpisodeSlot(NamedTuple):
    """The episode of a slot, and its last action."""

    state: State
    action: jax.Array


class Adapter:
    """gymnax's `reset` and `step` with auto-reset.

    An observation is one array, which includes the previous action. As in jaxnav's policy, that action is `NUM_ACTIONS`
    at the start of an episode.
    """

    def __init__(self, env: ObjectNav, encode: Callable[[Observation, jax.Array], jax.Array]) -> None:
        self.env = env
        self.encode = encode

    def reset(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, EpisodeSlot]:
        observation, state = self.env.reset(key, params)
        slot = EpisodeSlot(state, jnp.int32(NUM_ACTIONS))
        return self.encode(observation, slot.action), slot

    def step(
        self, key: jax.Array, slot: EpisodeSlot, action: jax.Array, params: EnvParams
    ) -> tuple[jax.Array, EpisodeSlot, jax.Array, jax.Array, dict[str, Any]]:
        observation, state, reward, terminated, truncated, _ = self.env.step(key, slot.state, action, params)
        done = terminated | truncated
        previous_action = jnp.where(done, NUM_ACTIONS, action.astype(jnp.int32))
        return self.encode(observation, previous_action), EpisodeSlot(state, previous_action), reward, done, {}


def pack_observation(observation: Observation, action: jax.Array) -> jax.Array:
    """Return row, goal and previous action as bytes."""
    return jnp.concatenate([observation.row, jnp.stack([observation.goal, action]).astype(jnp.uint8)])


def unpack_observation(array: jax.Array, row_format: RowFormat) -> jax.Array:
    """Return the input of `Torso` for batches of `pack_observation` arrays."""
    array = array.astype(jnp.uint8)  # a trainer may build its parameters with an array of floats
    observation = Observation(array[..., :-2], array[..., -2].astype(jnp.int32))
    return to_vector(observation, array[..., -1].astype(jnp.int32), row_format)


def to_vector(observation: Observation, action: jax.Array, row_format: RowFormat) -> jax.Array:
    """Return view, table and previous action in one vector, float32."""
    features = unpack_features(observation.row, observation.goal, row_format)
    table = features.table.reshape(*features.table.shape[:-2], -1)
    return jnp.concatenate([features.view, table, jax.nn.one_hot(action, NUM_ACTIONS)], axis=-1)


# The policy's layers


class CategoryMaps(nn.Module):
    """Maps of all categories, [..., K, M] -> [..., K m]."""

    sizes: Sizes

    @nn.compact
    def __call__(self, rows: jax.Array) -> jax.Array:
        hidden = nn.relu(nn.Dense(self.sizes.row_hidden)(rows))
        maps = nn.relu(nn.Dense(self.sizes.row_outputs)(hidden))
        return maps.reshape(*maps.shape[:-2], -1)


class Torso(nn.Module):
    """The observation embedded as in the method `org`, [..., N] -> [..., H]."""

    spec: PolicySpec

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        sizes = self.spec.sizes
        num_categories = self.spec.num_categories

        # Split the vector into view, table [..., K, features] and previous action.
        num_cells = x.shape[-1] - NUM_ACTIONS - num_categories * NUM_FEATURES
        view, table, previous_action = jnp.split(x, [num_cells, x.shape[-1] - NUM_ACTIONS], axis=-1)
        table = table.reshape(*table.shape[:-1], num_categories, NUM_FEATURES)
        visible = table[..., 0]
        goal = table[..., -1]

        # Embeddings of the categories, and the layers of the relation.
        embedding_init = nn.initializers.variance_scaling(1.0, "fan_in", "normal", out_axis=0)
        appearance = self.param("appearance", embedding_init, (num_categories, sizes.appearance))
        goal_embedding = self.param("sought", embedding_init, (num_categories, sizes.appearance))
        mix_init = nn.initializers.lecun_normal(batch_axis=0)
        num_layers = ORG.experience.sizes["relation_layers"]
        relation_layers = self.param("mix", mix_init, (num_layers, num_categories, num_categories))

        # Experience: appearances of the visible categories, aggregated by a relation between categories.
        detections = CategoryMaps(sizes)(jnp.concatenate([visible[..., None] * appearance, table], axis=-1))
        relation = jnp.swapaxes(nn.relu(nn.Dense(num_categories)(table)), -1, -2)
        for kernel in relation_layers:
            relation = nn.relu(relation @ kernel)
        aggregated = (relation * visible[..., None, :]) @ appearance
        experience = CategoryMaps(sizes)(jnp.concatenate([aggregated, table], axis=-1))

        # All pathways are fused before the recurrent core.
        scene = nn.relu(nn.Dense(sizes.view_outputs)(view))
        pathways = [scene, detections, goal @ goal_embedding, experience, previous_action]
        return nn.relu(nn.Dense(sizes.hidden)(jnp.concatenate(pathways, axis=-1)))


def make_action_head() -> nn.Dense:
    """Return the layer of logits, which at first seldom choose Done."""
    kernel_init = nn.initializers.variance_scaling(1e-4, "fan_in", "normal")
    return nn.Dense(NUM_ACTIONS, kernel_init=kernel_init, bias_init=_init_action_bias)


def _init_action_bias(key: jax.Array, shape: Any, dtype: Any = jnp.float32) -> jax.Array:
    return jnp.zeros(shape, dtype).at[DONE].set(INITIAL_DONE_LOGIT)
