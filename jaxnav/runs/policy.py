"""A trained policy that acts on observations, one episode at a time."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import do, stde
from jaxnav.env.objectnav import OTHER_ROOM, prior_index
from jaxnav.env.types import Observation
from jaxnav.errors import InputError
from jaxnav.layout import LayoutEstimator, LayoutState, Setting
from jaxnav.policies.acting import View
from jaxnav.policies.methods import Knowledge, Percept, find_method
from jaxnav.policies.pathways import Decision, Memory
from jaxnav.policies.policy import Params, bind
from jaxnav.policies.spatial_memory import Explored
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.policies import read_export
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import RowFormat


class EpisodeMemory(NamedTuple):
    """Hold what a policy carries through one episode.

    Attributes:
      memory: of the network.
      explored: the map of the spatial memory; None without one.
      layout: the belief about the layout; None where the policy does not use it.
      note: of the method's tracker; None without one.
      room: int32 [], index of the room type's layout prior.
    """

    memory: Memory
    explored: Explored | None
    layout: LayoutState | None
    note: Any
    room: jax.Array


class LoadedPolicy(struct.PyTreeNode):
    """Act on observations.

    A pytree, so that it may be jitted and vmapped.

    Attributes:
      params: of the network.
      knowledge: what was learned before training.
      spec: what the network is built from.
      setting: of the layout estimator; None where the policy does not use the layout.
    """

    params: Params
    knowledge: Knowledge
    spec: PolicySpec = struct.field(pytree_node=False)
    setting: Setting | None = struct.field(pytree_node=False)

    def init(self, room_type: str | None = None) -> EpisodeMemory:
        """Begin an episode.

        Args:
          room_type: `kitchen`, `living_room`, `bedroom` or `bathroom`, which picks the layout prior; None for homes
            and unknown rooms.

        Raises:
          InputError: unknown room type.
        """
        if room_type is not None and room_type not in ROOM_TYPES:
            raise InputError(f"room_type {room_type!r}: choose one of {', '.join(ROOM_TYPES)}, or None")
        room = jnp.int32(OTHER_ROOM if room_type is None else prior_index(room_type))
        tracker = find_method(self.spec.method).tracker
        layout = None if self.setting is None else LayoutEstimator(self.knowledge.layout[room], self.setting).init()
        note = None if tracker is None else tracker.init(self.knowledge)
        explored = None if self.spec.spatial_memory is None else self.spec.spatial_memory.init()
        return EpisodeMemory(bind(self.spec, self.params).initial_memory(), explored, layout, note, room)

    def act(
        self,
        observation: Observation,
        memory: EpisodeMemory,
        epsilon: jax.Array | float = 0.5,
        *,
        key: jax.Array | None = None,
        heading: jax.Array | int | None = None,
        moved: jax.Array | bool | None = None,
    ) -> tuple[jax.Array, EpisodeMemory]:
        """Take in one observation and choose an action.

        Experience is removed by sTDE (eq. 2) where the policy uses the layout.

        Args:
          observation: leaves [...] of one episode.
          memory: from `init`, or from the step before.
          epsilon: threshold of sTDE; may be traced. At 1 or more nothing is removed.
          key: consumed, to sample the action; None for the best action.
          heading: compass heading, and
          moved: whether the last action changed the cell; policies with a spatial memory and methods with a tracker
            need both.

        Returns:
          The action int32 [], and the memory for the next step.

        Raises:
          InputError: heading or moved is needed and missing.
        """
        method, row_format = find_method(self.spec.method), RowFormat(self.spec.num_categories)
        layout, note, weights = memory.layout, memory.note, jnp.ones(self.spec.num_categories)
        if layout is not None and self.setting is not None:
            estimator = LayoutEstimator(self.knowledge.layout[memory.room], self.setting)
            layout = estimator.update(layout, row_format.presence(observation.row))
            weights = estimator.goal_weights(layout, observation.goal)
        reading, surroundings, explored = None, None, memory.explored
        if method.tracker is not None or explored is not None:
            if heading is None or moved is None:
                raise InputError("act: this policy goes by compass and odometry; give `heading` and `moved`")
            percept = Percept(observation.row, jnp.int32(heading), memory.memory.action, jnp.bool_(moved))
            if method.tracker is not None:
                note = method.tracker.update(note, self.knowledge, percept)
                reading = method.tracker.read(note, self.knowledge, observation.goal)
            if self.spec.spatial_memory is not None and explored is not None:
                explored = self.spec.spatial_memory.update(
                    explored, percept.row, percept.heading, percept.moved, row_format
                )
                surroundings = self.spec.spatial_memory.read(explored)
        view = View(observation, weights, reading, surroundings)
        decision, logits = self._decide(view, memory.memory, layout, epsilon)
        choice = jnp.argmax(logits) if key is None else jax.random.categorical(key, logits)
        action = method.control.act(choice.astype(jnp.int32), note)
        return action, EpisodeMemory(decision.memory(action), explored, layout, note, memory.room)

    def _decide(
        self,
        view: View,
        memory: Memory,
        layout: LayoutState | None,
        epsilon: jax.Array | float,
    ) -> tuple[Decision, jax.Array]:
        """Return the factual decision, and logits without experience."""
        policy = bind(self.spec, self.params)
        pathways = policy.pathways(*view, memory)
        decision = policy.decide(pathways, memory)
        if layout is None or self.setting is None:
            return decision, decision.logits
        counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), memory)
        return decision, stde(decision.logits, counterfactual.logits, layout.gap, epsilon, self.setting.form)


def load_policy(path: str | Path) -> LoadedPolicy:
    """Load an exported policy.

    Args:
      path: folder of one policy, such as `runs/rooms/policies/layout-0`.

    Raises:
      InputError: no export there, a damaged one, or one whose method cannot be found.
    """
    policies = read_export(Path(path))
    return LoadedPolicy(policies.params, policies.knowledge, policies.spec, policies.setting)
