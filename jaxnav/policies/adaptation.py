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
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear
from jaxnav.numerics.recurrence import gru_step
from jaxnav.numerics.sparse import update_where
from jaxnav.policies.network import Policy, Stream
from jaxnav.policies.pathways import Decision, Pathways, PolicyState

if TYPE_CHECKING:
    from jaxnav.policies.method import Adaptation


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
      inputs: float32 [..., R, M], inputs of the layer, with a 1 appended where the layer has a bias.
      outputs: float32 [..., R, N], change of the output per unit of similarity to each input.
    """

    inputs: jax.Array
    outputs: jax.Array

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Return the change of the layer's output [..., D, N] for the inputs [..., D, M] of D decisions."""
        similarity = inputs @ jnp.swapaxes(self.inputs, -1, -2)  # [..., D, R]
        return similarity @ self.outputs


class Window(NamedTuple):
    """The last `WINDOW` decisions of an episode, from which the next inner step learns; the latest is at the end.

    Attributes:
      start: float32 [..., H], hidden state before the first decision since the last inner step.
      fuse_inputs: float32 [..., W, M], inputs of the fusing layer, with a 1 for its bias.
      done_gate: float32 [..., W, 1], gates of Done's logit.
    """

    start: jax.Array
    fuse_inputs: jax.Array
    done_gate: jax.Array


