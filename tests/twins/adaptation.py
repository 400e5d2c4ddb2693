"""Adaptation within an episode in plain NumPy, with changes of full kernels instead of products of low rank."""

from typing import Any

import numpy as np
from twins.policy import (
    NUM_ACTIONS,
    LayerChanges,
    Params,
    TwinMemory,
    TwinMethod,
    append_one,
    kernel_with_bias,
    linear,
    one_hot,
    relu,
    run_stream,
    softmax,
)
from twins.transformer import residual_perceptron

#: Settings of `savn` in docs/methods.md: decisions between inner steps, inner steps of an episode, and their step size.
WINDOW = 6
NUM_STEPS = 4
INNER_LEARNING_RATE = 0.01
#: Settings of `tpn` in docs/methods.md: trials that a state attends to, trials in the memory, decisions between resets
#: of the actor's change, and the step size of this change.
NUM_ATTENDED = 10
NUM_TRIALS = 100
NUM_DECISIONS_BETWEEN_RESETS = 50
ACTOR_LEARNING_RATE = 0.1
LAYERS = ("fuse", "input_gates", "hidden_gates", "actor")
STEP_SIZE = 1e-30  # of a complex step, so small that its square vanishes beside 1


class TwinTentative(TwinMethod):
    """Imitation of the tentative policy at poses where the agent was before (`tpn`)."""

    def begin(self) -> None:
        self.poses: list[tuple[Any, ...]] = []

    def update(self, features: Any, percept: Any) -> None:
        step = self.knowledge["steps"][int(percept.heading)]
        last_cell = np.array(self.poses[-1][0] if self.poses else (0, 0))
        cell = tuple((last_cell + step * bool(percept.moved)).tolist())
        pose = (cell, int(percept.heading), int(percept.horizon))
        self.is_repeated = pose in self.poses
        self.poses.append(pose)

    def read(self, goal: int) -> bool:
        return self.is_repeated

    def initial_fast(self, params: Params) -> Any:
        """Return the states and actions of the episode, initially none, and the change of the actor's kernel."""
        return [], [], np.zeros((params["actor"]["kernel"].shape[0] + 1, NUM_ACTIONS))

    def layer_changes(self, fast: Any) -> LayerChanges:
        states, _, change = fast
        return {"actor": change * (len(states) % NUM_DECISIONS_BETWEEN_RESETS > 0)}

    def adapt(
        self,
        params: Params,
        inputs: np.ndarray,
        memory: TwinMemory,
        logits: np.ndarray,
        hidden: np.ndarray,
        reading: Any,
    ) -> Any:
        network = params["method"]["tentative"]
        change = self.layer_changes(memory.fast)["actor"]

        # All states of the episode up to the present state, and the actions between them.
        state = residual_perceptron(network["state"], hidden)
        states = [*memory.fast[0], state]
        actions = list(memory.fast[1])
        if memory.action < NUM_ACTIONS:
            actions.append(memory.action)

        # Read the ten trials, of the last hundred, whose first states are most like the present state.
        answer = np.zeros(len(state) + NUM_ACTIONS)
        if actions:
            keys, values = self.trials(states, actions)
            scores = self.scores(keys[-NUM_TRIALS:], state)
            best_trials = np.argsort(-scores)[:NUM_ATTENDED]
            answer = softmax(scores[best_trials]) @ values[-NUM_TRIALS:][best_trials]

        # The tentative policy names the expert's action.
        experience = residual_perceptron(network["trial"], answer)
        expert_inputs = residual_perceptron(network["both"], np.concatenate([state, experience]))
        expert_action = one_hot(int(linear(network["expert"], expert_inputs).argmax()), NUM_ACTIONS)

        # At a repeated pose, the policy moves towards this action.
        if reading:
            change = change + ACTOR_LEARNING_RATE * np.outer(append_one(hidden), expert_action - softmax(logits))
        return states, actions, change

    def trials(self, states: list[np.ndarray], actions: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return keys s_i and values [s_{i+1}, a_i] of all trials, as the released `states_rep` and memories."""
        keys = np.array(states[:-1])
        action_rows = np.eye(NUM_ACTIONS)[actions]
        return keys, np.hstack([np.array(states[1:]), action_rows])

    def scores(self, keys: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return the dot products of the keys with the present state."""
        return keys @ state


class TwinLearnedSteps(TwinMethod):
    """Descent of the learned loss every six decisions (`savn`).

    Complex steps, all in one batch, compute the gradient of the loss with respect to the outputs of the layers.
    """

    def initial_fast(self, params: Params) -> Any:
        """Return the steps of the episode, initially none, and the changes of the layers."""
        return [], dict.fromkeys(LAYERS, 0.0)

    def layer_changes(self, fast: Any) -> LayerChanges:
        return fast[1]

    def adapt(
        self,
        params: Params,
        inputs: np.ndarray,
        memory: TwinMemory,
        logits: np.ndarray,
        hidden: np.ndarray,
        reading: Any,
    ) -> Any:
        steps, changes = memory.fast
        steps = [*steps, (inputs, memory.hidden[0])]
        if len(steps) % WINDOW or len(steps) > NUM_STEPS * WINDOW:
            return steps, changes

        # After a full window, take one step down the gradient of the loss.
        window = steps[-WINDOW:]
        gradient = self._output_gradient(params, window, changes)
        layer_inputs = self._layer_inputs(params, window, changes)
        next_changes = {}
        for layer in LAYERS:
            next_changes[layer] = changes[layer] - INNER_LEARNING_RATE * layer_inputs[layer].T @ gradient[layer]
        return steps, next_changes

    def _output_gradient(self, params: Params, window: list, changes: LayerChanges) -> LayerChanges:
        """Return the gradient of the loss with respect to the outputs of the layers, [W, N] each."""
        # The batch has a member for each output of each layer at each decision, and changes it by a complex step.
        num_hidden = len(window[0][1])
        widths = np.array([num_hidden, 3 * num_hidden, 3 * num_hidden, NUM_ACTIONS])
        layer_ends = np.cumsum(widths)[:-1]
        batch_size = WINDOW * widths.sum()
        complex_steps = 1j * STEP_SIZE * np.eye(batch_size).reshape(batch_size, WINDOW, -1)
        layer_steps = np.split(complex_steps, layer_ends, axis=-1)

        # Run the window again with the steps added to the outputs.
        entries = []
        state = np.broadcast_to(window[0][1], (batch_size, num_hidden))
        for time, (inputs, _) in enumerate(window):
            output_changes = {layer: step[:, time] for layer, step in zip(LAYERS, layer_steps, strict=True)}
            logits, state = run_stream(params, inputs, state, changes, output_changes)
            entries.append(np.concatenate([state, softmax(logits)], axis=-1))

        # The imaginary part of the loss is the derivative times the size of the step.
        loss = _learned_loss(params["method"]["learned_loss"], np.stack(entries, axis=-1))
        gradient = (np.imag(loss) / STEP_SIZE).reshape(WINDOW, -1)
        return dict(zip(LAYERS, np.split(gradient, layer_ends, axis=-1), strict=True))

    @staticmethod
    def _layer_inputs(params: Params, window: list, changes: LayerChanges) -> LayerChanges:
        """Return the inputs of the layers along the window, [W, M] each."""
        fuse_kernel = kernel_with_bias(params["fuse"]) + changes["fuse"]
        by_layer: dict[str, list[np.ndarray]] = {layer: [] for layer in LAYERS}
        state = window[0][1]
        for inputs, _ in window:
            fused = relu(append_one(inputs) @ fuse_kernel)
            next_state = run_stream(params, inputs, state, changes, {})[1]
            by_layer["fuse"].append(append_one(inputs))
            by_layer["input_gates"].append(append_one(fused))
            by_layer["hidden_gates"].append(state)
            by_layer["actor"].append(append_one(next_state))
            state = next_state
        return {layer: np.array(values) for layer, values in by_layer.items()}


def _learned_loss(params: Params, entries: np.ndarray) -> np.ndarray:
    """Return the Euclidean norm of two causal convolutions along entries [B, L, W], which is [B]."""
    for name, distance in (("first", 1), ("second", 2)):
        shifted_entries = np.zeros_like(entries)
        shifted_entries[:, distance:] = entries[:, :-distance]
        values = linear(params[name], np.concatenate([shifted_entries, entries], axis=-1))
        entries = np.where(np.real(values) > 0, values, 0.01 * values)
    return np.sqrt((entries**2).sum(axis=(-2, -1)) + 1e-12)
