"""The agent's step, the one way in which episodes are acted."""

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, State
from jaxnav.layout import Setting
from jaxnav.policies.adaptation import limited
from jaxnav.policies.methods import Knowledge, Method, Percept, find_method
from jaxnav.policies.pair import Decider, Pair
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory
from jaxnav.policies.perception import Perceived, Perception, View
from jaxnav.policies.policy import Params, Policy, bind
from jaxnav.policies.spec import PolicySpec

Tree = TypeVar("Tree")


class Agent(NamedTuple):
    """Hold B parallel episodes and what their agents carry.

    Attributes:
      state: the episodes, leaves [B].
      perceived: beliefs, maps and notes, leaves [B, ...].
      memory: the policy's memories, leaves [B, ...]; None where no policy acts.
    """

    state: State
    perceived: Perceived
    memory: Memory | None


class Taken(NamedTuple):
    """Hold what came of one step, leaves [B, ...].

    Attributes:
      reward: float32.
      terminated: bool, Done was chosen.
      truncated: bool, the step limit was reached.
      success: bool, Done was chosen where it succeeds.
      moved: bool, the cell was changed.
      agent: after the action and before a reset, the last view not yet taken in.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array
    moved: jax.Array
    agent: Agent

    @property
    def ended(self) -> jax.Array:
        """Return which episodes ended, bool [B]."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True)