class FastWeights(NamedTuple):
    """Fast weights of an episode, and the window of decisions that the next inner step learns from.

    Attributes:
      num_decisions: int32 [...], decisions so far.
      window: the last `WINDOW` decisions.
      layer_changes: the change of each layer, a row for every decision of the windows so far, in order; the rows of
        later windows are 0.
    """

    num_decisions: jax.Array
    window: Window
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

    def init(self, policy: Policy, batch: tuple[int, ...]) -> FastWeights:
        """Return fast weights without any change, and an empty window."""
        # One row for every decision of every window.
        rank = self.inner_steps * WINDOW
        layer_changes: dict[str, LowRankChange] = {}
        for layer, (input_width, output_width) in policy.layer_widths.items():
            inputs = jnp.zeros((*batch, rank, input_width))
            outputs = jnp.zeros((*batch, rank, output_width))
            layer_changes[layer] = LowRankChange(inputs, outputs)

        window = Window(
            start=jnp.zeros((*batch, policy.hidden_width)),
            fuse_inputs=jnp.zeros((*batch, WINDOW, policy.layer_widths["fuse"][0])),
            done_gate=jnp.zeros((*batch, WINDOW, 1)),
        )
        return FastWeights(jnp.zeros(batch, jnp.int32), window, layer_changes)

    def decide(self, policy: Policy, pathways: Pathways, memory: PolicyState) -> Decision:
        """Decide with the changed layers, then adapt where the window is full."""
        # Record the input of every layer while its output is changed.
        layer_inputs: dict[str, jax.Array] = {}

        def change_output(layer: str, inputs: jax.Array) -> jax.Array:
            layer_inputs[layer] = inputs
            return memory.fast.layer_changes[layer](inputs[..., None, :])[..., 0, :]

        changes = {layer: functools.partial(change_output, layer) for layer in memory.fast.layer_changes}
        output = policy.decide_with_changes(pathways, memory, changes)

        fast = _append_decision(memory.fast, layer_inputs, pathways.gate)
        return output._replace(fast=self.adapt_if_due(policy, fast))

    def adapt_if_due(self, policy: Policy, fast: FastWeights) -> FastWeights:
        """Take an inner step in the episodes whose window is full."""
        # The window is full after every `WINDOW` decisions, as long as the episode has inner steps left.
        is_full = (fast.num_decisions % WINDOW == 0) & (fast.num_decisions <= self.inner_steps * WINDOW)
        graph, params = nnx.split(policy)

        def adapt_episodes(
            params: Any, fast: FastWeights, layer_changes: dict[str, LowRankChange]
        ) -> dict[str, LowRankChange]:
            """Write the W rows of this window's step, of some episodes."""
            step_changes = self.compute_inner_step(nnx.merge(graph, params), fast.window, layer_changes)
            write_rows = jax.vmap(functools.partial(jax.lax.dynamic_update_slice_in_dim, axis=0))
            first_row = fast.num_decisions - WINDOW
            return jax.tree.map(lambda rows, new: write_rows(rows, new, first_row), layer_changes, step_changes)

        # Few windows of a batch are full at a time, and only these are read and written.
        inputs = fast._replace(layer_changes={})
        layer_changes = update_where(is_full, adapt_episodes, params, inputs, fast.layer_changes)
        return fast._replace(layer_changes=layer_changes)

    def compute_inner_step(
        self, policy: Policy, window: Window, layer_changes: dict[str, LowRankChange]
    ) -> dict[str, LowRankChange]:
        """Return the changes of one inner step, [..., W, ...] for each layer."""
        learned_loss = cast(HasLearnedLoss, policy.experience).learned_loss
        # First order: stop gradients of training everywhere but in the loss, which nothing else would train.
        if not self.second_order:
            graph, params = nnx.split(policy)
            policy = nnx.merge(graph, jax.lax.stop_gradient(params))
            window, layer_changes = jax.lax.stop_gradient((window, layer_changes))

        def window_loss(output_changes: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            rows, layer_inputs = replay_window(policy, window, layer_changes, output_changes)
            # Episodes are independent, so the gradient of the sum is that of each episode.
            return learned_loss(rows).sum(), layer_inputs

        # The gradient of a kernel is the sum over the window of input (x) gradient by the output, so differentiate by
        # a change of the outputs that is zero.
        output_gradients, layer_inputs = jax.grad(window_loss, has_aux=True)(zero_output_changes(layer_changes))

        # Descend: inputs and scaled gradients of the outputs are the two factors of the change.
        step_changes: dict[str, LowRankChange] = {}
        for layer, output_gradient in output_gradients.items():
            step_changes[layer] = LowRankChange(layer_inputs[layer], -self.learning_rate * output_gradient)
        return step_changes


def limit_inner_steps(adaptation: "Adaptation | None", inner_steps: int) -> "Adaptation | None":
    """Return an adaptation that takes at most `inner_steps` inner steps in an episode; None for 0.

    Raises:
      InputError: the method takes no inner steps, or `inner_steps` is above the number that it stores. The limit 0 is
        always possible.
    """
    # Without inner steps the policy needs no adaptation at all.
    if inner_steps == 0:
        return None
    if not isinstance(adaptation, LearnedLossAdaptation):
        raise InputError(f"inner_steps is {inner_steps}, but the method takes no inner steps; give 0 or omit it")
    if not 0 < inner_steps <= adaptation.inner_steps:
        capacity = f"an episode stores {adaptation.inner_steps} windows of {WINDOW} actions"
        raise InputError(f"inner_steps is {inner_steps}, but {capacity}; give 0 to {adaptation.inner_steps}")
    return dataclasses.replace(adaptation, inner_steps=inner_steps)


def zero_output_changes(layer_changes: dict[str, LowRankChange]) -> dict[str, jax.Array]:
    """Return a change of zero for every output of a window, float32 [..., W, N] for each layer."""
    output_changes: dict[str, jax.Array] = {}
    for layer, change in layer_changes.items():
        output_changes[layer] = jnp.zeros_like(change.outputs[..., :WINDOW, :])
    return output_changes


def replay_window(
    policy: Policy,
    window: Window,
    layer_changes: dict[str, LowRankChange],
    output_changes: dict[str, jax.Array],
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Repeat the decisions of a full window; with streams, those of the direct stream alone.

    Args:
      policy: the policy that decided.
      window: leaves [...].
      layer_changes: the change of each layer while the window was decided, leaves [...].
      output_changes: float32 [..., W, N] for each layer, added to its outputs in addition to its change.

    Returns:
      Rows float32 [..., W, H + A] of hidden state and action probabilities, and the inputs [..., W, M] of each layer.
    """
    layer_inputs: dict[str, jax.Array] = {}

    def change_output(layer: str, inputs: jax.Array) -> jax.Array:
        layer_inputs[layer] = inputs
        return layer_changes[layer](inputs) + output_changes[layer]

    changes = {layer: functools.partial(change_output, layer) for layer in ("input_gates", "actor")}

    # Fusing layer and input gates of all decisions at once, [..., W, 3 H]. `StreamsPolicy` overrides the methods of
    # `Stream` for both streams, so the direct stream's own are called by the class.
    fused = policy.fuse(window.fuse_inputs[..., :-1]) + change_output("fuse", window.fuse_inputs)
    input_gates = Stream.input_gates(policy, fused, changes)

    # Recurrent core, decision by decision.
    def step_core(hidden: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        input_gates, output_change = inputs
        change = layer_changes["hidden_gates"](hidden[..., None, :])[..., 0, :]
        hidden_gates = Stream.hidden_gates(policy, hidden) + change + output_change
        next_hidden = gru_step(input_gates, hidden_gates, hidden)
        return next_hidden, (hidden, next_hidden)

    time_first = functools.partial(jnp.moveaxis, source=-2, destination=0)
    core_inputs = time_first(input_gates), time_first(output_changes["hidden_gates"])
    _, hidden_states = jax.lax.scan(step_core, window.start, core_inputs, unroll=WINDOW)
    hidden_before, hidden = jax.tree.map(lambda states: jnp.moveaxis(states, 0, -2), hidden_states)
    layer_inputs["hidden_gates"] = hidden_before

    # Action probabilities of all decisions at once.
    logits = policy.action_logits(hidden, window.done_gate, changes)
    return jnp.concatenate([hidden, jax.nn.softmax(logits)], axis=-1), layer_inputs


def _append_decision(fast: FastWeights, layer_inputs: dict[str, jax.Array], done_gate: jax.Array) -> FastWeights:
    """Append the inputs of a decision to the window."""

    def shift_in(rows: jax.Array, latest: jax.Array) -> jax.Array:
        return jnp.concatenate([rows[..., 1:, :], latest[..., None, :]], axis=-2)

    # The hidden state is only needed from before the first decision of a window.
    is_first = (fast.num_decisions % WINDOW == 0)[..., None]
    window = Window(
        start=jnp.where(is_first, layer_inputs["hidden_gates"], fast.window.start),
        fuse_inputs=shift_in(fast.window.fuse_inputs, layer_inputs["fuse"]),
        done_gate=shift_in(fast.window.done_gate, done_gate),
    )
    return fast._replace(num_decisions=fast.num_decisions + 1, window=window)
