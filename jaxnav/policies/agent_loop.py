"""The agent loop: perceive, decide, act, for every episode in training, evaluation and replays.

`Perception` turns the views of one episode into beliefs that need no trained parameters: the layout belief, the spatial
map and the state of the method's tracker. `decide` runs a policy on such a view. `AgentLoop` ties both to an
environment: it starts B parallel episodes, and steps them with or without auto-reset.

    loop = AgentLoop(env, spec, estimator)
    agent = loop.start(start_key, num_envs, policy.initial_memory((num_envs,)), knowledge, env_params)
    view = loop.view(agent, knowledge, env_params)
    _, decision = decide(policy, view, policy_memory(agent))
    choice = jax.random.categorical(choice_key, decision.logits)
    agent, result = loop.step(agent, choice, knowledge, env_params, policy=policy, decision=decision, keys=keys)
"""

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxnav.causal import do
from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation, State
from jaxnav.layout import EstimatorConfig, LayoutEstimator, LayoutState
from jaxnav.policies.adaptation import limit_inner_steps
from jaxnav.policies.handover import Decider, HandoverPolicy
from jaxnav.policies.method import Knowledge, Method, Percept
from jaxnav.policies.network import Params, Policy, bind
from jaxnav.policies.pathways import NO_ACTION, Decision, Pathways, PolicyState
from jaxnav.policies.spatial_memory import ExplorationMap, SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat

Tree = TypeVar("Tree")


class PerceptionState(NamedTuple):
    """Beliefs that one episode has accumulated.

    Attributes:
      layout: the layout belief; None where the policy does not use the layout.
      spatial_map: the map of the spatial memory; None without one.
      tracker_state: the state of the method's tracker; None without one.
    """

    layout: LayoutState | None
    spatial_map: ExplorationMap | None
    tracker_state: Any


class View(NamedTuple):
    """Inputs of a policy at one step.

    Attributes:
      observation: packed row and goal.
      weights: float32 [K], the layout's weights for the goal (eq. 7); ones without the layout.
      reading: what the tracker reads from its state, a pytree; None without a tracker.
      surroundings: uint8 [M], known cells around the agent; None without a spatial memory.
    """

    observation: Observation
    weights: jax.Array
    reading: Any
    surroundings: jax.Array | None


@dataclasses.dataclass(frozen=True)
class Perception:
    """Perception of one episode, without trained parameters; hashable.

    Each view is taken in exactly once, the first one of an episode included. All functions handle one episode; use
    `jax.vmap` for batches.

    Attributes:
      row_format: format of the observation rows.
      spec: of the policy; None where actions are given.
      estimator: configuration of the layout estimator; None leaves the layout out.
    """

    row_format: RowFormat
    spec: PolicySpec | None = None
    estimator: EstimatorConfig | None = None

    def init(self, knowledge: Knowledge | None, room: jax.Array) -> PerceptionState:
        """Return the state before the first view.

        Args:
          knowledge: learned before training; None where neither layout nor tracker is used.
          room: int32 [], index of the room type's layout prior.
        """
        layout_estimator = self._layout_estimator(knowledge, room)
        spatial_memory = self._spatial_memory

        return PerceptionState(
            layout=None if layout_estimator is None else layout_estimator.init(),
            spatial_map=None if spatial_memory is None else spatial_memory.init(),
            tracker_state=None if self.tracker is None else self.tracker.init(knowledge),
        )

    def update(self, state: PerceptionState, percept: Percept, knowledge: Any, room: jax.Array) -> PerceptionState:
        """Take in one view.

        Args:
          state: before the view.
          percept: the view, and how the agent got there.
          knowledge, room: as in `init`.
        """
        layout, spatial_map, tracker_state = state

        # Layout belief: equations 3 to 5.
        layout_estimator = self._layout_estimator(knowledge, room)
        if layout_estimator is not None and layout is not None:
            presence = self.row_format.presence(percept.row)
            layout = layout_estimator.update(layout, presence, percept.goal)

        # Map of free, blocked and visited cells.
        spatial_memory = self._spatial_memory
        if spatial_memory is not None and spatial_map is not None:
            spatial_map = spatial_memory.update(
                spatial_map, percept.row, percept.heading, percept.moved, self.row_format
            )

        # Whatever else the method remembers.
        if self.tracker is not None:
            tracker_state = self.tracker.update(tracker_state, knowledge, percept)

        return PerceptionState(layout, spatial_map, tracker_state)

    def view(self, state: PerceptionState, observation: Observation, knowledge: Any) -> View:
        """Return the policy's inputs, given the present observation."""
        # Layout weights of the goal, [K]; ones leave the layout out.
        weights = jnp.ones(self.row_format.num_categories)
        if state.layout is not None:
            weights = LayoutEstimator.goal_weights(state.layout, observation.goal)

        # What the method's tracker contributes.
        reading = None
        if self.tracker is not None:
            reading = self.tracker.read(state.tracker_state, knowledge, observation.goal)

        # Cells around the agent, from the spatial memory.
        surroundings = None
        spatial_memory = self._spatial_memory
        if spatial_memory is not None and state.spatial_map is not None:
            surroundings = spatial_memory.read(state.spatial_map)

        return View(observation, weights, reading, surroundings)

    @property
    def uses_odometry(self) -> bool:
        """True where compass heading and motion are needed."""
        return self.tracker is not None or self._spatial_memory is not None

    @property
    def tracker(self) -> Any:
        """The tracker of the policy's method; None without one."""
        return None if self.spec is None else self.spec.method.tracker

    @property
    def _spatial_memory(self) -> SpatialMemory | None:
        return None if self.spec is None else self.spec.spatial_memory

    def _layout_estimator(self, knowledge: Any, room: jax.Array) -> LayoutEstimator | None:
        """The estimator with the prior of a room type; None without the layout."""
        if self.estimator is None:
            return None
        # Rows of this room type; without evidence the tree has no leaves and stays None.
        cooccurrence = jax.tree.map(lambda leaf: leaf[room], knowledge.cooccurrence)
        return LayoutEstimator(knowledge.layout[room], self.estimator, cooccurrence)


