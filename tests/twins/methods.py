"""The experience of every method in plain NumPy.

The map and the planner of `semexp` have no twin: `BorrowedMap` uses those of the package, and tests/policies compares
them with references.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from twins.adaptation import TwinLearnedSteps, TwinTentative
from twins.perception import TwinFeatures
from twins.policy import (
    NUM_ACTIONS,
    Params,
    TwinMemory,
    TwinMethod,
    category_maps,
    linear,
    one_hot,
    relu,
    softmax,
)
from twins.transformer import TwinTransformer

from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.methods import METHODS

#: Rate of `hoz` in docs/methods.md at which a view moves the node of its zone.
NODE_RATE = 0.005


class TwinAnonymous(TwinMethod):
    """The detection of the goal alone, without the category's name (`anonymous`)."""

    def perceive(self, features: TwinFeatures) -> TwinFeatures:
        goal = int(features.goal.argmax())
        goal_row = slice(goal, goal + 1)
        return TwinFeatures(
            features.view, features.visible[goal_row], features.table[goal_row], features.goal[goal_row]
        )


class TwinRelations(TwinMethod):
    """Object relations (`org`), as the released code states them.

    info = relu(L1([info | indicator])).T, info = relu(L2(info)) for each layer, appear = (appear.T @ info).T; w g
    multiplies the rows [appear | info | indicator], which a perceptron reads.
    """

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        return self.relate(params, features, appearance, weights, features.table)

    def relate(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        table: np.ndarray,
    ) -> np.ndarray:
        """Return the maps of the rows [R^T X | table], each times its weight."""
        relations = self.relations(params, features)
        visible_appearance = features.visible[:, None] * appearance
        related_appearance = self.aggregate(relations, visible_appearance)
        weighted_rows = self.weigh(weights, np.hstack([related_appearance, table]))
        return category_maps(params["maps"], weighted_rows)

    def relations(self, params: Params, features: TwinFeatures) -> np.ndarray:
        """Return R [K, K], mixed over the categories of the second axis."""
        relations = relu(linear(params["edges"], features.table)).T
        for kernel in params["mix"]:
            relations = relu(relations @ kernel)
        return relations

    def aggregate(self, relations: np.ndarray, appearance: np.ndarray) -> np.ndarray:
        """Return the related appearances (X^T R)^T, [K, d]."""
        return (appearance.T @ relations).T

    def weigh(self, weights: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the rows times w g, equation 7."""
        return np.diag(weights) @ rows


class TwinZones(TwinRelations):
    """Zones of rooms (`hoz`)."""

    def begin(self) -> None:
        graph = self.knowledge
        self.detected = np.zeros(graph["nodes"].shape[-1], bool)
        self.room = int(self._room_log_odds().argmax())
        self.zone = 0
        self.nodes = graph["nodes"][self.room].copy()

    def update(self, features: TwinFeatures, percept: Any) -> None:
        # The likeliest room. When it changes, the zones start again from those learned before training.
        self.detected |= features.visible > 0
        room = int(self._room_log_odds().argmax())
        if room != self.room:
            self.room = room
            self.nodes = self.knowledge["nodes"][room].copy()

        # The zone that is most like the view moves a little towards it.
        self.zone = int(((features.visible - self.nodes) ** 2).sum(axis=1).argmin())
        self.nodes[self.zone] += NODE_RATE * (features.visible - self.nodes[self.zone])

    def read(self, goal: int) -> tuple[np.ndarray, np.ndarray]:
        graph = self.knowledge
        goal_zone = int(self.nodes[:, goal].argmax())
        next_zone = graph["next_zone"][self.room, self.zone, goal_zone]
        zones = [self.zone, next_zone, goal_zone]
        return softmax(self._room_log_odds()), graph["mixing"][self.room][zones] @ self.nodes

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        rooms, zones = reading
        table = np.hstack([features.table, relu(zones @ params["embed"]["kernel"]).T])
        return np.concatenate([self.relate(params, features, appearance, weights, table), rooms])

    def _room_log_odds(self) -> np.ndarray:
        return self.knowledge["frequency"] + self.knowledge["detected"] @ self.detected.astype(float)


class TwinGraph(TwinMethod):
    """Convolutions over the graph of categories (`sp`)."""

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        graph = self.knowledge["mixing"]
        detections = features.table @ params["seen"]["kernel"]
        nodes = relu(graph @ (detections + appearance @ params["named"]["kernel"]))
        nodes = relu(graph @ (nodes @ params["second"]["kernel"]))
        return weights * (graph @ (nodes @ params["third"]["kernel"]))[:, 0]


class TwinAttention(TwinMethod):
    """Attention by cosines; goal, action and memory make the query (`eotp`)."""

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        hidden = memory.hidden[-1]
        maps = params["maps"]
        rows = linear(maps["inner"], np.hstack([features.visible[:, None] * appearance, features.table]))

        # The query mixes the directions of goal, previous action and memory.
        goal_part = features.goal @ appearance @ params["goal"]["kernel"]
        action_part = one_hot(memory.action, NUM_ACTIONS) @ params["action"]["kernel"]
        memory_part = hidden @ params["memory"]["kernel"]
        shares = linear(params["parts"], hidden)
        query = np.zeros_like(goal_part)
        for share, part in zip(shares, (goal_part, action_part, memory_part), strict=True):
            query += share * _direction(part)

        # Attention over the goal and the visible categories, by cosines.
        key_categories = np.flatnonzero(features.visible + features.goal)
        scores = [_direction(rows[category]) @ query for category in key_categories]
        attention = np.zeros(len(rows))
        attention[key_categories] = softmax(np.array(scores))

        values = relu(rows) @ maps["outer"]["kernel"]
        return relu((attention * weights)[:, None] * values + maps["outer"]["bias"]).ravel()


class BorrowedMap(TwinMethod):
    """Map and planner of the package with a twin of the network (`semexp`)."""

    def __init__(self, knowledge: Knowledge):
        method = METHODS["semexp"]
        tracker = method.tracker
        assert tracker is not None
        self.init_state = functools.partial(tracker.init, knowledge)
        self.update_state = jax.jit(lambda state, percept: tracker.update(state, knowledge, percept))
        self.read_state = jax.jit(lambda state, goal: tracker.read(state, knowledge, goal))
        self.control = jax.jit(lambda choice, state: method.control.act(choice, state, knowledge))

    def begin(self) -> None:
        self.state = self.init_state()

    def update(self, features: TwinFeatures, percept: Percept) -> None:
        self.state = self.update_state(self.state, percept)

    def read(self, goal: int) -> Any:
        return jax.tree.map(np.asarray, self.read_state(self.state, jnp.int32(goal)))

    def scene_inputs(self, reading: Any) -> np.ndarray:
        flags = [(reading.blocks >> bit & 1).astype(float) for bit in (27, 28, 29, 30)]
        return np.concatenate([*flags, reading.compass])

    def encode(
        self,
        params: Params,
        features: TwinFeatures,
        appearance: np.ndarray,
        weights: np.ndarray,
        reading: Any,
        memory: TwinMemory,
    ) -> np.ndarray:
        # Each block holds the sum of the weighted appearances of its categories, and the appearance of the goal.
        goal_appearance = features.goal @ appearance
        blocks = []
        for bits in reading.blocks.tolist():
            categories = [k for k in range(len(weights)) if bits >> k & 1]
            blocks.append(np.concatenate([weights[categories] @ appearance[categories], goal_appearance]))
        return relu(linear(params["relate"], np.array(blocks))).ravel()

    def act(self, choice: int) -> int:
        action, self.state = self.control(jnp.int32(choice), self.state)
        return int(action)


def _direction(vector: np.ndarray) -> np.ndarray:
    """Return the unit vector in the direction of a vector."""
    return vector / math.sqrt((vector**2).sum() + 1e-12)


class TwinTentativeRelations(TwinTentative, TwinRelations):
    """Relations as in `org`, with adaptation (`tpn`)."""


TWINS: dict[str, type[TwinMethod]] = {
    "anonymous": TwinAnonymous,
    "eotp": TwinAttention,
    "hoz": TwinZones,
    "org": TwinRelations,
    "rgb": TwinMethod,
    "savn": TwinLearnedSteps,
    "semexp": BorrowedMap,
    "sp": TwinGraph,
    "tpn": TwinTentativeRelations,
    "vtnet": TwinTransformer,
}
