"""A trained policy that acts on observations, one episode at a time."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import Form, do, stde
from jaxnav.env.objectnav import OTHER_ROOM, ObjectNav, prior_index
from jaxnav.env.types import Observation
from jaxnav.errors import InputError
from jaxnav.layout import Setting
from jaxnav.policies.methods import Knowledge, Percept, find_method
from jaxnav.policies.pathways import Decision, Memory
from jaxnav.policies.perception import Perceived, Perception
from jaxnav.policies.policy import Params, bind
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.packaged import policy_folder
from jaxnav.runs.policies import EstimatorName, read_export
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from jaxnav.store.manifest import differences


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


class Deliberation(NamedTuple):
    """Hold what a policy makes of one observation.

    Attributes:
      logits: float32 [C], by which it chooses: of eq. 2 where the policy uses the layout, else the factual ones.
      factual: float32 [C], a.
      counterfactual: float32 [C], a_bar; None where the policy does not use the layout.
      gap: float32 [], D; None there too.
      weights: float32 [K], w x g of eq. 7; None there too.
      perceived: belief, map and note with this view.
      decision: the factual one, for the memory after an action.
    """

    logits: jax.Array
    factual: jax.Array
    counterfactual: jax.Array | None
    gap: jax.Array | None
    weights: jax.Array | None
    perceived: Perceived
    decision: Decision


class LoadedPolicy(struct.PyTreeNode):
    """Act on observations.

    A pytree, so that it may be jitted and vmapped.

    Attributes:
      params: of the network.
      knowledge: what was learned before training.
      spec: what the network is built from.
      setting: of the layout estimator; None where the policy does not use the layout.
      task: that the policy was trained for.
    """

    params: Params
    knowledge: Knowledge
    spec: PolicySpec = struct.field(pytree_node=False)
    setting: Setting | None = struct.field(pytree_node=False)
    task: Task = struct.field(pytree_node=False)

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
        return self.begin(jnp.int32(OTHER_ROOM if room_type is None else prior_index(room_type)))

    def begin(self, room: jax.Array) -> EpisodeMemory:
        """Begin an episode in a room type int32 [], an index of layout priors."""
        memory = bind(self.spec, self.params).initial_memory()
        return EpisodeMemory(memory, self._perception.init(self.knowledge, room), room)

    def act(
        self,
        observation: Observation,
        memory: EpisodeMemory,
        epsilon: jax.Array | float = 0.5,
        *,
        key: jax.Array | None = None,
        heading: jax.Array | int | None = None,
        moved: jax.Array | bool | None = None,
        horizon: jax.Array | int | None = None,
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
          horizon: index of the camera's horizon, 0 for level; methods with a tracker need it too.

        Returns:
          The action int32 [], and the memory for the next step.

        Raises:
          InputError: heading, moved or horizon is needed and missing.
        """
        made = self.decide(observation, memory, epsilon, heading=heading, moved=moved, horizon=horizon)
        chosen = jnp.argmax(made.logits) if key is None else jax.random.categorical(key, made.logits)
        return self.follow(made, chosen.astype(jnp.int32), memory.room)

    def follow(self, made: Deliberation, chosen: jax.Array, room: jax.Array) -> tuple[jax.Array, EpisodeMemory]:
        """Return the action int32 [] of what was chosen, and the memory."""
        control, perceived = find_method(self.spec.method).control, made.perceived
        action, note = control.act(chosen, perceived.note, self.knowledge)
        return action, EpisodeMemory(made.decision.memory(action), perceived._replace(note=note), room)

    def decide(
        self,
        observation: Observation,
        memory: EpisodeMemory,
        epsilon: jax.Array | float = 0.5,
        *,
        heading: jax.Array | int | None = None,
        moved: jax.Array | bool | None = None,
        horizon: jax.Array | int | None = None,
    ) -> Deliberation:
        """Take in one observation; see `act`.

        Raises:
          InputError: heading, moved or horizon is needed and missing.
        """
        perception = self._perception
        if perception.uses_odometry and (heading is None or moved is None):
            raise InputError("act: this policy goes by compass and odometry; give `heading` and `moved`")
        if perception.tracker is not None and horizon is None:
            raise InputError("act: this policy's method follows the camera too; give `horizon`")
        odometry = jnp.int32(0 if heading is None else heading), jnp.bool_(moved is not None and moved)
        position = odometry[0], memory.memory.action, odometry[1], jnp.int32(0 if horizon is None else horizon)
        percept = Percept(observation.row, *position, observation.goal)
        perceived = perception.update(memory.perceived, percept, self.knowledge, memory.room)
        view = perception.view(perceived, observation, self.knowledge)
        policy = bind(self.spec, self.params)
        pathways = policy.pathways(*view, memory.memory)
        decision = policy.decide(pathways, memory.memory)
        layout, setting = perceived.layout, self.setting
        if layout is None or setting is None:
            return Deliberation(decision.logits, decision.logits, None, None, None, perceived, decision)
        removed = policy.decide(do(pathways, scene=0.0, goal=0.0), memory.memory).logits
        logits = stde(decision.logits, removed, layout.gap, epsilon, setting.form)
        return Deliberation(logits, decision.logits, removed, layout.gap, view.weights, perceived, decision)

    @property
    def _perception(self) -> Perception:
        return Perception(RowFormat(self.spec.num_categories), self.spec, self.setting)


def load_policy(
    path: str | Path,
    setting: EstimatorName | None = None,
    hold: bool = False,
    form: Form | None = None,
    env: ObjectNav | None = None,
) -> LoadedPolicy:
    """Load an exported policy.

    Args:
      path: folder of one policy, such as `runs/rooms/policies/layout-0`; or the name of one that comes with the
        package: `rooms-org`.
      setting, hold: layout estimator to use instead of the policy's; see `Policies.estimating`.
      form: how sTDE combines the logits; None for that of the layout setting.
      env: the environment that it is to act in; None leaves it unchecked.

    Raises:
      InputError: no export there, a damaged one, one whose method cannot be found, an impossible setting, or one
        trained with other categories or rules than those of `env`.
    """
    policies = read_export(policy_folder(path)).estimating(setting, hold)
    layout = policies.setting
    if layout is not None and form is not None:
        layout = dataclasses.replace(layout, form=form)
    if env is not None:
        _check_task(path, policies.task, env.task)
    return LoadedPolicy(policies.params, policies.knowledge, policies.spec, layout, policies.task)


def _check_task(path: str | Path, trained: Task, asked: Task) -> None:
    """Check that what a policy learned to see and do is asked of it.

    Goals and the detector's errors may differ.
    """
    there, here = (
        {"categories": task.categories, "rules": dataclasses.asdict(task.rules)} for task in (trained, asked)
    )
    if different := differences(there, here):
        raise InputError(
            f"{path}: was trained for another task than that of env (there != here): {'; '.join(different)}; "
            "make one for this task: jaxnav.make(..., task=jaxnav.load_policy(...).task)"
        )