def decide(
    policy: Decider, view: View, memory: PolicyState, use_direct: jax.Array | None = None
) -> tuple[Pathways, Decision]:
    """Run a policy on a view: embed the pathways, then decide on them.

    Args:
      policy: with bound parameters.
      view: leaves [..., ...].
      memory: of the policy, leaves [..., ...].
      use_direct: bool [...], False where both direct pathways are set to zero; None keeps them.

    Returns:
      The pathways after masking, for interventions, and the decision on them.
    """
    pathways = policy.pathways(*view, memory)
    pathways = mask_direct_pathways(pathways, use_direct)
    return pathways, policy.decide(pathways, memory)


def mask_direct_pathways(pathways: Pathways, use_direct: jax.Array | None) -> Pathways:
    """Set both direct pathways to zero where `use_direct` is False.

    Args:
      pathways: leaves [..., ...].
      use_direct: bool [...]; None keeps all.
    """
    if use_direct is None:
        return pathways
    masked_scene = jnp.where(use_direct[..., None], pathways.scene, 0.0)
    masked_goal = jnp.where(use_direct[..., None], pathways.goal, 0.0)
    return do(pathways, scene=masked_scene, goal=masked_goal)


class Agent(NamedTuple):
    """B parallel episodes and the state of their agents.

    Attributes:
      state: environment states, leaves [B].
      perception: beliefs, maps and tracker states, leaves [B, ...].
      memory: the policy's memories, leaves [B, ...]; None where no policy acts.
    """

    state: State
    perception: PerceptionState
    memory: PolicyState | None


class StepResult(NamedTuple):
    """Outcome of one step, leaves [B, ...].

    Attributes:
      reward: float32.
      terminated: bool, Done was chosen.
      truncated: bool, the step limit was reached.
      success: bool, Done was chosen where it succeeds.
      moved: bool, the agent changed its cell.
      agent: after the action and before a reset; its perception excludes the view after the action.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array
    moved: jax.Array
    agent: Agent

    @property
    def ended(self) -> jax.Array:
        """True where the episode has ended, either way; bool [B]."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True)
