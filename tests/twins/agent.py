"""An agent's episode in plain NumPy: perceive, decide, act."""

from typing import NamedTuple

import numpy as np
from twins.perception import TwinBelief, TwinMap, TwinPaperBelief, unpack_cells, unpack_counts, unpack_row
from twins.policy import NUM_ACTIONS, TwinDecision, TwinPolicy

from jaxnav.policies.method import Percept
from jaxnav.scenes.tables.compile import Bank


class TwinTrace(NamedTuple):
    """Layout weights, gap, and the factual and counterfactual decision of one step."""

    layout_weights: np.ndarray
    gap: float
    factual_logits: np.ndarray
    removed_logits: np.ndarray

    def action_logits(self, variant: str, epsilon: float | None, form: str | None) -> tuple[np.ndarray, float]:
        """Return the logits of equation 1 (`tde`) or 2 (`stde`), and the weight of the removed logits."""
        if variant == "tde":
            return self.factual_logits - self.removed_logits, 1.0
        s = 0.0 if epsilon is None else max(self.gap - epsilon, 0.0)
        factual = (1 + s) * self.factual_logits if form == "residual" else self.factual_logits
        return factual - s * self.removed_logits, s


class TwinEpisode:
    """One episode; observation rows and transitions come from the bank."""

    decision: TwinDecision

    def __init__(self, policy: TwinPolicy, bank: Bank, prior: np.ndarray | None, goal: int, pose: int):
        self.policy = policy
        self.bank = bank
        self.goal = goal
        self.pose = pose
        # Rows with instance counts belong to the estimator of the paper.
        self.counts_instances = bank.task.instance_counts
        belief_type = TwinPaperBelief if self.counts_instances else TwinBelief
        self.belief = None if prior is None else belief_type(prior)

        self.map = TwinMap()
        self.memory = policy.initial_memory()
        self.action = NUM_ACTIONS
        self.moved = False
        policy.method.begin()

    def infer(self) -> TwinTrace:
        """Perceive the present view and decide; call this once per step."""
        rules = self.bank.task.rules
        num_categories = len(self.bank.task.categories)
        row = self.bank.rows[self.pose]
        heading = self.pose // len(rules.horizons) % rules.headings
        horizon = self.pose % len(rules.horizons)

        # Features, map and tracker.
        features = unpack_row(row, self.goal, num_categories)
        self.map.update(unpack_cells(row, num_categories), heading, self.moved)
        percept = Percept(
            row,  # type: ignore[arg-type]  (NumPy for JAX)
            heading=np.int32(heading),  # type: ignore[arg-type]
            action=np.int32(self.action),  # type: ignore[arg-type]
            moved=np.bool_(self.moved),  # type: ignore[arg-type]
            horizon=np.int32(horizon),  # type: ignore[arg-type]
            goal=np.int32(self.goal),  # type: ignore[arg-type]
        )
        self.policy.method.update(features, percept)

        # Layout weights and gap.
        layout_weights = np.ones(num_categories)
        gap = 0.0
        if self.belief is not None:
            visible = unpack_counts(row, num_categories) if self.counts_instances else features.visible > 0
            self.belief.update(visible)
            layout_weights = self.belief.weights(self.goal)
            gap = self.belief.gap

        self.decision = self.policy.decide(features, self.map.inputs(), layout_weights, self.memory)
        return TwinTrace(layout_weights, gap, self.decision.factual, self.decision.counterfactual)

    def step(self, action: int) -> None:
        """Take an action after `infer`."""
        poses_per_cell = self.bank.task.rules.poses_per_cell
        next_pose = int(self.bank.successor[self.pose, action])
        self.moved = self.pose // poses_per_cell != next_pose // poses_per_cell
        self.pose = next_pose
        self.memory = self.decision.memory._replace(action=action)
        self.action = action
