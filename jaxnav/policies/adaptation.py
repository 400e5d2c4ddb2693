"""Adaptation by a learned loss: gradient steps within an episode (SAVN: Wortsman et al., CVPR 2019)."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.sparse import where_due
from jaxnav.policies.learned_loss import WINDOW, Judging
from jaxnav.policies.pathways import Decision, Memory, Pathways, zero_experience

if TYPE_CHECKING:
    from jaxnav.policies.methods.base import Adaptation
    from jaxnav.policies.policy import Policy


class Factors(NamedTuple):
    """Hold the change of a layer as a product of low rank.

    Attributes:
      inputs: float32 [..., R, M], that the layer had, with a 1 for its bias.
      outputs: float32 [..., R, N], what is added for each of them.
    """

    inputs: jax.Array
    outputs: jax.Array

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Return what is added for inputs [..., M]."""
        likeness = (self.inputs * inputs[..., None, :]).sum(axis=-1, keepdims=True)
        return (likeness * self.outputs).sum(axis=-2)


class FastWeights(NamedTuple):
    """Hold the fast weights, and what they are learned from.

    Attributes:
      decisions: int32 [...], so far.
      start: float32 [..., H], the hidden state before the window.
      pathways: float32 [..., W, P], all pathways of the last decisions, joined; the latest is at the end.
      action: int32 [..., W], the action before each of them.
      factors: of each layer, a row for every step of the windows so far, in order; 0 for those to come.
    """

    decisions: jax.Array
    start: jax.Array
    pathways: jax.Array
    action: jax.Array
    factors: dict[str, Factors]


