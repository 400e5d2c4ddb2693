"""The visual transformer network in plain NumPy, token by token."""

import math
from typing import Any

import numpy as np
from twins.perception import TwinFeatures
from twins.policy import Params, TwinMemory, TwinMethod, linear, relu, softmax

#: Squares and cells along a side of the view.
SIDE = 5
VIEW = 11


def layer_norm(params: Params, rows: np.ndarray) -> np.ndarray:
    """Normalise rows to mean 0 and variance 1, then scale and shift."""
    mean = rows.mean(axis=-1, keepdims=True)
    variance = rows.var(axis=-1, keepdims=True)
    return (rows - mean) / np.sqrt(variance + 1e-6) * params["scale"] + params["bias"]


def residual_perceptron(params: Params, rows: np.ndarray) -> np.ndarray:
    """Add the output of a perceptron to each row, and normalise."""
    return layer_norm(params["norm"], rows + linear(params["outer"], relu(linear(params["inner"], rows))))


def residual_attention(
    params: Params, values: np.ndarray, query: np.ndarray, key: np.ndarray, memory: np.ndarray
) -> np.ndarray:
    """Add the answers of two attention heads, and normalise."""
    queries = linear(params["query"], query)
    keys = linear(params["key"], key)
    memories = linear(params["value"], memory)
    width = values.shape[-1] // 2
    answers = []
    for head in (slice(0, width), slice(width, None)):
        scores = queries[:, head] @ keys[:, head].T / math.sqrt(width)
        answers.append(softmax(scores) @ memories[:, head])
    return layer_norm(params["norm"], values + linear(params["out"], np.hstack(answers)))


def square_cells(square: int) -> list[int]:
    """Return the cells of a square in both planes of the view; squares of 3 x 3 cells begin every two cells."""
    row, column = divmod(square, SIDE)
    cells = []
    for i in range(3):
        for j in range(3):
            cells.append((2 * row + i) * VIEW + 2 * column + j)
    return cells + [VIEW**2 + cell for cell in cells]


def position_code(square: int, width: int) -> np.ndarray:
    """Return the code of a square's position: sines and cosines of its row, then of its column."""
    code = []
    for coordinate in divmod(square, SIDE):
        angles = [coordinate * math.pi / SIDE / 2**i for i in range(width // 4)]
        code.extend(math.sin(angle) for angle in angles)
        code.extend(math.cos(angle) for angle in angles)
    return np.array(code)


class TwinTransformer(TwinMethod):
    """Squares of the view attend to detections (`vtnet`), at most `num_tokens` of them."""

    num_tokens = 4

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        # A token for the goal and for each detection, encoded and weighted by the layout.
        goal = int(features.goal.argmax())
        visible_categories = np.flatnonzero(features.visible).tolist()
        other_categories = [category for category in visible_categories if category != goal]
        categories = [goal, *other_categories][: self.num_tokens]
        tokens = linear(params["token"], np.hstack([appearance[categories], features.table[categories]]))
        for layer in self._layers(params["encoder"]):
            mixed_tokens = residual_attention(layer["tokens"], tokens, tokens, tokens, tokens)
            tokens = residual_perceptron(layer["forward"], mixed_tokens)
        experience = weights[categories][:, None] * tokens

        # A query for each square, with the code of its position.
        square_views = np.array([features.view[square_cells(square)] for square in range(SIDE**2)])
        query = relu(linear(params["query"], square_views))
        query += np.array([position_code(square, query.shape[1]) for square in range(SIDE**2)])

        # The squares attend to each other (but for the first layer), then to the tokens.
        answer = np.zeros_like(query)
        for layer in self._layers(params["decoder"]):
            if "answers" in layer:
                answer = residual_attention(layer["answers"], answer, answer + query, answer + query, answer)
            token_answer = residual_attention(layer["tokens"], answer, answer + query, experience, experience)
            answer = residual_perceptron(layer["forward"], token_answer)
        return relu(linear(params["maps"], answer)).ravel()

    @staticmethod
    def _layers(params: Params) -> list[Params]:
        return [params[name] for name in sorted(params, key=int)]
