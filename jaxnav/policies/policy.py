"""The policy: pathways from an observation, and the recurrent decision on them.

A policy is built once; only its parameters, a nested dict of arrays, are kept in states and on disk:

    params = init_params(spec, key)
    policy = bind(spec, params)
    pathways = policy.pathways(observation, weights, reading, surroundings, memory)
    decision = policy.decide(pathways, memory)
    counterfactual = policy.decide(do(pathways, scene=0, goal=0), memory)
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.env.types import Observation
from jaxnav.numerics.product import Linear, biased, product
from jaxnav.numerics.recurrence import gru
from jaxnav.policies.category_maps import CategoryMaps
from jaxnav.policies.features import CONFIDENCE, NUM_FEATURES, Features, features
from jaxnav.policies.methods import find_method
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory, Pathways
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS

Params = dict[str, Any]

#: First logit of Done: chosen once in 60 steps, for an agent that gives up at once never learns what it might find.
SELDOM = -2.5
DONE_GATE = 0.58  # times the confidence of the goal's detection


class Policy(nnx.Module):
    """Decide by three pathways; works on single observations and batches."""

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        method, sizes = find_method(spec.method), spec.sizes
        self.row_format = RowFormat(spec.num_categories)
        self.perceive, self.adaptation = method.perceive, method.adaptation
        self.hidden, self.direct, self.done_gate = sizes.hidden, spec.direct, spec.done_gate
        seen = dataclasses.replace(spec, num_categories=self._num_perceived())
        self.appearance = nnx.Embed(seen.num_categories, sizes.appearance, rngs=rngs)
        known = 0 if spec.spatial_memory is None else spec.spatial_memory.num_inputs
        self.view = Linear(2 * self.row_format.view**2 + known, sizes.view_outputs, rngs=rngs)
        self.detections = CategoryMaps(sizes.appearance + NUM_FEATURES, seen, rngs)
        self.sought = nnx.Embed(seen.num_categories, sizes.appearance, rngs=rngs)
        self.method = method.experience(seen, rngs)
        self.recurrent = self.method.recurrent or method.adaptation is not None
        goal = self.detections.width + sizes.appearance
        self.widths = (sizes.view_outputs, goal, self.method.width, NUM_ACTIONS)
        self.fuse = Linear(sum(self.widths), sizes.hidden, rngs=rngs)
        self.core = nnx.GRUCell(sizes.hidden, sizes.hidden, rngs=rngs)
        # Small first logits: the first policy is close to uniform but for Done.
        small = nnx.initializers.variance_scaling(1e-4, "fan_in", "normal")
        bias = _seldom_done if method.control.num_choices == NUM_ACTIONS else nnx.initializers.zeros
        self.actor = Linear(sizes.hidden, method.control.num_choices, kernel_init=small, bias_init=bias, rngs=rngs)
        self.critic = Linear(sizes.hidden, 1, rngs=rngs)

    def pathways(
        self,
        observation: Observation,
        weights: jax.Array,
        reading: Any = None,
        surroundings: jax.Array | None = None,
        memory: Memory | None = None,
    ) -> Pathways:
        """Embed what is seen, sought and known by experience.

        Args:
          observation: a batch [...] of observations.
          weights: float32 [..., K], the layout's weights for the goal (eq. 7); ones leave the layout out.
          reading: what the method's tracker read, leaves [...]; None without a tracker.
          surroundings: uint8 [..., M], what the spatial memory read; None without one.
          memory: leaves [...]; needed where the method attends with it.

        Raises:
          ValueError: the method attends with its memory, and there is none.
        """
        encoded = self.encode(observation, weights, reading, surroundings)
        if not self.method.recurrent:
            return encoded
        if memory is None:
            raise ValueError("pathways: the method attends with its memory; give it")
        return self.attend(encoded, memory)

    def encode(
        self,
        observation: Observation,
        weights: jax.Array,
        reading: Any = None,
        surroundings: jax.Array | None = None,
    ) -> Pathways:
        """Embed without memory; the experience may still have to `attend`."""
        seen = features(observation.row, observation.goal, self.row_format)
        if self.perceive is not None:
            seen = self.perceive(seen)
        scene = seen.view
        if surroundings is not None:
            scene = jnp.concatenate([scene, SpatialMemory.inputs(surroundings)], axis=-1)
        appearance = self.appearance.embedding[...]
        confidence = (seen.table[..., CONFIDENCE] * seen.goal).sum(axis=-1, keepdims=True)
        return Pathways(
            scene=nnx.relu(self.view(scene)),
            goal=self._embed_goal(seen, appearance),
            experience=self.method.encode(seen, appearance, jax.lax.stop_gradient(weights), reading),
            gate=DONE_GATE * confidence if self.done_gate else jnp.ones_like(confidence),
        )

    def attend(self, encoded: Pathways, memory: Memory) -> Pathways:
        """Let the experience of `encode` attend with the memory."""
        return encoded._replace(experience=self.method.attend(encoded.experience, memory))

    def decide(self, pathways: Pathways, memory: Memory) -> Decision:
        """Return action logits and value.

        Where a factual and a counterfactual decision stand in one compiled function, what they share (the products of
        experience and of memory) is computed once.
        """
        if self.adaptation is not None:
            return self.adaptation.decide(self, pathways, memory)
        return self.decide_plainly(pathways, memory)

    def decide_plainly(self, pathways: Pathways, memory: Memory) -> Decision:
        """Decide without the method's adaptation."""
        drive = self.drive(self.direct_input(pathways) + self.mediated_input(pathways, memory.action))
        hidden = gru(drive, memory.hidden @ self.recurrent_kernel, memory.hidden)
        return self.act(hidden, pathways.gate)._replace(fast=memory.fast)

    def direct_input(self, pathways: Pathways) -> jax.Array:
        """Return what enters by the direct pathways, float32 [..., H].

        It is linear, so zero where both are set to zero.
        """
        scene, goal, *_ = self._fuse_kernels
        return product(pathways.scene, scene) + product(pathways.goal, goal)

    def mediated_input(self, pathways: Pathways, action: jax.Array) -> jax.Array:
        """Return what enters by experience and previous action.

        Float32 [..., H]; the action is int32 [...].
        """
        *_, experience, previous = self._fuse_kernels
        one_hot = jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)
        return biased(product(pathways.experience, experience) + product(one_hot, previous), self.fuse)

    def drive(self, entering: jax.Array) -> jax.Array:
        """Return the core's input, float32 [..., 3 H].

        It is made of all that enters, float32 [..., H].
        """
        return biased(product(nnx.relu(entering), self.core.dense_i.kernel[...]), self.core.dense_i)

    def act(self, hidden: jax.Array, gate: jax.Array) -> Decision:
        """Decide by a hidden state and a gate.

        They are float32 [..., H] and [..., 1].
        """
        logits = self.actor(hidden)
        if self.done_gate:
            logits = jnp.concatenate([logits[..., :DONE], gate * logits[..., DONE:]], axis=-1)
        return Decision(logits=logits, value=self.critic(hidden)[..., 0], hidden=hidden)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> Memory:
        """Return the memory at the start of an episode."""
        memory = Memory(hidden=jnp.zeros((*batch, self.hidden)), action=jnp.full(batch, NO_ACTION, jnp.int32))
        return memory if self.adaptation is None else memory._replace(fast=self.adaptation.init(self, batch))

    @property
    def recurrent_kernel(self) -> jax.Array:
        """Return the hidden state's kernel, float32 [H, 3 H]."""
        return self.core.dense_h.kernel[...]

    @property
    def _fuse_kernels(self) -> list[jax.Array]:
        """Return the kernels of scene, goal, experience and previous action."""
        return jnp.split(self.fuse.kernel[...], np.cumsum(self.widths)[:-1])

    def _num_perceived(self) -> int:
        """Return the number of categories that the networks get."""
        num_categories = self.row_format.num_categories
        if self.perceive is None:
            return num_categories
        row = jax.ShapeDtypeStruct((self.row_format.num_bytes,), jnp.uint8)
        everything = jax.eval_shape(lambda r: features(r, jnp.int32(0), self.row_format), row)
        return jax.eval_shape(self.perceive, everything).visible.shape[-1]

    def _embed_goal(self, seen: Features, appearance: jax.Array) -> jax.Array:
        """Embed detections and what is sought, without experience."""
        shown = self.detections.project_appearance(appearance)
        shown = seen.visible[..., None] * jnp.broadcast_to(shown, (*seen.visible.shape, shown.shape[-1]))
        rows = shown + self.detections.project_rows(seen.table)
        if self.direct != "all":
            rows = rows * (seen.goal if self.direct == "goal" else jnp.zeros_like(seen.goal))[..., None]
        return jnp.concatenate([self.detections.finish(rows), seen.goal @ self.sought.embedding[...]], axis=-1)


def _seldom_done(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    del key
    return jnp.zeros(shape, dtype).at[DONE].set(SELDOM)


def init_params(spec: PolicySpec, key: jax.Array) -> Params:
    """Draw fresh parameters, a nested dict of float32 arrays."""
    return nnx.to_pure_dict(nnx.state(Policy(spec, nnx.Rngs(params=key)), nnx.Param))


def bind(spec: PolicySpec, params: Params) -> Policy:
    """Bind parameters to a policy, inside a jitted function."""
    return nnx.merge(_graph(spec), params)


@functools.lru_cache(maxsize=16)
def _graph(spec: PolicySpec) -> nnx.GraphDef[Policy]:
    abstract = nnx.eval_shape(lambda: Policy(spec, nnx.Rngs(0)))
    return nnx.split(abstract)[0]
