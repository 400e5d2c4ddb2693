"""The policies' decisions in plain NumPy: pathways, streams, the counterfactual.

A twin computes in float64, one episode at a time, with no arithmetic of the package. Parameters are the nested dicts of
`init_params`. A `TwinMethod` holds the part in which methods differ.
"""

from typing import Any, NamedTuple

import numpy as np
from twins.perception import TwinFeatures

from jaxnav.policies.method import Knowledge
from jaxnav.policies.spec import PolicySpec

NUM_ACTIONS = 6
#: Columns of a detection with its geometry (offsets, distance, bearing, apparent size), and their factor in `pixel`.
GEOMETRY_COLUMNS = [2, 3, 4, 5, 6, 7]
IMAGE_PIXELS = 300
Params = dict[str, Any]
#: Changes by layer: added to the kernels (the last row is the bias), or to the outputs.
LayerChanges = dict[str, np.ndarray]


class TwinMemory(NamedTuple):
    """Memory of a policy within an episode.

    Attributes:
      hidden: recurrent states [H], one per stream.
      action: previous action, 6 at the start.
      fast: fast weights of the method; None without any.
    """

    hidden: list[np.ndarray]
    action: int
    fast: Any


class TwinDecision(NamedTuple):
    """Factual and counterfactual logits [A], and the memory after the decision, whose action is set later."""

    factual: np.ndarray
    counterfactual: np.ndarray
    memory: TwinMemory


class TwinMethod:
    """A method without experience (`rgb`). Subclasses override the parts in which they differ."""

    def __init__(self, knowledge: Knowledge):
        self.knowledge = {name: np.asarray(value) for name, value in knowledge.method.items()}

    def begin(self) -> None:
        """Start an episode."""

    def perceive(self, features: TwinFeatures) -> TwinFeatures:
        """Return the features that the networks read."""
        return features

    def update(self, features: TwinFeatures, percept: Any) -> None:
        """Update the state of the tracker."""

    def read(self, goal: int) -> Any:
        """Return the reading of the tracker."""
        return None

    def scene_inputs(self, reading: Any) -> np.ndarray:
        """Return the part of the reading that describes the scene."""
        return np.zeros(0)

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        """Return the experience Z."""
        return np.zeros(0)

    def initial_fast(self, params: Params) -> Any:
        """Return the fast weights at an episode's start."""
        return None

    def layer_changes(self, fast: Any) -> LayerChanges:
        """Return the changes of the direct stream's kernels by fast weights."""
        return {}

    def adapt(
        self,
        params: Params,
        inputs: np.ndarray,
        memory: TwinMemory,
        logits: np.ndarray,
        hidden: np.ndarray,
        reading: Any,
    ) -> Any:
        """Return the fast weights after a decision.

        Args:
          params: parameters of the policy.
          inputs: inputs of the direct stream.
          memory: memory before the decision.
          logits: logits of the decision.
          hidden: recurrent state of the direct stream after the decision.
          reading: reading of the tracker.
        """
        return memory.fast

    def act(self, choice: int) -> int:
        """Return the action of a choice."""
        return choice


def one_hot(index: int, size: int) -> np.ndarray:
    return (np.arange(size) == index).astype(float)


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(np.real(x) > 0, x, 0)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def softmax(x: np.ndarray) -> np.ndarray:
    exponential = np.exp(x - np.real(x).max(axis=-1, keepdims=True))
    return exponential / exponential.sum(axis=-1, keepdims=True)


def append_one(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)


def linear(params: Params, x: np.ndarray) -> np.ndarray:
    product = x @ params["kernel"]
    return product if params.get("bias") is None else product + params["bias"]


def kernel_with_bias(params: Params) -> np.ndarray:
    """Return a layer's kernel with the bias as its last row."""
    return np.vstack([params["kernel"], params["bias"]])


def category_maps(params: Params, rows: np.ndarray) -> np.ndarray:
    """Return the maps of rows, category by category, flat."""
    return relu(linear(params["outer"], relu(linear(params["inner"], rows)))).ravel()


def run_stream(
    params: Params, inputs: np.ndarray, hidden: np.ndarray, changes: LayerChanges, output_changes: LayerChanges
) -> tuple[np.ndarray, np.ndarray]:
    """Return logits and the recurrent state after one decision.

    Args:
      params: parameters of the stream.
      inputs: all inputs side by side, [I].
      hidden: recurrent state, [H].
      changes: changes of the kernels of `fuse`, `input_gates`, `hidden_gates` and `actor`, by layer.
      output_changes: changes of the outputs of these layers.
    """

    def apply_layer(name: str, kernel: np.ndarray, x: np.ndarray) -> np.ndarray:
        return x @ (kernel + changes.get(name, 0.0)) + output_changes.get(name, 0.0)

    core = params["core"]
    fused = relu(apply_layer("fuse", kernel_with_bias(params["fuse"]), append_one(inputs)))

    # The gated recurrent unit: reset gate, update gate and new state, each from the inputs and from the last state.
    input_gates = apply_layer("input_gates", kernel_with_bias(core["dense_i"]), append_one(fused))
    hidden_gates = apply_layer("hidden_gates", core["dense_h"]["kernel"], hidden)
    input_reset, input_update, input_new = np.split(input_gates, 3, axis=-1)
    hidden_reset, hidden_update, hidden_new = np.split(hidden_gates, 3, axis=-1)
    reset = sigmoid(input_reset + hidden_reset)
    update = sigmoid(input_update + hidden_update)
    new_state = np.tanh(input_new + reset * hidden_new)
    next_hidden = (1 - update) * new_state + update * hidden

    logits = apply_layer("actor", kernel_with_bias(params["actor"]), append_one(next_hidden))
    return logits, next_hidden