class Acting:
    """Say how episodes are acted; hashable.

    Attributes:
      env: the environment.
      spec: of the policy; None where actions are given.
      setting: of the layout estimator; None leaves the layout out.
      inner_steps: by which the method's adaptation may change the policy in an episode; 0: none, None: as usual.
      without: spec of a policy without experience that is handed over to; None without one.
    """

    env: ObjectNav
    spec: PolicySpec | None = None
    setting: Setting | None = None
    inner_steps: int | None = None
    without: PolicySpec | None = None

    @property
    def method(self) -> Method | None:
        """Return the policy's method."""
        return None if self.spec is None else find_method(self.spec.method)

    def bind(self, params: Params) -> Policy:
        """Bind parameters to the policy."""
        if self.spec is None:
            raise ValueError("Acting without a spec has no policy to bind; give one")
        policy = bind(self.spec, params)
        if self.inner_steps is not None:
            policy.adaptation = limited(policy.adaptation, self.inner_steps)
        return policy

    def decider(self, params: Params) -> Decider:
        """Return what decides: the policy, or the pair of it and another.

        Args:
          params: of the policy; of a pair {"agent": ..., "without": ...}.
        """
        if self.without is None:
            return self.bind(params)
        return Pair(self.bind(params["agent"]), bind(self.without, params["without"]))

    def view(self, agent: Agent, knowledge: Knowledge | None, params: EnvParams) -> View:
        """Return what the policy gets in the present states."""
        observation = jax.vmap(self.env.observe, (0, None))(agent.state, params)
        return jax.vmap(self._perception.view, (0, 0, None))(agent.perceived, observation, knowledge)

    def gap(self, agent: Agent) -> jax.Array:
        """Return the layout gaps D, float32 [B].

        They are 0 without the layout.
        """
        layout = agent.perceived.layout
        return jnp.zeros(agent.state.goal.shape) if layout is None else layout.gap

    def start(self, key: jax.Array, count: int, memory: Memory | None, knowledge: Any, params: EnvParams) -> Agent:
        """Start episodes at random; the key is consumed.

        Args:
          key: typed PRNG key.
          count: B, number of episodes.
          memory: at the start, leaves [B, ...]; see `Policy.initial_memory`.
          knowledge: what was learned before training; None where neither layout nor tracker is used.
          params: the environment's.
        """
        _, state = jax.vmap(self.env.reset, (0, None))(jax.random.split(key, count), params)
        return self.begin(state, memory, knowledge, params)

    def begin(self, state: State, memory: Memory | None, knowledge: Any, params: EnvParams) -> Agent:
        """Begin episodes in given states.

        The leaves of the states are [B]; the first view is taken in.
        """
        action, moved = jnp.full(state.pose.shape, NO_ACTION, jnp.int32), jnp.zeros(state.pose.shape, bool)
        return self.perceive(self._fresh(state, memory, knowledge, params), action, moved, knowledge, params)

    def step(
        self,
        agent: Agent,
        choice: jax.Array,
        knowledge: Knowledge | None,
        params: EnvParams,
        *,
        policy: Decider | None = None,
        decision: Decision | None = None,
        keys: jax.Array | None = None,
    ) -> tuple[Agent, Taken]:
        """Act once in every episode; beliefs and notes follow.

        Args:
          agent: the episodes, [B].
          choice: int32 [B], what was chosen; an action unless the method has a control of its own.
          knowledge: what was learned before training; None where neither layout nor tracker is used.
          params: the environment's.
          policy, decision: that chose, and what it decided; None where actions are given.
          keys: [B], of the episodes that follow those that end (same-step auto-reset); without, an episode goes on.

        Returns:
          The agent after the step, in a new episode where one ended and keys are given, and what came of it.
        """
        action, agent = self._controlled(agent, choice, knowledge)
        last, reward, terminated, truncated, success, state = self._act(agent.state, action, keys, params)
        moved = self.env.cell(last.pose) != self.env.cell(agent.state.pose)
        memory = None if decision is None else decision.memory(action)
        before_reset = agent._replace(state=last, memory=memory)
        taken = Taken(reward, terminated, truncated, success, moved, before_reset)
        if keys is None:
            return self.perceive(before_reset, action, moved, knowledge, params), taken
        fresh = self._fresh(
            state, None if policy is None else policy.initial_memory(state.pose.shape), knowledge, params
        )
        following = select(taken.ended, fresh, before_reset)._replace(state=state)
        action, moved = jnp.where(taken.ended, NO_ACTION, action), moved & ~taken.ended
        return self.perceive(following, action, moved, knowledge, params), taken

    def due(self, agent: Agent) -> jax.Array | None:
        """Return which choices count now, bool [B].

        None where all do.
        """
        return None if self.method is None else self.method.control.due(agent.perceived.note)

    def perceive(self, agent: Agent, action: jax.Array, moved: jax.Array, knowledge: Any, params: EnvParams) -> Agent:
        """Take the present views into beliefs and notes.

        Args:
          agent: the episodes, [B].
          action: int32 [B], that led there.
          moved: bool [B], whether it changed the cell.
          knowledge, params: as in `step`.
        """
        pose, room = agent.state.pose, params.room[agent.state.scene]
        _, heading, horizon = self.env.task.rules.split(pose)
        percept = Percept(params.tables.rows[pose], heading, action, moved, horizon, agent.state.goal)
        update = jax.vmap(self._perception.update, (0, 0, None, 0))
        return agent._replace(perceived=update(agent.perceived, percept, knowledge, room))

    def _controlled(self, agent: Agent, choice: jax.Array, knowledge: Any) -> tuple[jax.Array, Agent]:
        """Return the actions of choices, and the agents with their notes."""
        if self.method is None:
            return choice, agent
        perceived = agent.perceived
        action, note = jax.vmap(self.method.control.act, (0, 0, None))(choice, perceived.note, knowledge)
        return action, agent._replace(perceived=perceived._replace(note=note))

    @property
    def _perception(self) -> Perception:
        return Perception(self.env.row_format, self.spec, self.setting)

    def _act(self, state: State, action: jax.Array, keys: jax.Array | None, params: EnvParams) -> tuple[Any, ...]:
        """Take actions in the environment.

        Returns:
          The state after the action, reward, terminated, truncated and success, and the state to go on with.
        """
        if keys is None:
            success = jax.vmap(self.env.succeeds, (0, None))(state, params)
            last, reward, terminated, truncated = jax.vmap(self.env.advance, (0, 0, None))(state, action, params)
            return last, reward, terminated, truncated, terminated & success, last
        step = jax.vmap(self.env.step, (0, 0, 0, None))
        _, following, reward, terminated, truncated, info = step(keys, state, action, params)
        return info["final_state"], reward, terminated, truncated, info["success"], following

    def _fresh(self, state: State, memory: Memory | None, knowledge: Any, params: EnvParams) -> Agent:
        """Return agents before anything is seen."""
        perceived = jax.vmap(self._perception.init, (None, 0))(knowledge, params.room[state.scene])
        return Agent(state, perceived, memory)


def carried(agent: Agent) -> Memory:
    """Return the memory of agents that a policy acts for."""
    assert agent.memory is not None
    return agent.memory


def select(condition: jax.Array, yes: Tree, no: Tree) -> Tree:
    """Choose the leaves [B, ...] of either tree, per episode."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, yes, no)
