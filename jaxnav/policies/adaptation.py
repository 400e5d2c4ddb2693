"""Adaptation by a learned loss: gradient steps within an episode (SAVN: Wortsman et al., CVPR 2019)."""

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear
from jaxnav.numerics.sparse import where_due
from jaxnav.policies.pathways import Decision, Memory, Pathways, zero_experience

if TYPE_CHECKING:
    from jaxnav.policies.policy import Policy

#: Environment steps between two inner steps. The learned loss reads all of them.
WINDOW = 6
_CHANNELS = 10  # of the learned loss
_TINY = 1e-12  # below the square of any loss


class LearnedLoss(nnx.Module):
    """Judge a window without reward.

    Two causal convolutions along a row's entries, the window's steps being channels, and the length of the result.
    """

    def __init__(self, rngs: nnx.Rngs) -> None:
        self.first, self.second = Linear(2 * WINDOW, _CHANNELS, rngs=rngs), Linear(2 * _CHANNELS, 1, rngs=rngs)

    def __call__(self, rows: jax.Array) -> jax.Array:
        """Return the loss of rows float32 [..., W, L], at least 0."""
        entries = jnp.swapaxes(rows, -1, -2)
        inner = nnx.leaky_relu(self.first(_with_earlier(entries, 1)))
        outer = nnx.leaky_relu(self.second(_with_earlier(inner, 2)))
        return jnp.sqrt(jnp.square(outer).sum(axis=(-2, -1)) + _TINY)


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
      pathways: of the last decisions, leaves [..., W, ...]; the latest is at the end.
      action: int32 [..., W], the action before each of them.
      factors: of each layer, a row for every step of the windows so far; the latest are at the end.
    """

    decisions: jax.Array
    start: jax.Array
    pathways: Pathways
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
      steps: in an episode, at most.
      rate: of an inner step.
      second_order: whether gradients of training pass the inner gradient; if not, they reach the learned loss alone.
    """

    steps: int = 4
    rate: float = 0.01
    second_order: bool = True

    def init(self, policy: "Policy", batch: tuple[int, ...]) -> FastWeights:
        """Return an empty window and no change."""

        def empty(count: int, widths: tuple[int, ...]) -> list[jax.Array]:
            return [jnp.zeros((*batch, count, width)) for width in widths]

        rank = self.steps * WINDOW
        return FastWeights(
            decisions=jnp.zeros(batch, jnp.int32),
            start=jnp.zeros((*batch, len(policy.recurrent_kernel))),
            pathways=Pathways(*empty(WINDOW, policy.pathway_widths)),
            action=jnp.zeros((*batch, WINDOW), jnp.int32),
            factors={layer: Factors(*empty(rank, widths)) for layer, widths in policy.layer_widths.items()},
        )

    def decide(self, policy: "Policy", pathways: Pathways, memory: Memory) -> Decision:
        """Decide with the changed layers, then learn from the window."""
        fast = _noted(memory.fast, pathways, memory)
        decision = policy.decide_plainly(pathways, memory, dict(fast.factors))
        return decision._replace(fast=self.adapted(policy, fast))

    def adapted(self, policy: "Policy", fast: FastWeights) -> FastWeights:
        """Take an inner step in the episodes whose window is full."""
        full = (fast.decisions % WINDOW == 0) & (fast.decisions <= self.steps * WINDOW)
        new = where_due(full, functools.partial(self.step, policy), fast)

        def append(past: jax.Array, new: jax.Array) -> jax.Array:
            return jnp.where(full[..., None, None], jnp.concatenate([past[..., WINDOW:, :], new], axis=-2), past)

        return fast._replace(factors=jax.tree.map(append, fast.factors, new))

    def step(self, policy: "Policy", fast: FastWeights) -> dict[str, Factors]:
        """Return the factors of an inner step, [W, ...], of one episode."""
        loss = policy.method.learned_loss
        if not self.second_order:  # not into the loss itself: nothing else would teach it
            graph, state = nnx.split(policy)
            policy, fast = nnx.merge(graph, jax.lax.stop_gradient(state)), jax.lax.stop_gradient(fast)
        added = {layer: jnp.zeros_like(factors.outputs[:WINDOW]) for layer, factors in fast.factors.items()}

        def judge(added: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            rows, inputs = replay_window(policy, fast, added)
            return loss(rows), inputs

        gradient, inputs = jax.grad(judge, has_aux=True)(added)
        return {layer: Factors(inputs[layer], -self.rate * by_output) for layer, by_output in gradient.items()}


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

    def again(hidden: jax.Array, part: tuple[Pathways, jax.Array, dict[str, jax.Array]]) -> tuple[jax.Array, Any]:
        pathways, action, added = part
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
    alone = zero_experience(pathways._replace(reading=None), jax.tree.map(jnp.zeros_like, memory.experienced))
    axis = memory.action.ndim

    def append(past: jax.Array, now: jax.Array) -> jax.Array:
        return jnp.concatenate([jax.lax.slice_in_dim(past, 1, None, axis=axis), jnp.expand_dims(now, axis)], axis)

    begins = (fast.decisions % WINDOW == 0)[..., None]
    return fast._replace(
        decisions=fast.decisions + 1,
        start=jnp.where(begins, memory.hidden, fast.start),
        pathways=jax.tree.map(append, fast.pathways, alone),
        action=append(fast.action, memory.action),
    )


def _with_earlier(entries: jax.Array, distance: int) -> jax.Array:
    """Join each entry [..., L, C] and the one so far before it."""
    earlier = jnp.concatenate([jnp.zeros_like(entries[..., :distance, :]), entries[..., :-distance, :]], axis=-2)
    return jnp.concatenate([earlier, entries], axis=-1)
