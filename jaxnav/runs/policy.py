"""A trained policy that acts on observations, one episode at a time."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import Form, do, stde
from jaxnav.env.objectnav import OTHER_ROOM, prior_index
from jaxnav.env.types import Observation
from jaxnav.errors import InputError
from jaxnav.layout import LayoutState, Setting
from jaxnav.policies.methods import Knowledge, Percept, find_method
from jaxnav.policies.pathways import Decision, Memory
from jaxnav.policies.perception import Perceived, Perception, View
from jaxnav.policies.policy import Params, bind
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.policies import EstimatorName, read_export
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import RowFormat


class EpisodeMemory(NamedTuple):
    """Hold what a policy carries through one episode.

    Attributes:
      memory: of the network.
      perceived: belief, map and note.
      room: int32 [], index of the room type's layout prior.
    """

    memory: Memory
    perceived: Perceived
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
        return EpisodeMemory(
            bind(self.spec, self.params).initial_memory(), self._perception.init(self.knowledge, room), room
        )

    def act(
        self,
        observation: Observation,
        memory: EpisodeMemory,
        epsilon: jax.Array | float = 0.5,
        *,
        key: jax.Array | None = None,
        heading: jax.Array | int | None = None,
        moved: jax.Array | bool | None = None,
        horizon: jax.Array | int = 0,
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
          horizon: index of the camera's horizon, 0 for level; `tpn` and `semexp` go by it too.

        Returns:
          The action int32 [], and the memory for the next step.

        Raises:
          InputError: heading or moved is needed and missing.
        """
        perception = self._perception
        if perception.uses_odometry and (heading is None or moved is None):
            raise InputError("act: this policy goes by compass and odometry; give `heading` and `moved`")
        odometry = jnp.int32(0 if heading is None else heading), jnp.bool_(moved is not None and moved)
        position = odometry[0], memory.memory.action, odometry[1], jnp.int32(horizon)
        percept = Percept(observation.row, *position, observation.goal)
        perceived = perception.update(memory.perceived, percept, self.knowledge, memory.room)
        view = perception.view(perceived, observation, self.knowledge)
        decision, logits = self._decide(view, memory.memory, perceived.layout, epsilon)
        choice = jnp.argmax(logits) if key is None else jax.random.categorical(key, logits)
        control = find_method(self.spec.method).control
        action, note = control.act(choice.astype(jnp.int32), perceived.note, self.knowledge)
        return action, EpisodeMemory(decision.memory(action), perceived._replace(note=note), memory.room)

    @property
    def _perception(self) -> Perception:
        return Perception(RowFormat(self.spec.num_categories), self.spec, self.setting)

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


def load_policy(
    path: str | Path, setting: EstimatorName | None = None, hold: bool = False, form: Form | None = None
) -> LoadedPolicy:
    """Load an exported policy.

    Args:
      path: folder of one policy, such as `runs/rooms/policies/layout-0`.
      setting, hold: layout estimator to use instead of the policy's; see `Policies.estimating`.
      form: how sTDE combines the logits; None for that of the layout setting.

    Raises:
      InputError: no export there, a damaged one, one whose method cannot be found, or an impossible setting.
    """
    policies = read_export(Path(path)).estimating(setting, hold)
    layout = policies.setting
    if layout is not None and form is not None:
        layout = dataclasses.replace(layout, form=form)
    return LoadedPolicy(policies.params, policies.knowledge, policies.spec, layout)
