"""Adaptation within an episode in plain NumPy, on whole kernels instead of factors."""

from typing import Any

import numpy as np

from support.twin_policy import (
    NUM_ACTIONS,
    Added,
    Memory,
    Params,
    TwinMethod,
    linear,
    one_hot,
    softmax,
    stream,
    with_one,
)
from support.twin_transformer import forward

WINDOW, STEPS = 6, 4  # decisions between inner steps, and inner steps of an episode
LAYERS = ("fuse", "drive", "core", "actor")
TINY = 1e-30  # of a complex step: its square is nothing beside 1


class TwinTentative(TwinMethod):
    """Imitate the tentative policy where the agent was before (`tpn`)."""

    def begin(self) -> None:
        self.been: list[tuple[Any, ...]] = []

    def take(self, seen: Any, percept: Any) -> None:
        step = self.knowledge["steps"][int(percept.heading)]
        before = np.array(self.been[-1][0] if self.been else (0, 0))
        pose = (tuple((before + step * bool(percept.moved)).tolist()), int(percept.heading), int(percept.horizon))
        self.repeated = pose in self.been
        self.been.append(pose)

    def read(self, goal: int) -> bool:
        return self.repeated

    def start(self, params: Params) -> Any:
        return [], np.zeros((params["actor"]["kernel"].shape[0] + 1, NUM_ACTIONS))

    def changes(self, fast: Any) -> Added:
        trials, change = fast
        return {"actor": change * (len(trials) % 50 > 0)}

    def adapt(self, params: Params, parts: list[np.ndarray], before: Memory, decided: Any, reading: Any) -> Any:
        network, (logits, hidden) = params["method"]["tentative"], decided
        change, trials = self.changes(before.fast)["actor"], before.fast[0]
        trial = np.concatenate([forward(network["state"], before.hidden[0]), one_hot(before.action, NUM_ACTIONS)])
        trials = [*trials, trial]
        state = forward(network["state"], hidden)
        scores = np.array([trial[: len(state)] @ state for trial in trials[-100:]]) / np.sqrt(len(state))
        likeliest = np.argsort(-scores)[:10]
        answer = softmax(scores[likeliest]) @ np.array(trials[-100:])[likeliest]
        both = forward(network["both"], np.concatenate([state, forward(network["trial"], answer)]))
        best = one_hot(int(linear(network["expert"], both).argmax()), NUM_ACTIONS)
        if reading:
            change = change + 0.1 * np.outer(with_one(hidden), best - softmax(logits))
        return trials, change


class TwinLearnedSteps(TwinMethod):
    """Descend the learned loss every six decisions (`savn`).

    The gradient of the loss by the outputs of the layers is taken by complex steps, all in one batch.
    """

    def start(self, params: Params) -> Any:
        return [], dict.fromkeys(LAYERS, 0.0)

    def changes(self, fast: Any) -> Added:
        return fast[1]

    def adapt(self, params: Params, parts: list[np.ndarray], before: Memory, decided: Any, reading: Any) -> Any:
        window, changes = before.fast
        window = [*window, (np.concatenate(parts), before.hidden[0])]
        if len(window) % WINDOW or len(window) > STEPS * WINDOW:
            return window, changes
        steps = window[-WINDOW:]
        gradient = self._gradient(params, steps, changes)
        inputs = self._inputs(params, steps, changes)
        step = {layer: 0.01 * inputs[layer].T @ gradient[layer] for layer in LAYERS}
        return window, {layer: changes[layer] - step[layer] for layer in LAYERS}

    def _gradient(self, params: Params, steps: list, changes: Added) -> Added:
        """Return that of the loss by the outputs of the layers, [W, N] each."""
        hidden = len(steps[0][1])
        sizes = np.array([hidden, 3 * hidden, 3 * hidden, NUM_ACTIONS])
        total = WINDOW * sizes.sum()
        moved = 1j * TINY * np.eye(total).reshape(total, WINDOW, -1)
        parts = np.split(moved, np.cumsum(sizes)[:-1], axis=-1)
        rows, state = [], np.broadcast_to(steps[0][1], (total, hidden))
        for time, (inputs, _) in enumerate(steps):
            added = {layer: part[:, time] for layer, part in zip(LAYERS, parts, strict=True)}
            logits, state = stream(params, inputs, state, changes, added)
            rows.append(np.concatenate([state, softmax(logits)], axis=-1))
        loss = _loss(params["method"]["learned_loss"], np.stack(rows, axis=-1))
        gradient = np.split((np.imag(loss) / TINY).reshape(WINDOW, -1), np.cumsum(sizes)[:-1], axis=-1)
        return dict(zip(LAYERS, gradient, strict=True))

    @staticmethod
    def _inputs(params: Params, steps: list, changes: Added) -> Added:
        """Return the inputs of the layers along the window, [W, M] each."""
        found: dict[str, list[np.ndarray]] = {layer: [] for layer in LAYERS}
        state = steps[0][1]
        for inputs, _ in steps:
            entering = with_one(inputs) @ (
                np.vstack([params["fuse"]["kernel"], params["fuse"]["bias"]]) + changes["fuse"]
            )
            after = stream(params, inputs, state, changes, {})[1]
            entered = with_one(inputs), with_one(np.maximum(entering, 0)), state, with_one(after)
            for layer, values in zip(LAYERS, entered, strict=True):
                found[layer].append(values)
            state = after
        return {layer: np.array(values) for layer, values in found.items()}


def _loss(params: Params, entries: np.ndarray) -> np.ndarray:
    """Return the length of two causal convolutions along entries [B, L, W]."""
    for name, distance in (("first", 1), ("second", 2)):
        earlier = np.zeros_like(entries)
        earlier[:, distance:] = entries[:, :-distance]
        values = linear(params[name], np.concatenate([earlier, entries], axis=-1))
        entries = np.where(np.real(values) > 0, values, 0.01 * values)
    return np.sqrt((entries**2).sum(axis=(-2, -1)) + 1e-12)
