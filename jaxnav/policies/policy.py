"""The policy: pathways from an observation, and the recurrent decision on them.

A policy is built once; only its parameters, a nested dict of arrays, are kept in states and on disk:

    params = init_params(spec, key)
    policy = bind(spec, params)
    pathways = policy.pathways(observation, weights)
    decision = policy.decide(pathways, memory)
    counterfactual = policy.decide(do(pathways, scene=0, goal=0), memory)
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.env.types import Observation
from jaxnav.numerics.product import Linear, biased, product
from jaxnav.numerics.recurrence import gru
from jaxnav.policies.features import CONFIDENCE, NUM_FEATURES, features
from jaxnav.policies.methods import METHODS, CategoryMaps
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory, Pathways
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS

Params = dict[str, Any]

#: First logit of Done: chosen once in 60 steps, for an agent that gives up at once never learns what it might find.
SELDOM = -2.5
DONE_GATE = 0.58  # times the confidence of the goal's detection


class Policy(nnx.Module):
    """Three pathways and a recurrent decision; works on single observations and on batches."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        row_format = RowFormat(spec.num_categories)
        self.row_format = row_format
        self.hidden, self.direct, self.done_gate = spec.sizes.hidden, spec.direct, spec.done_gate
        self.appearance = nnx.Embed(spec.num_categories, spec.sizes.appearance, rngs=rngs)
        self.view = Linear(2 * row_format.view**2, spec.sizes.view_outputs, rngs=rngs)
        self.detections = CategoryMaps(spec.sizes.appearance + NUM_FEATURES, spec, rngs)
        self.sought = nnx.Embed(spec.num_categories, spec.sizes.appearance, rngs=rngs)
        self.method = METHODS[spec.method](spec, rngs)
        goal = self.detections.width + spec.sizes.appearance
        self.widths = (spec.sizes.view_outputs, goal, self.method.width, NUM_ACTIONS)
        self.fuse = Linear(sum(self.widths), spec.sizes.hidden, rngs=rngs)
        self.core = nnx.GRUCell(spec.sizes.hidden, spec.sizes.hidden, rngs=rngs)
        # Small first logits: the first policy is close to uniform but for Done.
        small = nnx.initializers.variance_scaling(1e-4, "fan_in", "normal")
        self.actor = Linear(spec.sizes.hidden, NUM_ACTIONS, kernel_init=small, bias_init=_seldom_done, rngs=rngs)
        self.critic = Linear(spec.sizes.hidden, 1, rngs=rngs)

    def pathways(self, observation: Observation, weights: jax.Array) -> Pathways:
        """Embeddings of what is seen, what is sought and what experience says.

        Args:
          observation: a batch [...] of observations.
          weights: float32 [..., K], the layout's weights for the goal (eq. 7); ones leave the layout out.
        """
        seen = features(observation.row, observation.goal, self.row_format)
        appearance = self.appearance.embedding[...]
        looks = self.detections.looks(appearance)
        looks = seen.visible[..., None] * jnp.broadcast_to(looks, (*seen.visible.shape, looks.shape[-1]))
        rows = looks + self.detections.read(seen.table)
        if self.direct != "all":
            rows = rows * (seen.goal if self.direct == "goal" else jnp.zeros_like(seen.goal))[..., None]
        goal = jnp.concatenate([self.detections.maps(rows), seen.goal @ self.sought.embedding[...]], axis=-1)
        confidence = (seen.table[..., CONFIDENCE] * seen.goal).sum(axis=-1, keepdims=True)
        return Pathways(
            scene=nnx.relu(self.view(seen.view)),
            goal=goal,
            experience=self.method(seen, appearance, jax.lax.stop_gradient(weights)),
            gate=DONE_GATE * confidence if self.done_gate else jnp.ones_like(confidence),
        )

    def decide(self, pathways: Pathways, memory: Memory) -> Decision:
        """Action logits and value from the pathways and the memory.

        Where a factual and a counterfactual decision stand in one compiled function, what they share (the products of
        experience and of memory) is computed once.
        """
        drive = self.drive(self.direct_input(pathways) + self.mediated_input(pathways, memory.action))
        hidden = gru(drive, memory.hidden @ self.recurrent_kernel, memory.hidden)
        return self.act(hidden, pathways.gate)

    def direct_input(self, pathways: Pathways) -> jax.Array:
        """What enters by the direct pathways, float32 [..., H]: linear, so zero where both are set to zero."""
        scene, goal, *_ = self._fuse_kernels
        return product(pathways.scene, scene) + product(pathways.goal, goal)

    def mediated_input(self, pathways: Pathways, action: jax.Array) -> jax.Array:
        """What enters by experience and with the previous action int32 [...], float32 [..., H]."""
        *_, experience, previous = self._fuse_kernels
        one_hot = jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)
        return biased(product(pathways.experience, experience) + product(one_hot, previous), self.fuse)

    def drive(self, entering: jax.Array) -> jax.Array:
        """What drives the recurrent core, float32 [..., 3 H], given all that enters, float32 [..., H]."""
        return biased(product(nnx.relu(entering), self.core.dense_i.kernel[...]), self.core.dense_i)

    def act(self, hidden: jax.Array, gate: jax.Array) -> Decision:
        """The decision of a hidden state float32 [..., H] and a gate float32 [..., 1]."""
        logits = self.actor(hidden)
        if self.done_gate:
            logits = jnp.concatenate([logits[..., :DONE], gate * logits[..., DONE:]], axis=-1)
        return Decision(logits=logits, value=self.critic(hidden)[..., 0], hidden=hidden)

    @property
    def recurrent_kernel(self) -> jax.Array:
        """float32 [H, 3 H], multiplies the hidden state."""
        return self.core.dense_h.kernel[...]

    @property
    def _fuse_kernels(self) -> list[jax.Array]:
        """The part of the first kernel that each of scene, goal, experience and previous action meets."""
        return jnp.split(self.fuse.kernel[...], np.cumsum(self.widths)[:-1])

    def initial_memory(self, batch: tuple[int, ...] = ()) -> Memory:
        """Memory at the start of an episode."""
        return Memory(hidden=jnp.zeros((*batch, self.hidden)), action=jnp.full(batch, NO_ACTION, jnp.int32))


def _seldom_done(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    del key
    return jnp.zeros(shape, dtype).at[DONE].set(SELDOM)


def init_params(spec: PolicySpec, key: jax.Array) -> Params:
    """Fresh parameters: a nested dict of float32 arrays."""
    return nnx.to_pure_dict(nnx.state(Policy(spec, nnx.Rngs(params=key)), nnx.Param))


def bind(spec: PolicySpec, params: Params) -> Policy:
    """The policy with these parameters; call it inside a jitted function."""
    return nnx.merge(_graph(spec), params)


@functools.lru_cache(maxsize=16)
def _graph(spec: PolicySpec) -> nnx.GraphDef[Policy]:
    abstract = nnx.eval_shape(lambda: Policy(spec, nnx.Rngs(0)))
    return nnx.split(abstract)[0]
