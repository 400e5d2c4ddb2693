"""The visual transformer network (Du et al., ICLR 2021)."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear, biased, product
from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.methods.attention import Attention, Averaging, FeedForward
from jaxnav.policies.methods.base import Experience, Method, Stage
from jaxnav.policies.methods.imitation import expert_actions, imitation_loss
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NUM_ACTIONS

#: Share of all updates in which the transformer learns what shortest paths do, before it is trained with the policy.
IMITATION = 0.2


class Transformer(Experience):
    """Let places in view ask what is detected.

    An encoder relates the detected categories and the goal, each a token of what it is and where it is detected. The
    layout weights multiply what it returns (eq. 7): before its last normalisation they would be undone. A decoder then
    attends to it from queries, squares of the view in front of the agent.
    """

    attention: ClassVar[type[Attention]] = Attention
    sizes: ClassVar[Mapping[str, int]] = {
        "token_width": 32,
        "heads": 2,
        "feedforward": 64,
        "tokens": 10,
        "encoder_layers": 2,
        "decoder_layers": 2,
        "queries": 5,
        "query_outputs": 8,
    }

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        width, heads, hidden, self.num_tokens, encoders, decoders, side, outputs = (
            self.size(spec, name) for name in self.sizes
        )
        view = RowFormat(spec.num_categories).view
        if width % heads or width % 4:
            raise InputError(
                f"config: method_sizes.token_width is {width}; give a multiple of 4 and of heads ({heads})"
            )
        if side > view:
            raise InputError(f"config: method_sizes.queries is {side}; give at most {view}, the cells along the view")

        def layer(*attentions: str) -> nnx.Dict:
            parts: dict[str, nnx.Module] = {name: self.attention(width, heads, rngs) for name in attentions}
            return nnx.Dict(parts | {"forward": FeedForward(width, hidden, rngs)})

        self.token = Linear(spec.sizes.appearance + NUM_FEATURES, width, rngs=rngs)
        self.encoder = nnx.Dict({f"{i}": layer("tokens") for i in range(encoders)})
        self.view, self.side = view, side
        self.query = Linear(squares(view, side).shape[1], width, rngs=rngs)
        # At first there are no answers to exchange: the first layer would attend to zeros.
        self.decoder = nnx.Dict({f"{i}": layer(*["answers"] * (i > 0), "tokens") for i in range(decoders)})
        self.maps = Linear(width, outputs, rngs=rngs)
        self.width = side**2 * outputs
        self.expert = Linear(self.width, NUM_ACTIONS, rngs=rngs)  # for imitation alone

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> jax.Array:
        """Return experience, each encoded category weighted by the layout."""
        slots = self._slots(features)
        kernel, split = self.token.kernel[...], appearance.shape[-1]
        rows = product(slots @ features.table, kernel[split:])
        tokens = biased(rows + product(slots, appearance @ kernel[:split]), self.token)
        present = slots.any(axis=-1)
        for layer in self.encoder.values():
            tokens = layer.forward(layer.tokens(tokens, tokens, tokens, tokens, present))
        known = slots @ weights[..., None] * tokens

        query = nnx.relu(self.query(features.view[..., squares(self.view, self.side)]))
        query = query + jnp.broadcast_to(places(self.side, query.shape[-1]), query.shape)
        answer = jnp.zeros_like(query)
        for layer in self.decoder.values():
            if "answers" in layer:
                answer = layer.answers(answer, answer + query, answer + query, answer)
            answer = layer.forward(layer.tokens(answer, answer + query, known, known, present))
        maps = nnx.relu(self.maps(answer))
        return maps.reshape(*maps.shape[:-2], -1)

    def _slots(self, features: Features) -> jax.Array:
        """Return which category each token is.

        The goal's is the first, detected or not, for it says what is sought; the other detected ones follow.

        Returns:
          float32 [..., N, K], one-hot or, where there are fewer, zero.
        """
        others = features.visible * (1.0 - features.goal)
        rank = jnp.where(features.goal > 0, 0.0, jnp.where(others > 0, jnp.cumsum(others, axis=-1), -1.0))
        slot = jnp.arange(self.num_tokens, dtype=jnp.float32).reshape((1,) * (rank.ndim - 1) + (-1, 1))
        return (rank[..., None, :] == slot).astype(jnp.float32)


class AveragingTransformer(Transformer):
    """Let places in view get the same answer."""

    attention = Averaging


def squares(view: int, side: int) -> np.ndarray:
    """Return the cells of each query's square of the view.

    The squares cover the view; with V cells along it, they are as large as they must be to begin every V // side cells.

    Args:
      view: V.
      side: squares along each side.

    Returns:
      int [side^2, 2 cells], indices into `Features.view`.
    """
    stride = view // side
    size = view - stride * (side - 1)
    begin, offset = stride * np.arange(side), np.arange(size)
    rows = (begin[:, None, None, None] + offset[:, None]) * view
    cells = (rows + begin[:, None, None] + offset).reshape(side**2, -1)
    return np.concatenate([cells, view**2 + cells], axis=1)


def places(side: int, width: int) -> np.ndarray:
    """Return fixed codes of the squares' places.

    Sines and cosines of row and column.

    Returns:
      float32 [side^2, width].
    """
    rates = np.pi / side / 2.0 ** np.arange(width // 4)
    along = np.arange(side)[:, None] * rates
    code = np.concatenate([np.sin(along), np.cos(along)], axis=1)
    return np.concatenate([code.repeat(side, axis=0), np.tile(code, (side, 1))], axis=1).astype(np.float32)


def expert_loss(replayed: Any, *_: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return how badly experience alone tells a shortest path's actions.

    A head of its own reads it, and nothing else does: the policy only explores in this stage.
    """
    transformer = replayed.policy.method
    experience = replayed.pathways.experience[..., : transformer.width]
    return imitation_loss(transformer.expert(experience), expert_actions(replayed))


VTNET = Method(
    Transformer,
    stages=(
        Stage(IMITATION, expert_loss, rates=lambda path: path[0] == "method", imitates=True),
        Stage(1.0 - IMITATION),
    ),
)
#: The ablations that it must beat: without attention, and without imitation.
AVERAGED = dataclasses.replace(VTNET, experience=AveragingTransformer)
UNTAUGHT = dataclasses.replace(VTNET, stages=(Stage(),))
#: VTNet whose transformer, once it has imitated, learns at a tenth of the rate, as in the released code.
_imitate, _reinforce = VTNET.stages
_slowly = dataclasses.replace(_reinforce, rates=lambda path: 0.1 if path[0] == "method" else 1.0)
SLOWER = dataclasses.replace(VTNET, stages=(_imitate, _slowly))
