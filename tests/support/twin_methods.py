"""What the methods make of a view beside the direct pathways, in plain NumPy.

All but the map and the planner of `semexp`, which are the package's here (tests/policies holds their references).
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.methods import METHODS, Knowledge, Percept
from support.twin_adaptation import TwinLearnedSteps, TwinTentative
from support.twin_percept import Seen
from support.twin_policy import NUM_ACTIONS, Memory, Params, TwinMethod, linear, one_hot, perceptron, relu, softmax
from support.twin_transformer import TwinTransformer


class TwinAnonymous(TwinMethod):
    """Get the goal's own detection, without a name."""

    def perceive(self, seen: Seen) -> Seen:
        goal = int(seen.goal.argmax())
        only = slice(goal, goal + 1)
        return Seen(seen.view, seen.visible[only], seen.table[only], seen.goal[only])


class TwinRelations(TwinMethod):
    """Relate detections (`org`): rows [R^T X | T], each times its weight, through a perceptron."""

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        return self.relate(params, seen, appearance, weights, seen.table)

    def relate(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, table: np.ndarray
    ) -> np.ndarray:
        relation = relu(linear(params["edges"], seen.table)).T
        for kernel in params["mix"]:
            relation = relu(relation @ kernel)
        rows = np.hstack([relation @ (seen.visible[:, None] * appearance), table])
        return perceptron(params["maps"], weights[:, None] * rows)


class TwinZones(TwinRelations):
    """Follow the zones (`hoz`)."""

    def begin(self) -> None:
        graph = self.knowledge
        self.seen = np.zeros(graph["nodes"].shape[-1], bool)
        self.room, self.zone = int(self._odds().argmax()), 0
        self.nodes = graph["nodes"][self.room].copy()

    def take(self, seen: Seen, percept: Any) -> None:
        self.seen |= seen.visible > 0
        room = int(self._odds().argmax())
        if room != self.room:
            self.room, self.nodes = room, self.knowledge["nodes"][room].copy()
        self.zone = int(((seen.visible - self.nodes) ** 2).sum(axis=1).argmin())
        self.nodes[self.zone] += 0.005 * (seen.visible - self.nodes[self.zone])

    def read(self, goal: int) -> tuple[np.ndarray, np.ndarray]:
        graph, sought = self.knowledge, int(self.nodes[:, goal].argmax())
        places = [self.zone, graph["next_zone"][self.room, self.zone, sought], sought]
        return softmax(self._odds()), graph["mixing"][self.room][places] @ self.nodes

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        rooms, zones = reading
        table = np.hstack([seen.table, relu(zones @ params["embed"]["kernel"]).T])
        return np.concatenate([self.relate(params, seen, appearance, weights, table), rooms])

    def _odds(self) -> np.ndarray:
        return self.knowledge["frequency"] + self.knowledge["detected"] @ self.seen.astype(float)


class TwinGraph(TwinMethod):
    """Convolve over the graph of categories (`sp`)."""

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        graph = self.knowledge["mixing"]
        nodes = relu(graph @ (seen.table @ params["seen"]["kernel"] + appearance @ params["named"]["kernel"]))
        nodes = relu(graph @ (nodes @ params["second"]["kernel"]))
        return weights * (graph @ (nodes @ params["third"]["kernel"]))[:, 0]


class TwinAttention(TwinMethod):
    """Attend by cosines to goal, action and memory (`eotp`)."""

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        hidden, maps = memory.hidden[-1], params["maps"]
        rows = linear(maps["inner"], np.hstack([seen.visible[:, None] * appearance, seen.table]))
        asking = (
            seen.goal @ appearance @ params["goal"]["kernel"],
            one_hot(memory.action, NUM_ACTIONS) @ params["action"]["kernel"],
            hidden @ params["memory"]["kernel"],
        )
        query = sum(part * _directed(one) for part, one in zip(linear(params["parts"], hidden), asking, strict=True))
        shown = np.flatnonzero(seen.visible + seen.goal)
        attention = np.zeros(len(rows))
        attention[shown] = softmax(np.array([_directed(rows[i]) @ query for i in shown]))
        values = relu(rows) @ maps["outer"]["kernel"]
        return relu((attention * weights)[:, None] * values + maps["outer"]["bias"]).ravel()


class BorrowedMap(TwinMethod):
    """Read the package's map of the home and follow its planner (`semexp`); the network is twinned."""

    def __init__(self, knowledge: Knowledge):
        method, tracker = METHODS["semexp"], METHODS["semexp"].tracker
        assert tracker is not None
        self.init = functools.partial(tracker.init, knowledge)
        self.update = jax.jit(lambda note, percept: tracker.update(note, knowledge, percept))
        self.reading = jax.jit(lambda note, goal: tracker.read(note, knowledge, goal))
        self.control = jax.jit(lambda choice, note: method.control.act(choice, note, knowledge))

    def begin(self) -> None:
        self.note = self.init()

    def take(self, seen: Seen, percept: Percept) -> None:
        self.note = self.update(self.note, percept)

    def read(self, goal: int) -> Any:
        return jax.tree.map(np.asarray, self.reading(self.note, jnp.int32(goal)))

    def surroundings(self, reading: Any) -> np.ndarray:
        flags = [(reading.blocks >> bit & 1).astype(float) for bit in (27, 28, 29, 30)]
        return np.concatenate([*flags, reading.compass])

    def encode(
        self, params: Params, seen: Seen, appearance: np.ndarray, weights: np.ndarray, reading: Any, memory: Memory
    ) -> np.ndarray:
        blocks = []
        for bits in reading.blocks.tolist():
            inside = [k for k in range(len(weights)) if bits >> k & 1]
            blocks.append(np.concatenate([weights[inside] @ appearance[inside], seen.goal @ appearance]))
        return relu(linear(params["relate"], np.array(blocks))).ravel()

    def act(self, choice: int) -> int:
        action, self.note = self.control(jnp.int32(choice), self.note)
        return int(action)


def _directed(vector: np.ndarray) -> np.ndarray:
    return vector / math.sqrt((vector**2).sum() + 1e-12)


class TwinTentativeRelations(TwinTentative, TwinRelations):
    """Relate as `org`, and adapt (`tpn`)."""


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