@dataclasses.dataclass(frozen=True)
class LearnedSteps:
    """Descend a learned loss every six decisions.

    The method's experience holds the loss, `learned_loss`. The layers that fuse, that are the recurrent core and the
    actor change, with streams those of the direct stream, by what it does alone. What precedes them, and experience,
    are inputs. The gradient of a kernel over a window is a sum of `WINDOW` outer products, so the change of an episode
    is kept as factors and the kernels are shared. Gradients of training reach the loss and the kernels through every
    inner step of a rollout; what was stored before it is constant.

    Attributes:
      inner_steps: in an episode, at most.
      rate: of an inner step.
      second_order: whether gradients of training pass the inner gradient; if not, they reach the learned loss alone.
    """

    inner_steps: int = 4
    rate: float = 0.01
    second_order: bool = True

    def __post_init__(self) -> None:
        if self.inner_steps < 1:
            raise InputError(f"LearnedSteps: inner_steps is {self.inner_steps}; give 1 or more, or no adaptation")

    def init(self, policy: "Policy", batch: tuple[int, ...]) -> FastWeights:
        """Return an empty window and no change."""
        rank = self.inner_steps * WINDOW
        return FastWeights(
            decisions=jnp.zeros(batch, jnp.int32),
            start=jnp.zeros((*batch, len(policy.recurrent_kernel))),
            pathways=jnp.zeros((*batch, WINDOW, sum(policy.pathway_widths))),
            action=jnp.zeros((*batch, WINDOW), jnp.int32),
            factors={
                layer: Factors(*(jnp.zeros((*batch, rank, width)) for width in widths))
                for layer, widths in policy.layer_widths.items()
            },
        )

    def decide(self, policy: "Policy", pathways: Pathways, memory: Memory) -> Decision:
        """Decide with the changed layers, then learn from the window."""
        fast = _noted(memory.fast, pathways, memory)
        decision = policy.decide_plainly(pathways, memory, dict(fast.factors))
        return decision._replace(fast=self.adapted(policy, fast))

    def adapted(self, policy: "Policy", fast: FastWeights) -> FastWeights:
        """Take an inner step in the episodes whose window is full."""
        full = (fast.decisions % WINDOW == 0) & (fast.decisions <= self.inner_steps * WINDOW)
        graph, params = nnx.split(policy)

        def step(params: Any, window: FastWeights, factors: dict[str, Factors]) -> dict[str, Factors]:
            new = self.inner_step(nnx.merge(graph, params), window._replace(factors=factors))
            write = functools.partial(
                jax.lax.dynamic_update_slice_in_dim, start_index=window.decisions - WINDOW, axis=0
            )
            return jax.tree.map(write, factors, new)

        factors = where_due(full, step, params, fast._replace(factors={}), fast.factors)
        return fast._replace(factors=factors)

    def inner_step(self, policy: "Policy", fast: FastWeights) -> dict[str, Factors]:
        """Return the factors of an inner step, [W, ...], of one episode."""
        loss = cast(Judging, policy.method).learned_loss
        if not self.second_order:  # not into the loss itself: nothing else would teach it
            graph, state = nnx.split(policy)
            policy, fast = nnx.merge(graph, jax.lax.stop_gradient(state)), jax.lax.stop_gradient(fast)
        added = {layer: jnp.zeros_like(factors.outputs[:WINDOW]) for layer, factors in fast.factors.items()}

        def judge(added: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            rows, inputs = replay_window(policy, fast, added)
            return loss(rows), inputs

        gradient, inputs = jax.grad(judge, has_aux=True)(added)
        return {layer: Factors(inputs[layer], -self.rate * by_output) for layer, by_output in gradient.items()}


def limited(adaptation: "Adaptation | None", inner_steps: int) -> "Adaptation | None":
    """Return an adaptation that takes fewer inner steps.

    Raises:
      InputError: it takes no inner steps, or not so many; none at all is always possible.
    """
    if inner_steps == 0:
        return None
    if not isinstance(adaptation, LearnedSteps):
        raise InputError(f"inner_steps is {inner_steps}; the method adapts in another way: give 0, or leave it out")
    if not 0 < inner_steps <= adaptation.inner_steps:
        most = f"an episode remembers {adaptation.inner_steps} windows of {WINDOW} actions"
        raise InputError(f"inner_steps is {inner_steps}; {most}: give 0 to {adaptation.inner_steps}")
    return dataclasses.replace(adaptation, inner_steps=inner_steps)


def replay_window(
    policy: "Policy", fast: FastWeights, added: dict[str, jax.Array]
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Decide again along the window of one episode.

    Args:
      policy: that decided.
      fast: leaves without a batch.
      added: float32 [W, N] of each layer, to its outputs besides the change.

    Returns:
      Rows float32 [W, H + A] of hidden state and probabilities, and the inputs [W, M] of each layer.
    """

    def again(hidden: jax.Array, part: tuple[jax.Array, jax.Array, dict[str, jax.Array]]) -> tuple[jax.Array, Any]:
        entered, action, added = part
        pathways = Pathways(*jnp.split(entered, np.cumsum(policy.pathway_widths)[:-1]))
        inputs: dict[str, jax.Array] = {}

        def change(layer: str, entering: jax.Array) -> jax.Array:
            inputs[layer] = entering
            return fast.factors[layer](entering) + added[layer]

        changes = {layer: functools.partial(change, layer) for layer in added}
        decision = policy.decide_plainly(pathways, Memory(hidden, action), changes)
        row = jnp.concatenate([decision.hidden[: policy.hidden], jax.nn.softmax(decision.logits)])
        return decision.hidden, (row, inputs)

    return jax.lax.scan(again, fast.start, (fast.pathways, fast.action, added))[1]


def _noted(fast: FastWeights, pathways: Pathways, memory: Memory) -> FastWeights:
    """Write down what a decision is made of.

    With streams the window goes without experience: the direct stream adapts as if it acted alone.
    """
    alone = zero_experience(pathways, jax.tree.map(jnp.zeros_like, memory.experienced))
    axis = memory.action.ndim

    def append(past: jax.Array, now: jax.Array) -> jax.Array:
        return jnp.concatenate([jax.lax.slice_in_dim(past, 1, None, axis=axis), jnp.expand_dims(now, axis)], axis)

    begins = (fast.decisions % WINDOW == 0)[..., None]
    return fast._replace(
        decisions=fast.decisions + 1,
        start=jnp.where(begins, memory.hidden, fast.start),
        pathways=append(fast.pathways, jnp.concatenate(alone[:-1], axis=-1)),
        action=append(fast.action, memory.action),
    )
