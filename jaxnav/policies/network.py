"""The policy network: from an observation to pathways, and from pathways to a decision.

`Policy` is the network of the paper: three pathways (scene, goal, experience) fused before one recurrent core.
`StreamsPolicy` has two recurrent cores whose logits are added: one for scene and goal, one for experience. Both are NNX
modules that are built once; only their parameters, a nested dict of arrays, are kept in states and on disk:

    params = init_params(spec, key)
    policy = bind(spec, params)
    pathways = policy.pathways(PolicyInputs(observation, layout_weights, reading, surroundings), memory)
    decision = policy.decide(pathways, memory)
    counterfactual = policy.decide(do(pathways, scene=0, goal=0), memory.counterfactual_state())
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.causal import do
from jaxnav.layout import scale_weights
from jaxnav.numerics.product import Linear, add_bias, matmul_rows
from jaxnav.numerics.recurrence import gru_step
from jaxnav.numerics.rounding import round_to_grid
from jaxnav.policies.features import CONFIDENCE_INDEX, CategoryMaps, Features, scale_geometry, unpack_features
from jaxnav.policies.method import Experience
from jaxnav.policies.pathways import (
    NO_ACTION,
    Decision,
    EncodedPathways,
    Pathways,
    PolicyInputs,
    PolicyState,
    mask_experience,
)
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, NUM_ACTIONS

Params = dict[str, Any]

#: Initial bias of Done's logit: without the Done gate, a new policy chooses Done about once in 60 steps. A policy that
#: often chooses Done ends its episodes too early to find goals.
INITIAL_DONE_LOGIT = -2.5
#: The Done gate is this factor times the confidence of the goal's detection. A gate of 0 makes the logit of Done 0, so
#: Done stays possible; at first it is then even likelier than with the bias above.
DONE_GATE_FACTOR = 0.58

#: Additive changes of layer outputs by an adaptation: layer name (`fuse`, `input_gates`, `hidden_gates` or `actor`) ->
#: function from the layer's inputs [..., M] to a change [..., N]. A 1 is appended to the inputs of layers with a bias.
LayerChanges = Mapping[str, Callable[[jax.Array], jax.Array]]
NO_CHANGES: LayerChanges = MappingProxyType({})


# Building and binding


def init_params(spec: PolicySpec, key: jax.Array) -> Params:
    """Draw fresh parameters, a nested dict of float32 arrays."""
    policy = _policy_class(spec)(spec, nnx.Rngs(params=key))
    return nnx.to_pure_dict(nnx.state(policy, nnx.Param))


def bind(spec: PolicySpec, params: Params) -> "Policy":
    """Bind parameters to a policy; cheap, so that jitted functions may call it."""
    return nnx.merge(_graph(spec), params)


@functools.lru_cache(maxsize=16)
def _graph(spec: PolicySpec) -> "nnx.GraphDef[Policy]":
    """Return the structure of a policy without its parameters."""
    # Abstract evaluation gives the structure without drawing parameters.
    abstract_policy = nnx.eval_shape(lambda: _policy_class(spec)(spec, nnx.Rngs(0)))
    return nnx.split(abstract_policy)[0]


def _policy_class(spec: PolicySpec) -> "type[Policy]":
    """Return the class of a policy: that of its method, if it brings one, else the network of its decision."""
    return spec.method.policy_class or _POLICIES[spec.decision]


# One recurrent core


class Stream(nnx.Module):
    """A recurrent core with its input layer (`fuse`) and its heads (`actor`, `critic`).

    Each part of a step is a method of its own, so that training can compute it for whole rollouts at once
    (`training.ppo`):

        direct_input + mediated_input -> input_gates -+
                                                      +-> GRU -> apply_heads
        hidden state                 -> hidden_gates -+

    `direct_input` is a method of `Policy`; the experience stream of `StreamsPolicy` has none.
    """

    def __init__(
        self,
        widths: tuple[int, ...],
        num_choices: int,
        spec: PolicySpec,
        rngs: nnx.Rngs,
        done_logit: float = INITIAL_DONE_LOGIT,
    ) -> None:
        """Create the layers.

        Args:
          widths: input widths, in the order of the kernel rows of `fuse`; experience and previous action come last.
          num_choices: A, size of the actor's output.
          spec: specification of the policy.
          rngs: random number generators of the parameters.
          done_logit: initial bias of Done's logit, if choices are actions.
        """
        self.widths = widths
        self.hidden_width = spec.sizes.hidden
        self.done_gate = spec.done_gate
        self.fuse = Linear(sum(widths), self.hidden_width, rngs=rngs)
        self.core = nnx.GRUCell(self.hidden_width, self.hidden_width, rngs=rngs)

        # Small initial logits: a new policy is close to uniform except for Done.
        small_kernel = nnx.initializers.variance_scaling(1e-4, "fan_in", "normal")
        initial_logits = np.zeros(num_choices, np.float32)
        if spec.method.chooses_actions:
            initial_logits[DONE] = done_logit
        self.actor = Linear(
            self.hidden_width,
            num_choices,
            kernel_init=small_kernel,
            bias_init=lambda *_: jnp.asarray(initial_logits),
            rngs=rngs,
        )
        self.critic = Linear(self.hidden_width, 1, rngs=rngs)

    def mediated_input(self, pathways: Pathways, action: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Project experience and previous action; float32 [..., H].

        Args:
          pathways: leaves [..., ...].
          action: int32 [...], the previous action.
          changes: changes of the layers. The change of `fuse` depends on scene and goal, too; it is added once, here,
            and not in `direct_input`.
        """
        # The kernel of `fuse` is a sum over its inputs, so the direct ones can be added separately.
        *_, experience_kernel, action_kernel = self.fuse_kernels
        previous_action = jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)
        projected = matmul_rows(pathways.experience, experience_kernel) + matmul_rows(previous_action, action_kernel)
        mediated = add_bias(projected, self.fuse)
        if "fuse" not in changes:
            return mediated

        # A change of `fuse` reads all inputs at once, with a 1 for the bias.
        all_inputs = pathways.scene, pathways.goal, pathways.experience, previous_action
        return mediated + changes["fuse"](append_one(jnp.concatenate(all_inputs, axis=-1)))

    def input_gates(self, fused: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Project the fused input float32 [..., H] to the input part of the GRU's gates, float32 [..., 3 H]."""
        inputs = nnx.relu(fused)
        gates = add_bias(matmul_rows(inputs, self.core.dense_i.kernel[...]), self.core.dense_i)
        return gates + changes["input_gates"](append_one(inputs)) if "input_gates" in changes else gates

    def hidden_gates(self, hidden: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Project the hidden state float32 [..., H] to the recurrent part of the GRU's gates, float32 [..., 3 H]."""
        gates = hidden @ self.core.dense_h.kernel[...]
        return gates + changes["hidden_gates"](hidden) if "hidden_gates" in changes else gates

    def apply_heads(self, hidden: jax.Array, pathways: Pathways, changes: LayerChanges = NO_CHANGES) -> Decision:
        """Compute logits [..., A] and value [...] from a hidden state float32 [..., H]."""
        # The critic has no changes: an adaptation is about actions.
        logits = self.action_logits(hidden, pathways.gate, changes)
        return Decision(logits=logits, value=self.critic(hidden)[..., 0], hidden=hidden)

    def action_logits(self, hidden: jax.Array, gate: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Compute logits [..., A] from a hidden state float32 [..., H] and the gate of Done [..., 1]."""
        logits = self.actor(hidden)
        if "actor" in changes:
            logits = logits + changes["actor"](append_one(hidden))
        return self.gate_done(logits, gate)

    def gate_done(self, logits: jax.Array, gate: jax.Array) -> jax.Array:
        """Multiply the logit of Done, in logits [..., A], by the gate [..., 1] if `done_gate` is set."""
        if not self.done_gate:
            return logits
        return jnp.concatenate([logits[..., :DONE], gate * logits[..., DONE:]], axis=-1)

    @property
    def layer_widths(self) -> dict[str, tuple[int, int]]:
        """Widths of inputs and outputs of the layers that an adaptation may change."""
        num_gates = 3 * self.hidden_width
        return {
            "fuse": (sum(self.widths) + 1, self.hidden_width),
            "input_gates": (self.hidden_width + 1, num_gates),
            "hidden_gates": (self.hidden_width, num_gates),
            "actor": (self.hidden_width + 1, self.actor.out_features),
        }

    @property
    def recurrent_kernel(self) -> jax.Array:
        """Kernel of the hidden state, float32 [H, 3 H]."""
        return self.core.dense_h.kernel[...]

    @property
    def fuse_kernels(self) -> list[jax.Array]:
        """Kernel of each input, in the order of `widths`."""
        return jnp.split(self.fuse.kernel[...], np.cumsum(self.widths)[:-1])


def append_one(values: jax.Array) -> jax.Array:
    """Append a 1 to values [..., N]."""
    return jnp.concatenate([values, jnp.ones_like(values[..., :1])], axis=-1)


# The paper's network


class Policy(Stream):
    """Three pathways, fused before one recurrent core; works on single observations and batches."""

    num_streams: ClassVar[int] = 1  # every stream embeds the view for itself
    num_scene_factors: ClassVar[int] = 0  # last entries of the scene pathway that are the factor of a stream
    #: True if logits are log probabilities of detection, an exact sum of direct scores and experience; see
    #: `jaxnav.causal.remove_experience`.
    has_additive_scores: ClassVar[bool] = False

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        method = spec.method
        sizes = spec.sizes
        self.row_format = RowFormat(spec.num_categories)
        self.perceive = method.perceive
        self.adaptation = method.adaptation
        self.direct = spec.direct
        self.goal_row = spec.goal_row
        self.weight_kind = spec.weight_kind
        self.experience_dropout = spec.experience_dropout
        self.counterfactual_memory = spec.counterfactual_memory
        # A method may restrict what the networks see, down to the number of categories.
        perceived_spec = dataclasses.replace(spec, num_categories=self._num_perceived_categories())
        if method.hosts_layout and perceived_spec.num_categories != spec.num_categories:
            raise ValueError(
                f"{method.name}: `perceive` returns {perceived_spec.num_categories} categories, and layout weights are "
                f"of {spec.num_categories}; give the method `hosts_layout=False`"
            )

        # Scene S: the view, the spatial memory and the method's inputs about the scene.
        num_scene_inputs = 2 * self.row_format.view**2 + method.experience.num_scene_inputs
        if spec.spatial_memory is not None:
            num_scene_inputs += spec.spatial_memory.num_inputs
        self.appearance = nnx.Embed(perceived_spec.num_categories, sizes.appearance, rngs=rngs)
        self.view = Linear(num_scene_inputs, self.num_streams * sizes.view_outputs, rngs=rngs)

        # Goal G: detections and the category of the goal. Experience Z: the method's own module, see `experience`.
        self.detections = CategoryMaps.for_detections(perceived_spec, rngs)
        self.sought = nnx.Embed(perceived_spec.num_categories, sizes.appearance, rngs=rngs)
        self.method = method.experience(perceived_spec, rngs)

        super().__init__(self._input_widths(sizes), method.control.num_choices, spec, rngs)

    @property
    def experience(self) -> Experience:
        """The experience module of the method; its parameters are stored as `method`."""
        return self.method

    def pathways(
        self, inputs: PolicyInputs, memory: PolicyState | None = None, partner_inputs: PolicyInputs | None = None
    ) -> Pathways:
        """Embed the scene (S), the goal (G) and the experience (Z).

        Args:
          inputs: leaves [...].
          memory: leaves [...]; None unless the method's experience reads the memory.
          partner_inputs: inputs of other episodes with the goals of `inputs`, from which experience takes the
            detections of all categories but the goal (`Experience.replace_other_categories`); None takes them from
            `inputs`.

        Returns:
          Embeddings with leaves [..., size], see `Pathways`.

        Raises:
          ValueError: the experience reads the memory, and none is given.
        """
        return self.attend(self.encode(inputs, partner_inputs), memory)

    def encode(self, inputs: PolicyInputs, partner_inputs: PolicyInputs | None = None) -> EncodedPathways:
        """Embed all that needs no memory, in parallel over time."""
        features = self._unpack(inputs)

        # S: everything about the scene that does not depend on objects.
        scene_inputs = features.view
        if inputs.surroundings is not None:
            map_inputs = SpatialMemory.encode_surroundings(inputs.surroundings)
            scene_inputs = jnp.concatenate([scene_inputs, map_inputs], axis=-1)
        if self.experience.num_scene_inputs:
            scene_inputs = jnp.concatenate([scene_inputs, self.experience.scene_inputs(inputs.reading)], axis=-1)
        scene = nnx.relu(self.view(scene_inputs))

        # G: the detections that `direct` selects, and the goal.
        goal_embedding = self._embed_goal(features, self.appearance.embedding[...])

        # Z: the method's experience, weighted by the goal's column of w (eq. 7). No gradient enters the layout belief.
        layout_weights = jax.lax.stop_gradient(inputs.layout_weights)
        if self.weight_kind == "relative":
            layout_weights = scale_weights(layout_weights, inputs.observation.goal)
        experience_features, reading = features, inputs.reading
        if partner_inputs is not None:
            experience_features, reading = self.experience.replace_other_categories(
                features, inputs.reading, self._unpack(partner_inputs), partner_inputs.reading
            )
        if self.weight_kind == "pixel":
            experience_features = scale_geometry(experience_features)
        experience = self.experience.encode(experience_features, self.experience_appearance, layout_weights, reading)

        # The Done gate follows the confidence of the goal's detection.
        confidence = (features.table[..., CONFIDENCE_INDEX] * features.goal).sum(axis=-1, keepdims=True)
        gate = DONE_GATE_FACTOR * confidence if self.done_gate else jnp.ones_like(confidence)
        return EncodedPathways(
            scene=scene, goal=goal_embedding, experience=experience, gate=gate, reading=inputs.reading
        )

    def attend(self, encoded: EncodedPathways, memory: PolicyState | None) -> Pathways:
        """Complete the pathways by experience that reads the memory.

        Args:
          encoded: result of `encode`, leaves [...].
          memory: leaves [...]; None unless the method's experience reads the memory.

        Raises:
          ValueError: the experience reads the memory, and none is given.
        """
        experience = encoded.experience
        if self.experience.reads_memory:
            if memory is None:
                raise ValueError("pathways: the experience of the method reads the memory; pass `memory`")
            experience = self.experience.attend(experience, memory)
        return Pathways(encoded.scene, encoded.goal, experience, encoded.gate, encoded.reading)

    def decide(self, pathways: Pathways, memory: PolicyState) -> Decision:
        """Return action logits and value.

        If a factual and a counterfactual decision are traced in one jitted function, XLA computes their common products
        (experience, memory) once.
        """
        # Experience dropout: in some training episodes Z = 0, so that the network learns to act without experience.
        pathways = mask_experience(pathways, memory.use_experience)
        decision = self._decide_with_adaptation(pathways, memory)
        counterfactual_hidden = self._advance_counterfactual(pathways, memory)
        return decision._replace(use_experience=memory.use_experience, counterfactual_hidden=counterfactual_hidden)

    def decide_with_changes(
        self, pathways: Pathways, memory: PolicyState, changes: LayerChanges = NO_CHANGES
    ) -> Decision:
        """Decide with given changes of the layers; an adaptation calls this with its own changes.

        With streams, the changes apply to the direct stream.
        """
        # Fuse the pathways and the previous action, [..., H], or [..., 2 H] with streams.
        fused = self.direct_input(pathways) + self.mediated_input(pathways, memory.action, changes)
        input_gates = self.input_gates(fused, changes)
        hidden_gates = self.hidden_gates(memory.hidden, changes)
        # Step the recurrent core, and decide from its new hidden state.
        hidden = gru_step(input_gates, hidden_gates, memory.hidden)
        return self.apply_heads(hidden, pathways, changes)._replace(fast=memory.fast)

    def _decide_with_adaptation(self, pathways: Pathways, memory: PolicyState) -> Decision:
        """Decide, with the method's adaptation if it has one."""
        if self.adaptation is None:
            return self.decide_with_changes(pathways, memory)
        return self.adaptation.decide(self, pathways, memory)

    def _advance_counterfactual(self, pathways: Pathways, memory: PolicyState) -> jax.Array | None:
        """Next recurrent state of a counterfactual branch with its own memory, which reads the factual experience.

        Returns:
          float32 [..., H]; None if the branch has no memory of its own.
        """
        if memory.counterfactual_hidden is None:
            return None
        counterfactual_pathways = do(pathways, scene=0.0, goal=0.0)
        return self._decide_with_adaptation(counterfactual_pathways, memory.counterfactual_state()).hidden

    def direct_input(self, pathways: Pathways | EncodedPathways) -> jax.Array:
        """Project both direct pathways, float32 [..., H]; linear, so zero where both are zero."""
        scene_kernel, goal_kernel, *_ = self.fuse_kernels
        return matmul_rows(pathways.scene, scene_kernel) + matmul_rows(pathways.goal, goal_kernel)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> PolicyState:
        """Return the memory at the start of an episode, leaves [*batch, ...]."""
        memory = PolicyState(
            hidden=jnp.zeros((*batch, self.hidden_width)), action=jnp.full(batch, NO_ACTION, jnp.int32)
        )
        # Episodes have experience unless training draws otherwise.
        if self.experience_dropout:
            memory = memory._replace(use_experience=jnp.ones(batch))
        if self.counterfactual_memory == "own":
            memory = memory._replace(counterfactual_hidden=jnp.zeros((*batch, self.hidden_width)))
        return memory if self.adaptation is None else memory._replace(fast=self.adaptation.init(self, batch))

    @property
    def experience_appearance(self) -> jax.Array:
        """Embeddings of the categories that experience reads, float32 [K, d]."""
        return self.appearance.embedding[...]

    def _input_widths(self, sizes: Sizes) -> tuple[int, ...]:
        """Widths of scene, goal, experience and previous action."""
        # Maps of the categories, the row of the goal where it is used, and the embedding of the goal.
        goal_width = self.detections.width + sizes.row_outputs * self.goal_row + sizes.appearance
        return sizes.view_outputs, goal_width, self.experience.width, NUM_ACTIONS

    def _num_perceived_categories(self) -> int:
        """Number of categories that the networks see, after the method's `perceive`."""
        num_categories = self.row_format.num_categories
        if self.perceive is None:
            return num_categories
        # Only shapes are needed: trace `perceive` without computing it.
        row = jax.ShapeDtypeStruct((self.row_format.num_bytes,), jnp.uint8)
        features = jax.eval_shape(lambda row: unpack_features(row, jnp.int32(0), self.row_format), row)
        return jax.eval_shape(self.perceive, features).visible.shape[-1]

    def _unpack(self, inputs: PolicyInputs) -> Features:
        """Unpack the rows; a method may restrict the features that its network reads."""
        features = unpack_features(inputs.observation.row, inputs.observation.goal, self.row_format)
        return features if self.perceive is None else self.perceive(features)

    def _embed_goal(self, features: Features, appearance: jax.Array) -> jax.Array:
        """Embed the detections that `direct` selects, and the goal, without experience.

        With `goal_row` the goal's detection enters twice: in the table of the selected detections, and through the same
        perceptron in a row of its own, so that Done is learned jointly for all goals.
        """
        # Rows [..., K, h]; `direct` masks rows.
        rows = self.detections.project_detections(features, appearance)
        if self.direct == "goal":
            rows = rows * features.goal[..., None]
        elif self.direct == "none":
            rows = rows * jnp.zeros_like(features.goal)[..., None]

        # The selected detections first, then the row of the goal, then the embedding of the goal.
        embeddings = [self.detections.finish(rows)]
        if self.goal_row:
            goal_row = (rows * features.goal[..., None]).sum(axis=-2, keepdims=True)
            embeddings.append(self.detections.finish(goal_row))
        embeddings.append(features.goal @ self.sought.embedding[...])
        return jnp.concatenate(embeddings, axis=-1)


# Two streams


class StreamsPolicy(Policy):
    """Two streams, whose logits and values are added.

    The direct stream reads scene and goal. The experience stream reads all of `Pathways.experience`, which includes a
    view embedding of its own. Scene and experience end with a 1, the factor of the stream: setting the pathway to 0
    removes the stream. The direct stream learns in steps without experience; the experience stream learns a residual.

    This object itself is the direct stream: `fuse`, `core`, `actor`, `critic`, and every `super()` call below. Its
    counterpart is `experience_stream`.
    """

    num_streams = 2
    num_scene_factors = 1

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        # The experience stream reads experience, a view embedding, the factor 1 and the previous action.
        experience_widths = self.experience.width + spec.sizes.view_outputs + 1, NUM_ACTIONS
        num_choices = self.actor.out_features
        self.experience_stream = Stream(experience_widths, num_choices, spec, rngs, done_logit=0.0)
        # Category embeddings of the experience stream, which shares none with the direct stream.
        self.known_appearance = nnx.Embed(self.appearance.num_embeddings, spec.sizes.appearance, rngs=rngs)

    def encode(self, inputs: PolicyInputs, partner_inputs: PolicyInputs | None = None) -> EncodedPathways:
        """Embed all that needs no memory, in parallel over time."""
        encoded = super().encode(inputs, partner_inputs)
        # The view layer embeds the view twice, once per stream; the appended 1 is the factor of the stream.
        direct_view, experience_view = jnp.split(encoded.scene, 2, axis=-1)
        return encoded._replace(scene=append_one(direct_view), view=append_one(experience_view))

    def attend(self, encoded: EncodedPathways, memory: PolicyState | None) -> Pathways:
        """Complete the pathways: experience, from the memory of its stream, then the view of this stream."""
        # The second half of the hidden state belongs to the stream of experience.
        stream_memory = None if memory is None else memory._replace(hidden=memory.hidden[..., self.hidden_width :])
        pathways = super().attend(encoded, stream_memory)
        assert encoded.view is not None  # `encode` embeds the view for both streams
        return pathways._replace(experience=jnp.concatenate([pathways.experience, encoded.view], axis=-1))

    def direct_input(self, pathways: Pathways | EncodedPathways) -> jax.Array:
        """Project both direct pathways, float32 [..., 2 H]; zero for the stream of experience."""
        direct = super().direct_input(pathways)
        return jnp.concatenate([direct, jnp.zeros_like(direct)], axis=-1)

    def mediated_input(self, pathways: Pathways, action: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Project experience and previous action, float32 [..., 2 H]; the direct stream reads the action alone."""
        # The experience of the direct stream has width 0.
        no_experience = pathways._replace(experience=pathways.experience[..., :0])
        direct = super().mediated_input(no_experience, action, changes)
        experience = self.experience_stream.mediated_input(pathways, action)
        return jnp.concatenate([direct, experience], axis=-1)

    def input_gates(self, fused: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Project the fused input float32 [..., 2 H] to the input part of both cores' gates, float32 [..., 6 H]."""
        direct, experience = jnp.split(fused, 2, axis=-1)
        direct_gates = super().input_gates(direct, changes)
        experience_gates = self.experience_stream.input_gates(experience)
        return _interleave_gates(direct_gates, experience_gates)

    def hidden_gates(self, hidden: jax.Array, changes: LayerChanges = NO_CHANGES) -> jax.Array:
        """Project both hidden states float32 [..., 2 H] to the recurrent part of their gates, float32 [..., 6 H]."""
        direct, experience = jnp.split(hidden, 2, axis=-1)
        direct_gates = super().hidden_gates(direct, changes)
        experience_gates = self.experience_stream.hidden_gates(experience)
        return _interleave_gates(direct_gates, experience_gates)

    def apply_heads(self, hidden: jax.Array, pathways: Pathways, changes: LayerChanges = NO_CHANGES) -> Decision:
        """Add logits and values of both streams, each times its factor; hidden is float32 [..., 2 H]."""
        # Each stream has its half of the hidden state and heads of its own.
        direct_hidden, experience_hidden = jnp.split(hidden, 2, axis=-1)
        direct = super().apply_heads(direct_hidden, pathways, changes)
        experience = self.experience_stream.apply_heads(experience_hidden, pathways)

        # While experience is on, stop gradients into the direct stream, so that experience learns a residual.
        direct_factor = pathways.scene[..., -1:]
        experience_factor = pathways.experience[..., -1:]
        direct = _stop_gradient_where(direct, experience_factor != 0)

        # Rounded, so that the sum is exact and removing one stream (eq. 1) leaves the other bit-identical.
        logits = round_to_grid(direct_factor * direct.logits) + round_to_grid(experience_factor * experience.logits)
        value = direct_factor[..., 0] * direct.value + experience_factor[..., 0] * experience.value
        return Decision(logits, value, hidden)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> PolicyState:
        """Return the memory at the start of an episode, leaves [*batch, ...]."""
        memory = super().initial_memory(batch)
        return memory._replace(hidden=jnp.zeros((*batch, 2 * self.hidden_width)), use_experience=jnp.ones(batch))

    @property
    def experience_appearance(self) -> jax.Array:
        """Embeddings of the categories that experience reads, float32 [K, d]."""
        return self.known_appearance.embedding[...]

    @property
    def recurrent_kernel(self) -> jax.Array:
        """Kernel of both hidden states, float32 [2 H, 6 H]: block-diagonal gate by gate."""
        # The order of the gates is that of `_interleave_gates`: for each gate, the direct stream first.
        direct_gates = _split_gates(super().recurrent_kernel)
        experience_gates = _split_gates(self.experience_stream.recurrent_kernel)
        blocks = map(jax.scipy.linalg.block_diag, direct_gates, experience_gates)
        return jnp.concatenate(list(blocks), axis=-1)

    def _input_widths(self, sizes: Sizes) -> tuple[int, ...]:
        """Widths of the direct stream's inputs."""
        scene_width, goal_width, _, num_actions = super()._input_widths(sizes)
        return scene_width + 1, goal_width, 0, num_actions


def _stop_gradient_where(decision: Decision, condition: jax.Array) -> Decision:
    """Stop the gradient of logits and value where the condition, bool [..., 1], holds."""
    fixed = jax.lax.stop_gradient(decision)
    return decision._replace(
        logits=jnp.where(condition, fixed.logits, decision.logits),
        value=jnp.where(condition[..., 0], fixed.value, decision.value),
    )


def _interleave_gates(direct: jax.Array, experience: jax.Array) -> jax.Array:
    """Join gates [..., 3 H] of both streams gate by gate, [..., 6 H]."""
    joined = []
    for direct_gate, experience_gate in zip(_split_gates(direct), _split_gates(experience), strict=True):
        joined += [direct_gate, experience_gate]
    return jnp.concatenate(joined, axis=-1)


def _split_gates(values: jax.Array) -> list[jax.Array]:
    """Split [..., 3 H] into reset gate, update gate and candidate."""
    return jnp.split(values, 3, axis=-1)


_POLICIES: dict[str, type[Policy]] = {"fused": Policy, "streams": StreamsPolicy}
