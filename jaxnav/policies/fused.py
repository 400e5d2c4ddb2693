"""The decision of the paper: pathways from an observation, fused before one recurrent core."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.env.types import Observation
from jaxnav.numerics.product import Linear, product
from jaxnav.numerics.recurrence import gru
from jaxnav.policies.category_maps import CategoryMaps
from jaxnav.policies.features import CONFIDENCE, Features, features
from jaxnav.policies.methods import find_method
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory, Pathways, zero_experience
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.policies.stream import NO_CHANGES, Changes, Stream
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NUM_ACTIONS

DONE_GATE = 0.58  # times the confidence of the goal's detection


class Policy(Stream):
    """Decide by three pathways, fused before one recurrent core.

    Works on single observations and batches.
    """

    num_views: ClassVar[int] = 1  # embeddings of the view

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        method, sizes = find_method(spec.method), spec.sizes
        self.row_format = RowFormat(spec.num_categories)
        self.perceive, self.adaptation = method.perceive, method.adaptation
        self.direct, self.goal_row = spec.direct, spec.goal_row
        seen = dataclasses.replace(spec, num_categories=self._num_perceived())
        self.appearance = nnx.Embed(seen.num_categories, sizes.appearance, rngs=rngs)
        known = method.experience.geometry
        known += 0 if spec.spatial_memory is None else spec.spatial_memory.num_inputs
        self.view = Linear(2 * self.row_format.view**2 + known, self.num_views * sizes.view_outputs, rngs=rngs)
        self.detections = CategoryMaps.of_detections(seen, rngs)
        self.sought = nnx.Embed(seen.num_categories, sizes.appearance, rngs=rngs)
        self.method = method.experience(seen, rngs)
        super().__init__(self._widths(sizes), method.control.num_choices, spec, rngs)

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
        if self.method.geometry:
            scene = jnp.concatenate([scene, self.method.geometry_inputs(reading)], axis=-1)
        appearance = self.appearance.embedding[...]
        confidence = (seen.table[..., CONFIDENCE] * seen.goal).sum(axis=-1, keepdims=True)
        return Pathways(
            scene=nnx.relu(self.view(scene)),
            goal=self._embed_goal(seen, appearance),
            experience=self.method.encode(seen, self.experience_appearance, jax.lax.stop_gradient(weights), reading),
            gate=DONE_GATE * confidence if self.done_gate else jnp.ones_like(confidence),
            reading=reading,
        )

    def attend(self, encoded: Pathways, memory: Memory) -> Pathways:
        """Let the experience of `encode` attend with the memory."""
        return encoded._replace(experience=self.method.attend(encoded.experience, memory))

    def decide(self, pathways: Pathways, memory: Memory) -> Decision:
        """Return action logits and value.

        Where a factual and a counterfactual decision stand in one compiled function, what they share (the products of
        experience and of memory) is computed once.
        """
        pathways = zero_experience(pathways, memory.experienced)
        if self.adaptation is None:
            decision = self.decide_plainly(pathways, memory)
        else:
            decision = self.adaptation.decide(self, pathways, memory)
        return decision._replace(experienced=memory.experienced)

    def decide_plainly(self, pathways: Pathways, memory: Memory, changes: Changes = NO_CHANGES) -> Decision:
        """Decide without the method's adaptation.

        An adaptation may change the layers; with streams they are those of the direct stream.
        """
        entering = self.direct_input(pathways) + self.mediated_input(pathways, memory.action, changes)
        hidden = gru(self.drive(entering, changes), self.project(memory.hidden, changes), memory.hidden)
        return self.act(hidden, pathways, changes)._replace(fast=memory.fast)

    def direct_input(self, pathways: Pathways) -> jax.Array:
        """Return what enters by the direct pathways, float32 [..., H].

        It is linear, so zero where both are set to zero.
        """
        scene, goal, *_ = self.fuse_kernels
        return product(pathways.scene, scene) + product(pathways.goal, goal)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> Memory:
        """Return the memory at the start of an episode."""
        memory = Memory(hidden=jnp.zeros((*batch, self.hidden)), action=jnp.full(batch, NO_ACTION, jnp.int32))
        return memory if self.adaptation is None else memory._replace(fast=self.adaptation.init(self, batch))

    @property
    def recurrent(self) -> bool:
        """Return whether training unrolls it step by step."""
        return self.method.recurrent or self.adaptation is not None

    @property
    def experience_appearance(self) -> jax.Array:
        """Return the embeddings of categories that experience gets."""
        return self.appearance.embedding[...]

    @property
    def pathway_widths(self) -> tuple[int, ...]:
        """Return the widths of scene, goal, experience and gate."""
        return *self.widths[:3], 1

    def _widths(self, sizes: Sizes) -> tuple[int, ...]:
        """Return the widths of scene, goal, experience and previous action."""
        goal = self.detections.width + sizes.row_outputs * self.goal_row + sizes.appearance
        return sizes.view_outputs, goal, self.method.width, NUM_ACTIONS

    def _num_perceived(self) -> int:
        """Return the number of categories that the networks get."""
        num_categories = self.row_format.num_categories
        if self.perceive is None:
            return num_categories
        row = jax.ShapeDtypeStruct((self.row_format.num_bytes,), jnp.uint8)
        everything = jax.eval_shape(lambda r: features(r, jnp.int32(0), self.row_format), row)
        return jax.eval_shape(self.perceive, everything).visible.shape[-1]

    def _embed_goal(self, seen: Features, appearance: jax.Array) -> jax.Array:
        """Embed detections and what is sought, without experience.

        With `goal_row` the goal's detection enters in the row of its category and once more in a row of its own: when
        to say Done is then learned for all goals at once.
        """
        rows = self.detections.project_detections(seen, appearance)
        if self.direct != "all":
            rows = rows * (seen.goal if self.direct == "goal" else jnp.zeros_like(seen.goal))[..., None]
        goal_row = (rows * seen.goal[..., None]).sum(axis=-2, keepdims=True)
        detections = [self.detections.finish(each) for each in ((rows, goal_row) if self.goal_row else (rows,))]
        return jnp.concatenate([*detections, seen.goal @ self.sought.embedding[...]], axis=-1)
