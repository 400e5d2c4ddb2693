"""Adaptation within an episode by gradient descent on a learned loss.

Source: M. Wortsman et al., *Learning to Learn How to Learn: Self-Adaptive Visual Navigation Using Meta-Learning*, CVPR
2019 (SAVN), and its released code.

Kept: after decisions 6, 12, 18 and 24 of an episode the policy takes a step of gradient descent on a learned loss of
its last six decisions. The loss sees hidden states and action probabilities, but no reward, and training differentiates
through the steps. Changed: only the fusing layer, the recurrent core and the actor adapt. The change of a layer is
stored as a product of low rank, which is exact, so that all episodes of a batch share the kernels.

`LearnedLossAdaptation` is the adaptation of a method, and `LearnedLoss` the network that belongs to its experience.
"""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear
from jaxnav.numerics.sparse import update_where
from jaxnav.policies.pathways import Decision, Pathways, PolicyState

if TYPE_CHECKING:
    from jaxnav.policies.method import Adaptation
    from jaxnav.policies.network import Policy


#: Number of decisions between two inner steps; the learned loss reads all of them.
WINDOW = 6
_CHANNELS = 10
_TINY = 1e-12  # below the square of any loss; keeps the gradient of the square root finite


class LearnedLoss(nnx.Module):
    """Loss of a window of decisions, which needs no reward.

    Two causal convolutions run along the entries of a row, with the decisions of the window as channels. The loss is
    the Euclidean norm of their output.
    """

    def __init__(self, rngs: nnx.Rngs) -> None:
        self.first = Linear(2 * WINDOW, _CHANNELS, rngs=rngs)
        self.second = Linear(2 * _CHANNELS, 1, rngs=rngs)

    def __call__(self, rows: jax.Array) -> jax.Array:
        """Return the loss float32 [...], at least 0, of rows float32 [..., W, L]."""
        # [..., L, W]: the convolutions run along the entries of a row, with the decisions as channels.
        entries = jnp.swapaxes(rows, -1, -2)
        hidden = nnx.leaky_relu(self.first(_join_earlier_entry(entries, 1)))
        outputs = nnx.leaky_relu(self.second(_join_earlier_entry(hidden, 2)))
        return jnp.sqrt(jnp.square(outputs).sum(axis=(-2, -1)) + _TINY)


def _join_earlier_entry(entries: jax.Array, distance: int) -> jax.Array:
    """Join each entry of [..., L, C] with the entry `distance` before it, [..., L, 2 C]."""
    padding = jnp.zeros_like(entries[..., :distance, :])
    earlier_entries = jnp.concatenate([padding, entries[..., :-distance, :]], axis=-2)
    return jnp.concatenate([earlier_entries, entries], axis=-1)


class HasLearnedLoss(Protocol):
    """Experience of a method that adapts by a learned loss."""

    learned_loss: LearnedLoss


class LowRankChange(NamedTuple):
    """Change of a layer's kernel and bias, as a product of rank R.

    Attributes:
      inputs: float32 [..., R, M], inputs of the layer, with a 1 for its bias.
      outputs: float32 [..., R, N], change of the output per unit of similarity to each input.
    """

    inputs: jax.Array
    outputs: jax.Array

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Return the change of the layer's output [..., N] for inputs [..., M]."""
        similarity = (self.inputs * inputs[..., None, :]).sum(axis=-1, keepdims=True)
        return (similarity * self.outputs).sum(axis=-2)


class FastWeights(NamedTuple):
    """Fast weights of an episode, and the window of decisions that the next inner step learns from.

    Attributes:
      num_decisions: int32 [...], decisions so far.
      window_start: float32 [..., H], the hidden state before the window.
      window_pathways: float32 [..., W, P], all pathways of the last decisions, joined; the latest is at the end.
      window_actions: int32 [..., W], the action before each of these decisions.
      layer_changes: the change of each layer, a row for every decision of the windows so far, in order; the rows of
        later windows are 0.
    """

    num_decisions: jax.Array
    window_start: jax.Array
    window_pathways: jax.Array
    window_actions: jax.Array
    layer_changes: dict[str, LowRankChange]


