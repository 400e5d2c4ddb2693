"""The visual transformer network in plain NumPy, token by token."""

import math
from typing import Any

import numpy as np

from support.twin_percept import Seen
from support.twin_policy import Memory, Params, TwinMethod, linear, relu, softmax

SIDE, VIEW = 5, 11


def normalised(params: Params, rows: np.ndarray) -> np.ndarray:
    """Normalise rows to mean 0 and variance 1, then scale and shift."""
    mean, variance = rows.mean(axis=-1, keepdims=True), rows.var(axis=-1, keepdims=True)
    return (rows - mean) / np.sqrt(variance + 1e-6) * params["scale"] + params["bias"]


def forward(params: Params, rows: np.ndarray) -> np.ndarray:
    """Add what a perceptron makes of each row, and normalise."""
    return normalised(params["norm"], rows + linear(params["outer"], relu(linear(params["inner"], rows))))


def attended(params: Params, values: np.ndarray, query: np.ndarray, key: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """Add what two heads attend to, and normalise."""
    asked, keys, answers = linear(params["query"], query), linear(params["key"], key), linear(params["value"], memory)
    width, found = values.shape[-1] // 2, []
    for head in (slice(0, width), slice(width, None)):
        scores = asked[:, head] @ keys[:, head].T / math.sqrt(width)
        found.append(softmax(scores) @ answers[:, head])
    return normalised(params["norm"], values + linear(params["out"], np.hstack(found)))


def square(number: int) -> list[int]:
    """Return the cells of a square, 3 x 3 every two cells, of both planes of the view."""
    row, column = divmod(number, SIDE)
    cells = [(2 * row + i) * VIEW + 2 * column + j for i in range(3) for j in range(3)]
    return cells + [VIEW**2 + cell for cell in cells]


def place(number: int, width: int) -> np.ndarray:
    """Return the code of a square's place: sines and cosines of its row, then of its column."""
    code = []
    for along in divmod(number, SIDE):
        angles = [along * math.pi / SIDE / 2**i for i in range(width // 4)]
        code += [math.sin(angle) for angle in angles] + [math.cos(angle) for angle in angles]
    return np.array(code)


class TwinTransformer(TwinMethod):
    """Let squares of the view ask what is detected (`vtnet`), with `tokens` of them at most."""

    tokens = 4

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        goal = int(seen.goal.argmax())
        shown = [goal, *(k for k in np.flatnonzero(seen.visible).tolist() if k != goal)][: self.tokens]
        tokens = linear(params["token"], np.hstack([appearance[shown], seen.table[shown]]))
        for layer in self._layers(params["encoder"]):
            tokens = forward(layer["forward"], attended(layer["tokens"], tokens, tokens, tokens, tokens))
        known = weights[shown][:, None] * tokens
        query = relu(linear(params["query"], np.array([seen.view[square(i)] for i in range(SIDE**2)])))
        query += np.array([place(i, query.shape[1]) for i in range(SIDE**2)])
        answer = np.zeros_like(query)
        for layer in self._layers(params["decoder"]):
            if "answers" in layer:
                answer = attended(layer["answers"], answer, answer + query, answer + query, answer)
            answer = forward(layer["forward"], attended(layer["tokens"], answer, answer + query, known, known))
        return relu(linear(params["maps"], answer)).ravel()

    @staticmethod
    def _layers(params: Params) -> list[Params]:
        return [params[name] for name in sorted(params, key=int)]
