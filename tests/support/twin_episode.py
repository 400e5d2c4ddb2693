"""An agent's episode in plain NumPy: look, believe, decide, go on."""

from typing import NamedTuple

import numpy as np

from jaxnav.policies.methods import Percept
from jaxnav.scenes.tables.compile import Bank
from support.twin_percept import TwinBelief, TwinMap, cells_of, look
from support.twin_policy import NUM_ACTIONS, Decided, TwinPolicy


class TwinInferred(NamedTuple):
    """Hold the weights of the layout, the gap and both decisions at one step."""

    layout: np.ndarray
    gap: float
    factual: np.ndarray
    counterfactual: np.ndarray

    def corrected(self, variant: str, epsilon: float | None, form: str | None) -> tuple[np.ndarray, float]:
        """Return what equations 1 (`tde`) and 2 (`stde`) leave, and the weight of what they remove."""
        if variant == "tde":
            return self.factual - self.counterfactual, 1.0
        s = 0.0 if epsilon is None else max(self.gap - epsilon, 0.0)
        return (1 + s * (form == "residual")) * self.factual - s * self.counterfactual, s


class TwinEpisode:
    """Hold one episode; its rows of bytes and where actions lead are the bank's."""

    decided: Decided

    def __init__(self, policy: TwinPolicy, bank: Bank, prior: np.ndarray | None, goal: int, pose: int):
        self.policy, self.bank, self.goal, self.pose = policy, bank, goal, pose
        self.belief = None if prior is None else TwinBelief(prior)
        self.map, self.memory = TwinMap(), policy.memory()
        self.action, self.moved = NUM_ACTIONS, False
        policy.method.begin()

    def infer(self) -> TwinInferred:
        """Take in the present view, once, and decide."""
        rules, size = self.bank.task.rules, len(self.bank.task.categories)
        row, horizons = self.bank.rows[self.pose], len(rules.horizons)
        heading, horizon = self.pose // horizons % rules.headings, self.pose % horizons
        seen = look(row, self.goal, size)
        self.map.update(cells_of(row, size), heading, self.moved)
        numbers = np.int32(heading), np.int32(self.action), np.bool_(self.moved), np.int32(horizon), np.int32(self.goal)
        self.policy.method.take(seen, Percept(row, *numbers))  # type: ignore[arg-type]  (NumPy for JAX)
        layout, gap = np.ones(size), 0.0
        if self.belief is not None:
            self.belief.update(seen.visible > 0)
            layout, gap = self.belief.weights(self.goal), self.belief.gap
        self.decided = self.policy.decide(seen, self.map.inputs(), layout, self.memory)
        return TwinInferred(layout, gap, self.decided.factual, self.decided.counterfactual)

    def go_on(self, action: int) -> None:
        """Take an action after `infer`."""
        self.memory, self.action = self.decided.memory._replace(action=action), action
        before, self.pose = self.pose, int(self.bank.successor[self.pose, action])
        self.moved = before // self.bank.task.rules.poses_per_cell != self.pose // self.bank.task.rules.poses_per_cell