@dataclasses.dataclass(frozen=True)
class LearnedLossAdaptation:
    """Gradient descent on the method's learned loss, one step every `WINDOW` decisions.

    The experience of the method holds the loss, as `learned_loss`. The fusing layer, the recurrent core and the actor
    change; with streams, those of the direct stream, by the decisions that it would make alone. The layers before them
    and experience are inputs and do not change.

    The gradient of a kernel over a window is a sum of `WINDOW` outer products. An episode stores these factors, and the
    batch shares the kernels. Gradients of training reach the learned loss and the kernels through every inner step of
    a rollout; stored values from before the rollout are constants.

    Attributes:
      inner_steps: largest number of inner steps in an episode.
      learning_rate: learning rate of an inner step.
      second_order: True to pass gradients of training through the inner gradient; otherwise they only reach the
        learned loss.
    """

    inner_steps: int = 4
    learning_rate: float = 0.01
    second_order: bool = True

    def __post_init__(self) -> None:
        if self.inner_steps < 1:
            raise InputError(
                f"LearnedLossAdaptation: inner_steps is {self.inner_steps}; give 1 or more, or omit the adaptation"
            )

    def init(self, policy: "Policy", batch: tuple[int, ...]) -> FastWeights:
        """Return fast weights without any change, and an empty window."""
        # One row for every decision of every window.
        rank = self.inner_steps * WINDOW
        layer_changes: dict[str, LowRankChange] = {}
        for layer, (input_width, output_width) in policy.layer_widths.items():
            inputs = jnp.zeros((*batch, rank, input_width))
            outputs = jnp.zeros((*batch, rank, output_width))
            layer_changes[layer] = LowRankChange(inputs, outputs)

        return FastWeights(
            num_decisions=jnp.zeros(batch, jnp.int32),
            window_start=jnp.zeros((*batch, len(policy.recurrent_kernel))),
            window_pathways=jnp.zeros((*batch, WINDOW, sum(policy.pathway_widths))),
            window_actions=jnp.zeros((*batch, WINDOW), jnp.int32),
            layer_changes=layer_changes,
        )

    def decide(self, policy: "Policy", pathways: Pathways, memory: PolicyState) -> Decision:
        """Decide with the changed layers, then adapt where the window is full."""
        fast = _append_decision(memory.fast, policy.adaptable_pathways(pathways), memory)
        output = policy.decide_with_changes(pathways, memory, dict(fast.layer_changes))
        return output._replace(fast=self.adapt_if_due(policy, fast))

    def adapt_if_due(self, policy: "Policy", fast: FastWeights) -> FastWeights:
        """Take an inner step in the episodes whose window is full."""
        # The window is full after every `WINDOW` decisions, as long as the episode has inner steps left.
        is_full = (fast.num_decisions % WINDOW == 0) & (fast.num_decisions <= self.inner_steps * WINDOW)
        graph, params = nnx.split(policy)

        def adapt_episode(
            params: Any, window: FastWeights, layer_changes: dict[str, LowRankChange]
        ) -> dict[str, LowRankChange]:
            """Write the W rows of this window's step, of one episode."""
            merged_policy = nnx.merge(graph, params)
            step_changes = self.compute_inner_step(merged_policy, window._replace(layer_changes=layer_changes))
            first_row = window.num_decisions - WINDOW
            write_rows = functools.partial(jax.lax.dynamic_update_slice_in_dim, start_index=first_row, axis=0)
            return jax.tree.map(write_rows, layer_changes, step_changes)

        # Few windows of a batch are full at a time, and only these are read and written.
        window = fast._replace(layer_changes={})
        layer_changes = update_where(is_full, adapt_episode, params, window, fast.layer_changes)
        return fast._replace(layer_changes=layer_changes)

    def compute_inner_step(self, policy: "Policy", fast: FastWeights) -> dict[str, LowRankChange]:
        """Return the changes of one inner step, [W, ...] for each layer, of one episode."""
        learned_loss = cast(HasLearnedLoss, policy.method).learned_loss
        # First order: stop gradients of training everywhere but in the loss, which nothing else would train.
        if not self.second_order:
            graph, params = nnx.split(policy)
            policy = nnx.merge(graph, jax.lax.stop_gradient(params))
            fast = jax.lax.stop_gradient(fast)

        def window_loss(output_changes: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            rows, layer_inputs = replay_window(policy, fast, output_changes)
            return learned_loss(rows), layer_inputs

        # The gradient of a kernel is the sum over the window of input (x) gradient by the output, so differentiate by
        # a change of the outputs that is zero.
        no_changes: dict[str, jax.Array] = {}
        for layer, change in fast.layer_changes.items():
            no_changes[layer] = jnp.zeros_like(change.outputs[:WINDOW])
        output_gradients, layer_inputs = jax.grad(window_loss, has_aux=True)(no_changes)

        # Descend: inputs and scaled gradients of the outputs are the two factors of the change.
        step_changes: dict[str, LowRankChange] = {}
        for layer, output_gradient in output_gradients.items():
            step_changes[layer] = LowRankChange(layer_inputs[layer], -self.learning_rate * output_gradient)
        return step_changes


def limit_inner_steps(adaptation: "Adaptation | None", inner_steps: int) -> "Adaptation | None":
    """Return an adaptation that takes at most `inner_steps` inner steps in an episode; None for 0.

    Raises:
      InputError: the method takes no inner steps, or fewer; 0 is always possible.
    """
    # Without inner steps the policy needs no adaptation at all.
    if inner_steps == 0:
        return None
    if not isinstance(adaptation, LearnedLossAdaptation):
        raise InputError(f"inner_steps is {inner_steps}, but the method adapts without inner steps; give 0 or omit it")
    if not 0 < inner_steps <= adaptation.inner_steps:
        capacity = f"an episode stores {adaptation.inner_steps} windows of {WINDOW} actions"
        raise InputError(f"inner_steps is {inner_steps}, but {capacity}; give 0 to {adaptation.inner_steps}")
    return dataclasses.replace(adaptation, inner_steps=inner_steps)


def replay_window(
    policy: "Policy", fast: FastWeights, output_changes: dict[str, jax.Array]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Repeat the decisions of one episode's window.

    Args:
      policy: the policy that decided.
      fast: leaves without a batch.
      output_changes: float32 [W, N] for each layer, added to its outputs in addition to its change.

    Returns:
      Rows float32 [W, H + A] of hidden state and action probabilities, and the inputs [W, M] of each layer.
    """
    # Pathways are stored joined, [P]; split them at the end of each but the last.
    pathway_ends = np.cumsum(policy.pathway_widths)[:-1]

    def repeat_decision(
        hidden: jax.Array, decision_inputs: tuple[jax.Array, jax.Array, dict[str, jax.Array]]
    ) -> tuple[jax.Array, Any]:
        joined_pathways, action, step_changes = decision_inputs
        pathways = Pathways(*jnp.split(joined_pathways, pathway_ends))

        # Record the input of every layer while its output is changed.
        layer_inputs: dict[str, jax.Array] = {}

        def change_output(layer: str, inputs: jax.Array) -> jax.Array:
            layer_inputs[layer] = inputs
            return fast.layer_changes[layer](inputs) + step_changes[layer]

        changes = {layer: functools.partial(change_output, layer) for layer in step_changes}
        output = policy.decide_with_changes(pathways, PolicyState(hidden, action), changes)

        # With streams the loss reads the hidden state of the direct stream, which is the first.
        row = jnp.concatenate([output.hidden[: policy.hidden], jax.nn.softmax(output.logits)])
        return output.hidden, (row, layer_inputs)

    # Repeat the W decisions in order, from the hidden state before the window.
    window = (fast.window_pathways, fast.window_actions, output_changes)
    _, (rows, layer_inputs) = jax.lax.scan(repeat_decision, fast.window_start, window)
    return rows, layer_inputs


def _append_decision(fast: FastWeights, pathways: Pathways, memory: PolicyState) -> FastWeights:
    """Append the inputs of a decision to the window."""
    # Join the pathways, [..., P]; `reading`, the last field, is none.
    joined_pathways = jnp.concatenate(pathways[:-1], axis=-1)

    # The window [..., W, P] follows the axes of the batch.
    window_axis = memory.action.ndim

    def shift_in(window: jax.Array, latest: jax.Array) -> jax.Array:
        remaining = jax.lax.slice_in_dim(window, 1, None, axis=window_axis)
        return jnp.concatenate([remaining, jnp.expand_dims(latest, window_axis)], window_axis)

    # The hidden state is only needed from before the first decision of a window.
    is_first = (fast.num_decisions % WINDOW == 0)[..., None]
    return fast._replace(
        num_decisions=fast.num_decisions + 1,
        window_start=jnp.where(is_first, memory.hidden, fast.window_start),
        window_pathways=shift_in(fast.window_pathways, joined_pathways),
        window_actions=shift_in(fast.window_actions, memory.action),
    )
