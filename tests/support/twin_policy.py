"""The policies' decisions in plain NumPy: pathways, streams, the counterfactual, equation 2.

Float64, one episode, no arithmetic of the package; parameters are the nested dicts of `init_params`. What differs
between methods is a `TwinMethod`.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxnav.policies.methods import Knowledge
from jaxnav.policies.spec import PolicySpec
from support.twin_percept import Seen

NUM_ACTIONS = 6
Params = dict[str, Any]
#: What is added to the kernels (the last row is the bias) or to the outputs of layers, by name.
Added = dict[str, np.ndarray]


class Memory(NamedTuple):
    """Hold hidden states, one a stream, the previous action (6 at first) and what the method remembers."""

    hidden: list[np.ndarray]
    action: int
    fast: Any


class Decided(NamedTuple):
    """Hold factual and counterfactual logits [A], and the memory but for the action that follows."""

    factual: np.ndarray
    counterfactual: np.ndarray
    memory: Memory


class TwinMethod:
    """Make no experience: the method `rgb`. Others override what they have."""

    def __init__(self, knowledge: Knowledge):
        self.knowledge = {name: np.asarray(value) for name, value in knowledge.method.items()}

    def begin(self) -> None:
        """Forget the last episode."""

    def perceive(self, seen: Seen) -> Seen:
        """Return what the networks get."""
        return seen

    def take(self, seen: Seen, percept: Any) -> None:
        """Take in one step."""

    def read(self, goal: int) -> Any:
        """Return what the experience is made of beside the view."""
        return None

    def surroundings(self, reading: Any) -> np.ndarray:
        """Return what the reading tells of the scene."""
        return np.zeros(0)

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        """Return Z."""
        return np.zeros(0)

    def start(self, params: Params) -> Any:
        """Return the fast weights at an episode's start."""
        return None

    def changes(self, fast: Any) -> Added:
        """Return what fast weights add to the kernels of the direct stream."""
        return {}

    def adapt(self, params: Params, parts: list[np.ndarray], before: Memory, decided: Any, reading: Any) -> Any:
        """Return the fast weights after a decision."""
        return before.fast

    def act(self, choice: int) -> int:
        """Return the action of a choice."""
        return choice


def one_hot(index: int, size: int) -> np.ndarray:
    return (np.arange(size) == index).astype(float)


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(np.real(x) > 0, x, 0)


def softmax(x: np.ndarray) -> np.ndarray:
    exponential = np.exp(x - np.real(x).max(axis=-1, keepdims=True))
    return exponential / exponential.sum(axis=-1, keepdims=True)


def with_one(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)


def linear(params: Params, x: np.ndarray) -> np.ndarray:
    product = x @ params["kernel"]
    return product if params.get("bias") is None else product + params["bias"]


def whole(params: Params) -> np.ndarray:
    """Return a layer's kernel with the bias as its last row."""
    return np.vstack([params["kernel"], params["bias"]])


def perceptron(params: Params, rows: np.ndarray) -> np.ndarray:
    """Return the maps of rows, category by category, flat."""
    return relu(linear(params["outer"], relu(linear(params["inner"], rows)))).ravel()


def stream(
    params: Params, inputs: np.ndarray, hidden: np.ndarray, changes: Added, added: Added
) -> tuple[np.ndarray, np.ndarray]:
    """Return logits and the hidden state after one decision.

    Args:
      params: of the stream.
      inputs: [I], all that enters.
      hidden: [H].
      changes: of the kernels `fuse`, `drive`, `core` and `actor`.
      added: to their outputs.
    """

    def layer(name: str, kernel: np.ndarray, x: np.ndarray) -> np.ndarray:
        return x @ (kernel + changes.get(name, 0.0)) + added.get(name, 0.0)

    core = params["core"]
    entering = relu(layer("fuse", whole(params["fuse"]), with_one(inputs)))
    drive = layer("drive", whole(core["dense_i"]), with_one(entering))
    (r, z, n), (by_r, by_z, by_n) = (
        np.split(part, 3, axis=-1) for part in (drive, layer("core", core["dense_h"]["kernel"], hidden))
    )
    reset, update = (1 / (1 + np.exp(-x)) for x in (r + by_r, z + by_z))
    after = (1 - update) * np.tanh(n + reset * by_n) + update * hidden
    return layer("actor", whole(params["actor"]), with_one(after)), after


class TwinPolicy:
    """Decide as one policy does, `fused` or in `streams`."""

    def __init__(self, spec: PolicySpec, params: Params, method: TwinMethod):
        self.spec, self.params, self.method = spec, params, method
        self.streams = spec.decision == "streams"

    def memory(self) -> Memory:
        """Return the memory at an episode's start."""
        hidden = np.zeros(self.spec.sizes.hidden)
        return Memory([hidden] * (1 + self.streams), NUM_ACTIONS, self.method.start(self.params))

    def decide(self, seen: Seen, surroundings: np.ndarray, weights: np.ndarray, memory: Memory) -> Decided:
        """Return both decisions.

        Args:
          seen: the view.
          surroundings: what the map tells, of no length without one.
          weights: [K], the layout's.
          memory: before the decision.
        """
        params, seen = self.params, self.method.perceive(seen)
        reading = self.method.read(int(seen.goal.argmax()))
        inputs = np.concatenate([seen.view, surroundings, self.method.surroundings(reading)])
        scene, goal = relu(linear(params["view"], inputs)), self._goal(seen)
        appearance = params["known_appearance" if self.streams else "appearance"]["embedding"]
        known = self.method.encode(params.get("method", {}), seen, appearance, weights, reading, memory)
        previous, changes = one_hot(memory.action, NUM_ACTIONS), self.method.changes(memory.fast)
        if not self.streams:
            parts = [scene, goal, known, previous]
            logits, hidden = stream(params, np.concatenate(parts), memory.hidden[0], changes, {})
            without = np.concatenate([0 * scene, 0 * goal, known, previous])
            counterfactual, _ = stream(params, without, memory.hidden[0], changes, {})
            fast = self.method.adapt(params, parts, memory, (logits, hidden), reading)
            return Decided(logits, counterfactual, Memory([hidden], -1, fast))
        view, other_view = np.split(scene, 2)
        parts = [with_one(view), goal, previous]
        direct, hidden = stream(params, np.concatenate(parts), memory.hidden[0], changes, {})
        entering = np.concatenate([known, other_view, [1], previous])
        experience, experienced = stream(params["experience_stream"], entering, memory.hidden[1], {}, {})
        direct, experience = np.round(1024 * direct) / 1024, np.round(1024 * experience) / 1024
        fast = self.method.adapt(params, parts, memory, (direct + experience, hidden), reading)
        return Decided(direct + experience, experience, Memory([hidden, experienced], -1, fast))

    def _goal(self, seen: Seen) -> np.ndarray:
        """Return the embedding of detections and what is sought."""
        spec, params = self.spec, self.params
        shown = {"all": np.ones_like(seen.goal), "goal": seen.goal, "none": 0 * seen.goal}[spec.direct]
        rows = np.hstack([seen.visible[:, None] * params["appearance"]["embedding"], seen.table])
        parts = [perceptron(params["detections"], shown[:, None] * rows)]
        if spec.goal_row:
            parts.append(perceptron(params["detections"], (seen.goal * shown) @ rows))
        return np.concatenate([*parts, seen.goal @ params["sought"]["embedding"]])