class AgentLoop:
    """Acting in B parallel episodes; hashable, so that jitted functions may take it as a static argument.

    Attributes:
      env: the environment.
      spec: of the policy; None where actions are given.
      estimator: configuration of the layout estimator; None leaves the layout out.
      inner_steps: adaptation steps that the method may take in an episode; 0 for none, None for its default.
      fallback_spec: of a policy without experience that decisions are handed over to; None without one.
    """

    env: ObjectNav
    spec: PolicySpec | None = None
    estimator: EstimatorConfig | None = None
    inner_steps: int | None = None
    fallback_spec: PolicySpec | None = None

    @property
    def method(self) -> Method | None:
        """The policy's method; None where actions are given."""
        return None if self.spec is None else self.spec.method

    def bind(self, params: Params) -> Policy:
        """Bind parameters to the policy, with its adaptation limited to `inner_steps`."""
        if self.spec is None:
            raise ValueError("AgentLoop without a spec has no policy to bind; give one")
        policy = bind(self.spec, params)
        if self.inner_steps is not None:
            policy.adaptation = limit_inner_steps(policy.adaptation, self.inner_steps)
        return policy

    def decider(self, params: Params) -> Decider:
        """Bind parameters to the policy, or to the pair of the policy and its fallback.

        Args:
          params: of the policy; {"agent": ..., "without": ...} with a fallback.
        """
        if self.fallback_spec is None:
            return self.bind(params)
        return HandoverPolicy(self.bind(params["agent"]), bind(self.fallback_spec, params["without"]))

    def start(
        self, key: jax.Array, num_envs: int, memory: PolicyState | None, knowledge: Any, env_params: EnvParams
    ) -> Agent:
        """Start episodes in random states.

        Args:
          key: typed PRNG key; consumed.
          num_envs: B.
          memory: at the start, leaves [B, ...]; see `Policy.initial_memory`.
          knowledge: learned before training; None where neither layout nor tracker is used.
          env_params: of the environment.
        """
        # Every episode has a key of its own.
        _, state = jax.vmap(self.env.reset, (0, None))(jax.random.split(key, num_envs), env_params)
        return self.begin(state, memory, knowledge, env_params)

    def begin(self, state: State, memory: PolicyState | None, knowledge: Any, env_params: EnvParams) -> Agent:
        """Start episodes in given states, leaves [B], and perceive the first view."""
        agent = self._unseeing_agent(state, memory, knowledge, env_params)
        # No action led to the first view.
        no_action = jnp.full(state.pose.shape, NO_ACTION, jnp.int32)
        not_moved = jnp.zeros(state.pose.shape, bool)
        return self.perceive(agent, no_action, not_moved, knowledge, env_params)

    def view(self, agent: Agent, knowledge: Knowledge | None, env_params: EnvParams) -> View:
        """Return the policy's inputs in the present states, leaves [B, ...]."""
        observation = jax.vmap(self.env.observe, (0, None))(agent.state, env_params)
        return jax.vmap(self._perception.view, (0, 0, None))(agent.perception, observation, knowledge)

    def gap(self, agent: Agent) -> jax.Array:
        """Return the layout gaps D, float32 [B]; 0 without the layout."""
        layout = agent.perception.layout
        return jnp.zeros(agent.state.goal.shape) if layout is None else layout.gap

    def is_decision_step(self, agent: Agent) -> jax.Array | None:
        """True where the policy's choice has an effect now, bool [B]; None where every choice has."""
        return None if self.method is None else self.method.control.is_decision_step(agent.perception.tracker_state)

    def step(
        self,
        agent: Agent,
        choice: jax.Array,
        knowledge: Knowledge | None,
        env_params: EnvParams,
        *,
        policy: Decider | None = None,
        decision: Decision | None = None,
        keys: jax.Array | None = None,
    ) -> tuple[Agent, StepResult]:
        """Act once in every episode and perceive the next view.

        Args:
          agent: the episodes, [B].
          choice: int32 [B], sampled from the decision; an action unless the method has a control of its own.
          knowledge: learned before training; None where neither layout nor tracker is used.
          env_params: of the environment.
          policy, decision: the policy and its decision; None where actions are given.
          keys: [B], of the episodes that follow those that end (same-step auto-reset); None lets episodes go on.

        Returns:
          The agent after the step, in a new episode where one has ended and keys are given, and the result of the step.
        """
        # Choice -> action -> environment.
        action, agent = self._apply_control(agent, choice, knowledge)
        last_state, reward, terminated, truncated, success, next_state = self._step_env(
            agent.state, action, keys, env_params
        )
        # Odometry compares the cells before and after the action, and not after a reset.
        moved = self.env.cell_of_pose(last_state.pose) != self.env.cell_of_pose(agent.state.pose)
        next_memory = None if decision is None else decision.next_state(action)
        before_reset = agent._replace(state=last_state, memory=next_memory)
        result = StepResult(reward, terminated, truncated, success, moved, before_reset)

        # Without keys the episodes simply go on.
        if keys is None:
            return self.perceive(before_reset, action, moved, knowledge, env_params), result

        # With keys, those that have ended start anew: fresh memory and beliefs, no previous action.
        fresh_memory = None if policy is None else policy.initial_memory(next_state.pose.shape)
        fresh_agent = self._unseeing_agent(next_state, fresh_memory, knowledge, env_params)
        next_agent = select(result.ended, fresh_agent, before_reset)._replace(state=next_state)
        action = jnp.where(result.ended, NO_ACTION, action)
        moved = moved & ~result.ended
        return self.perceive(next_agent, action, moved, knowledge, env_params), result

    def perceive(
        self, agent: Agent, action: jax.Array, moved: jax.Array, knowledge: Any, env_params: EnvParams
    ) -> Agent:
        """Take the present views into beliefs, maps and tracker states.

        Args:
          agent: the episodes, [B].
          action: int32 [B], that led to the present pose.
          moved: bool [B], whether that action changed the cell.
          knowledge, env_params: as in `step`.
        """
        pose = agent.state.pose
        room = env_params.room[agent.state.scene]
        _, heading, horizon = self.env.task.rules.split_pose(pose)
        # Views are rows of the compiled tables, looked up by pose.
        percept = Percept(env_params.tables.rows[pose], heading, action, moved, horizon, agent.state.goal)

        # Knowledge is shared by the batch.
        update = jax.vmap(self._perception.update, (0, 0, None, 0))
        return agent._replace(perception=update(agent.perception, percept, knowledge, room))

    @property
    def _perception(self) -> Perception:
        return Perception(self.env.row_format, self.spec, self.estimator)

    def _apply_control(self, agent: Agent, choice: jax.Array, knowledge: Any) -> tuple[jax.Array, Agent]:
        """Turn choices into actions; the method's control may change the tracker states."""
        if self.method is None:
            return choice, agent
        tracker_state = agent.perception.tracker_state
        # A control handles one episode.
        action, tracker_state = jax.vmap(self.method.control.act, (0, 0, None))(choice, tracker_state, knowledge)
        return action, agent._replace(perception=agent.perception._replace(tracker_state=tracker_state))

    def _step_env(
        self, state: State, action: jax.Array, keys: jax.Array | None, env_params: EnvParams
    ) -> tuple[State, jax.Array, jax.Array, jax.Array, jax.Array, State]:
        """Step the environment, with auto-reset where keys are given.

        Returns:
          The state after the action, reward, terminated, truncated, success, and the state to go on with.
        """
        if keys is None:
            # Without a reset the last state is also the next one.
            success = jax.vmap(self.env.done_succeeds, (0, None))(state, env_params)
            advance = jax.vmap(self.env.advance, (0, 0, None))
            last_state, reward, terminated, truncated = advance(state, action, env_params)
            return last_state, reward, terminated, truncated, terminated & success, last_state

        # With a reset the environment hands the last state over in `info`.
        step = jax.vmap(self.env.step, (0, 0, 0, None))
        _, next_state, reward, terminated, truncated, info = step(keys, state, action, env_params)
        return info["final_state"], reward, terminated, truncated, info["success"], next_state

    def _unseeing_agent(self, state: State, memory: PolicyState | None, knowledge: Any, env_params: EnvParams) -> Agent:
        """Return agents that have not perceived anything yet."""
        perception = jax.vmap(self._perception.init, (None, 0))(knowledge, env_params.room[state.scene])
        return Agent(state, perception, memory)


def policy_memory(agent: Agent) -> PolicyState:
    """Return the policy's memories, for agents that a policy acts for."""
    assert agent.memory is not None
    return agent.memory


def select(condition: jax.Array, on_true: Tree, on_false: Tree) -> Tree:
    """Choose the leaves [B, ...] of either tree, per episode, by bool [B]."""

    def select_leaf(true_leaf: jax.Array, false_leaf: jax.Array) -> jax.Array:
        # [B] becomes [B, 1, ...], with the number of axes of the leaf.
        batch_condition = condition.reshape(condition.shape + (1,) * (true_leaf.ndim - 1))
        return jnp.where(batch_condition, true_leaf, false_leaf)

    return jax.tree.map(select_leaf, on_true, on_false)
