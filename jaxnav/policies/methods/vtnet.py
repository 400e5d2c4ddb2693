"""VTNet: the visual transformer network, over detections and squares of the view.

Source: H. Du, X. Yu and L. Zheng, *VTNet: Visual Transformer Network for Object Goal Navigation*, ICLR 2021, and its
released code; a host of L-sTDE in the paper.

Kept: each detection is a token, a post-norm encoder relates the tokens, and decoder queries, which are squares of the
view with a fixed sine code of their position, attend to the tokens. A separate head imitates shortest paths before the
rest of the policy is trained, and the imitated parameters then learn at a tenth of the rate. Changed: only the goal and
the detected categories are tokens, queries are 5 x 5 squares of the plan of the floor, the networks are smaller, and
there is no dropout.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear, add_bias, matmul_rows
from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.method import Experience, Method, Stage
from jaxnav.policies.methods.attention import FeedForward, MultiHeadAttention, UniformMultiHeadAttention
from jaxnav.policies.methods.imitation import expert_actions, imitation_loss
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NUM_ACTIONS

#: Share of all updates in which the transformer learns to imitate, before it is trained with the policy.
_IMITATION_SHARE = 0.2


class Transformer(Experience):
    """Transformer from the detected categories to squares of the view.

    An encoder relates the detected categories and the goal; each token embeds a category and its detection. The layout
    weights multiply the output of the encoder (eq. 7), because its last normalisation would undo earlier weights. A
    decoder then attends to this output from queries, which are squares of the view in front of the agent.
    """

    attention: ClassVar[type[MultiHeadAttention]] = MultiHeadAttention
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
        # Sizes, which command-line options can change.
        token_width = self.size(spec, "token_width")
        num_heads = self.size(spec, "heads")
        query_outputs = self.size(spec, "query_outputs")
        self.num_tokens = self.size(spec, "tokens")
        self.side = self.size(spec, "queries")
        self.view = RowFormat(spec.num_categories).view
        if token_width % num_heads or token_width % 4:
            raise InputError(
                f"config: method_sizes.token_width is {token_width}; give a multiple of 4 and of heads ({num_heads})"
            )
        if self.side > self.view:
            raise InputError(
                f"config: method_sizes.queries is {self.side}; give at most {self.view}, the side of the view in cells"
            )

        def build_layer(*attention_names: str) -> nnx.Dict:
            """Build attention modules by name, and the perceptron after them."""
            modules: dict[str, nnx.Module] = {}
            for attention_name in attention_names:
                modules[attention_name] = self.attention(token_width, num_heads, rngs)
            modules["forward"] = FeedForward(token_width, self.size(spec, "feedforward"), rngs)
            return nnx.Dict(modules)

        # Encoder: a token for each category, and layers in which the tokens attend to each other.
        self.token = Linear(spec.sizes.appearance + NUM_FEATURES, token_width, rngs=rngs)
        encoder_layers: dict[str, nnx.Dict] = {}
        for i in range(self.size(spec, "encoder_layers")):
            encoder_layers[str(i)] = build_layer("tokens")
        self.encoder = nnx.Dict(encoder_layers)

        # Decoder: the first layer does not attend to the answers of the queries, which are still zero.
        self.query = Linear(view_squares(self.view, self.side).shape[1], token_width, rngs=rngs)
        decoder_layers: dict[str, nnx.Dict] = {}
        for i in range(self.size(spec, "decoder_layers")):
            attention_names = ("tokens",) if i == 0 else ("answers", "tokens")
            decoder_layers[str(i)] = build_layer(*attention_names)
        self.decoder = nnx.Dict(decoder_layers)

        # Outputs for each query; the expert head serves the imitation only.
        self.maps = Linear(token_width, query_outputs, rngs=rngs)
        self.width = self.side**2 * query_outputs
        self.expert = Linear(self.width, NUM_ACTIONS, rngs=rngs)

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: Any) -> jax.Array:
        """Return experience, each encoded category weighted by the layout."""
        # Tokens [..., N, d] of appearance and detection. Appearances pass the linear layer once, before the selection.
        slots = self._slots(features)
        num_appearance = appearance.shape[-1]
        kernel = self.token.kernel[...]
        detections = matmul_rows(slots @ features.table, kernel[num_appearance:])
        appearances = matmul_rows(slots, appearance @ kernel[:num_appearance])
        tokens = add_bias(detections + appearances, self.token)

        # Encode the tokens, then weight them by the layout.
        is_present = slots.any(axis=-1)
        for layer in self.encoder.values():
            tokens = layer.forward(layer.tokens(tokens, tokens, tokens, tokens, is_present))
        weighted_tokens = slots @ weights[..., None] * tokens

        # Queries [..., side^2, d]: floor and walls in each square of the view, and the position of the square.
        squares = features.view[..., view_squares(self.view, self.side)]
        query = nnx.relu(self.query(squares))
        query = query + jnp.broadcast_to(position_codes(self.side, query.shape[-1]), query.shape)

        # Decode: the queries attend to each other and to the tokens.
        answers = jnp.zeros_like(query)
        for layer in self.decoder.values():
            if "answers" in layer:
                answers = layer.answers(answers, answers + query, answers + query, answers)
            attended = layer.tokens(answers, answers + query, weighted_tokens, weighted_tokens, is_present)
            answers = layer.forward(attended)
        maps = nnx.relu(self.maps(answers))
        return maps.reshape(*maps.shape[:-2], -1)

    def _slots(self, features: Features) -> jax.Array:
        """Return the category of each token.

        The first token is the goal, detected or not; other detected categories follow in their order. Categories beyond
        the N tokens are dropped.

        Returns:
          float32 [..., N, K], one-hot, or zero where there are fewer categories than tokens.
        """
        # Rank [..., K] of each category among the tokens: -1 if undetected; ranks of N or more get no token.
        other_visible = features.visible * (1.0 - features.goal)
        other_rank = jnp.where(other_visible > 0, jnp.cumsum(other_visible, axis=-1), -1.0)
        rank = jnp.where(features.goal > 0, 0.0, other_rank)
        slot = jnp.arange(self.num_tokens, dtype=jnp.float32).reshape((1,) * (rank.ndim - 1) + (-1, 1))
        return (rank[..., None, :] == slot).astype(jnp.float32)


class UniformTransformer(Transformer):
    """Transformer with equal attention: all queries get the same answer."""

    attention = UniformMultiHeadAttention


def view_squares(view: int, side: int) -> np.ndarray:
    """Return the cells of the view in each query's square.

    A square begins every V // side cells, and the squares are just large enough to cover the V x V cells of the view.

    Args:
      view: V.
      side: squares along each side.

    Returns:
      int [side^2, 2 cells], indices into `Features.view`, whose two halves are free and blocked cells.
    """
    # Starts of the squares along one side, and cells within a square.
    stride = view // side
    square_size = view - stride * (side - 1)
    starts = stride * np.arange(side)
    offsets = np.arange(square_size)

    # Indices of free cells, [square row, square column, cell row, cell column] -> [side^2, cells].
    line_starts = (starts[:, None, None, None] + offsets[:, None]) * view
    free_cells = (line_starts + starts[:, None, None] + offsets).reshape(side**2, -1)
    blocked_cells = view**2 + free_cells
    return np.concatenate([free_cells, blocked_cells], axis=1)


def position_codes(side: int, width: int) -> np.ndarray:
    """Return fixed codes of the squares' positions: sines and cosines of row and column.

    Returns:
      float32 [side^2, width].
    """
    # Sine and cosine of row and of column get a quarter of the width each.
    frequencies = np.pi / side / 2.0 ** np.arange(width // 4)
    angles = np.arange(side)[:, None] * frequencies
    line_codes = np.concatenate([np.sin(angles), np.cos(angles)], axis=1)

    row_codes = line_codes.repeat(side, axis=0)
    column_codes = np.tile(line_codes, (side, 1))
    return np.concatenate([row_codes, column_codes], axis=1).astype(np.float32)


def experience_imitation_loss(replay: Any, *_: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the imitation loss of a linear head on experience.

    Only this loss reads the head; the policy itself just explores in this stage.

    Args:
      replay: a `jaxnav.training.ppo.Replay`.
    """
    expert_head = replay.policy.experience.expert
    return imitation_loss(expert_head(replay.encoded.experience), expert_actions(replay))


_IMITATION = Stage(
    _IMITATION_SHARE,
    experience_imitation_loss,
    lr_scale_by_path=lambda path: 1.0 if path[0] == "method" else 0.0,
    uses_expert=True,
)
_REINFORCEMENT = Stage(
    1.0 - _IMITATION_SHARE,
    # Parameters that have imitated learn at a tenth of the rate, as in the released code.
    lr_scale_by_path=lambda path: 0.1 if path[0] == "method" else 1.0,
)

VTNET = Method(Transformer, stages=(_IMITATION, _REINFORCEMENT), name="vtnet")
#: Ablation without attention.
AVERAGED = dataclasses.replace(VTNET, experience=UniformTransformer)
#: Ablation without imitation, so all parameters learn at the whole rate.
UNTAUGHT = dataclasses.replace(VTNET, stages=(Stage(),))
#: Ablation whose imitated parameters learn at the whole rate after the imitation, the default until 0.3.
SINGLE_RATE = dataclasses.replace(VTNET, stages=(_IMITATION, Stage(1.0 - _IMITATION_SHARE)))
#: Name of the default in runs of 0.3.
SLOWER = VTNET