class TwinPolicy:
    """One policy, whose decision is `fused` or in `streams`."""

    def __init__(self, spec: PolicySpec, params: Params, method: TwinMethod):
        self.spec = spec
        self.params = params
        self.method = method
        self.has_streams = spec.decision == "streams"

    def initial_memory(self) -> TwinMemory:
        """Return the memory at an episode's start."""
        num_streams = 2 if self.has_streams else 1
        hidden = np.zeros(self.spec.sizes.hidden)
        return TwinMemory([hidden] * num_streams, NUM_ACTIONS, self.method.initial_fast(self.params))

    def decide(
        self, features: TwinFeatures, surroundings: np.ndarray, weights: np.ndarray, memory: TwinMemory
    ) -> TwinDecision:
        """Return the factual and the counterfactual decision.

        Args:
          features: features of the view.
          surroundings: inputs from the map; empty without a map.
          weights: layout weights, [K].
          memory: memory before the decision.
        """
        params = self.params
        weights = self._scale_weights(weights, int(features.goal.argmax()))
        features = self.method.perceive(features)
        reading = self.method.read(int(features.goal.argmax()))

        # The three pathways: scene, goal and experience.
        scene_inputs = [features.view, surroundings, self.method.scene_inputs(reading)]
        scene = relu(linear(params["view"], np.concatenate(scene_inputs)))
        goal = self._embed_goal(features)
        appearance = params["known_appearance" if self.has_streams else "appearance"]["embedding"]
        experience_features = self._scale_geometry(features)
        experience = self.method.encode(
            params.get("method", {}), experience_features, appearance, weights, reading, memory
        )

        decide = self._decide_in_streams if self.has_streams else self._decide_fused
        return decide(scene, goal, experience, memory, reading)

    def _scale_weights(self, weights: np.ndarray, goal: int) -> np.ndarray:
        """Return the goal's column of w at the scale of the spec; `relative` divides by the mean off the goal."""
        if self.spec.weight_kind != "relative":
            return weights
        other_weights = [weight for category, weight in enumerate(weights.tolist()) if category != goal]
        mean_weight = sum(other_weights) / len(other_weights)
        scaled_weights = np.array([min(weight / mean_weight, 4.0) for weight in weights.tolist()])
        scaled_weights[goal] = weights[goal]
        return scaled_weights

    def _scale_geometry(self, features: TwinFeatures) -> TwinFeatures:
        """Return the features that experience reads; `pixel` multiplies all columns with geometry by 300."""
        if self.spec.weight_kind != "pixel":
            return features
        table = features.table.copy()
        table[:, GEOMETRY_COLUMNS] *= IMAGE_PIXELS
        return features._replace(table=table)

    def _decide_fused(
        self, scene: np.ndarray, goal: np.ndarray, experience: np.ndarray, memory: TwinMemory, reading: Any
    ) -> TwinDecision:
        """Decide from all pathways at once; the counterfactual zeroes scene and goal."""
        changes = self.method.layer_changes(memory.fast)
        previous_action = one_hot(memory.action, NUM_ACTIONS)

        inputs = np.concatenate([scene, goal, experience, previous_action])
        logits, hidden = run_stream(self.params, inputs, memory.hidden[0], changes, {})
        indirect_inputs = np.concatenate([0 * scene, 0 * goal, experience, previous_action])
        counterfactual, _ = run_stream(self.params, indirect_inputs, memory.hidden[0], changes, {})

        fast = self.method.adapt(self.params, inputs, memory, logits, hidden, reading)
        return TwinDecision(logits, counterfactual, TwinMemory([hidden], -1, fast))

    def _decide_in_streams(
        self, scene: np.ndarray, goal: np.ndarray, experience: np.ndarray, memory: TwinMemory, reading: Any
    ) -> TwinDecision:
        """Decide by the sum of two streams; the counterfactual is the stream of experience."""
        changes = self.method.layer_changes(memory.fast)
        previous_action = one_hot(memory.action, NUM_ACTIONS)
        direct_view, experience_view = np.split(scene, 2)

        direct_inputs = np.concatenate([append_one(direct_view), goal, previous_action])
        direct, direct_hidden = run_stream(self.params, direct_inputs, memory.hidden[0], changes, {})
        experience_inputs = np.concatenate([experience, experience_view, [1], previous_action])
        stream_params = self.params["experience_stream"]
        indirect, experience_hidden = run_stream(stream_params, experience_inputs, memory.hidden[1], {}, {})

        # Logits are rounded, so that subtracting a stream undoes their sum exactly.
        direct = np.round(1024 * direct) / 1024
        indirect = np.round(1024 * indirect) / 1024
        logits = direct + indirect

        fast = self.method.adapt(self.params, direct_inputs, memory, logits, direct_hidden, reading)
        return TwinDecision(logits, indirect, TwinMemory([direct_hidden, experience_hidden], -1, fast))

    def _embed_goal(self, features: TwinFeatures) -> np.ndarray:
        """Return the embedding of detections and goal."""
        # Categories whose detections enter the direct pathway.
        masks = {"all": np.ones_like(features.goal), "goal": features.goal, "none": 0 * features.goal}
        is_direct = masks[self.spec.direct]

        appearance = self.params["appearance"]["embedding"]
        rows = np.hstack([features.visible[:, None] * appearance, features.table])
        parts = [category_maps(self.params["detections"], is_direct[:, None] * rows)]
        if self.spec.goal_row:
            parts.append(category_maps(self.params["detections"], (features.goal * is_direct) @ rows))
        return np.concatenate([*parts, features.goal @ self.params["sought"]["embedding"]])
