"""The agent loop: perceive, decide, act, for every episode in training, evaluation and replays.

`Perception` turns the views of one episode into beliefs that need no trained parameters: the layout belief, the spatial
map and the state of the method's tracker. `policy_inputs` joins them with the observation, and `embed_and_decide` runs
a policy on these inputs. `AgentLoop` ties both to an environment: it starts B parallel episodes, and steps them with or
without auto-reset.

    loop = AgentLoop(env, spec, estimator_config)
    policy = loop.bind(params)
    agent = loop.start(start_key, num_envs, policy.initial_memory((num_envs,)), knowledge, env_params)
    inputs = loop.policy_inputs(agent, knowledge, env_params)
    decision = embed_and_decide(policy, inputs, policy_memory(agent))
    choice = jax.random.categorical(choice_key, decision.logits)
    agent, result = loop.step(agent, choice, knowledge, env_params, policy=policy, decision=decision, reset_keys=keys)
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.causal import do
from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation, State
from jaxnav.layout import EstimatorConfig, LayoutEstimator, LayoutState, ViewGeometry
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.adaptation import limit_inner_steps
from jaxnav.policies.handover import Decider, HandoverPolicy
from jaxnav.policies.method import Knowledge, Method, Percept
from jaxnav.policies.network import Params, Policy, bind
from jaxnav.policies.pathways import NO_ACTION, Decision, Pathways, PolicyInputs, PolicyState, mask_direct_pathways
from jaxnav.policies.spatial_memory import ExplorationMap, SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.observation_row import RowFormat, relative_position, turn_offsets
from jaxnav.scenes.task import Rules


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


@dataclasses.dataclass(frozen=True)
class Perception:
    """Perception of one episode, without trained parameters; hashable.

    Call `update` exactly once per view, including the first one of an episode. All functions handle one episode; use
    `jax.vmap` for batches.

    Attributes:
      row_format: format of the observation rows.
      spec: spec of the policy; None where actions are given.
      estimator_config: configuration of the layout estimator; None leaves the layout out.
      rules: motion and camera of the agent.
    """

    row_format: RowFormat
    spec: PolicySpec | None = None
    estimator_config: EstimatorConfig | None = None
    rules: Rules = Rules()

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
        """Update layout belief, map and tracker state with one view.

        Args:
          state: the state before the view.
          percept: observation row, heading and odometry of one step.
          knowledge, room: as in `init`.
        """
        layout, spatial_map, tracker_state = state

        # Layout belief: equations 3 to 5.
        layout_estimator = self._layout_estimator(knowledge, room)
        if layout_estimator is not None and layout is not None:
            counts_instances = layout_estimator.resolved_config.counts == "instances"
            read_counts = self.row_format.counts if counts_instances else self.row_format.presence
            geometry = None
            if self._uses_geometry:
                geometry = self.view_geometry(percept.row, percept.heading, percept.moved)
            layout = layout_estimator.update(layout, read_counts(percept.row), percept.goal, geometry)

        # Map of free, blocked and visited cells.
        spatial_memory = self._spatial_memory
        if spatial_memory is not None and spatial_map is not None:
            spatial_map = spatial_memory.update(
                spatial_map, percept.row, percept.heading, percept.moved, self.row_format
            )

        # State of the method's tracker.
        if self.tracker is not None:
            tracker_state = self.tracker.update(tracker_state, knowledge, percept)

        return PerceptionState(layout, spatial_map, tracker_state)

    def policy_inputs(self, state: PerceptionState, observation: Observation, knowledge: Any) -> PolicyInputs:
        """Inputs of the policy for one episode, leaves without a batch axis, given its observation."""
        # Layout weights of the goal, [K]; ones disable the layout.
        layout_weights = jnp.ones(self.row_format.num_categories)
        if state.layout is not None:
            layout_weights = LayoutEstimator.goal_weights(state.layout, observation.goal)

        # Output of the method's tracker.
        reading = None
        if self.tracker is not None:
            reading = self.tracker.read(state.tracker_state, knowledge, observation.goal)

        # Cells around the agent, from the spatial memory.
        surroundings = None
        spatial_memory = self._spatial_memory
        if spatial_memory is not None and state.spatial_map is not None:
            surroundings = spatial_memory.read(state.spatial_map)

        return PolicyInputs(observation, layout_weights, reading, surroundings)

    @property
    def uses_odometry(self) -> bool:
        """True where compass heading and motion are needed."""
        return self.tracker is not None or self._spatial_memory is not None or self._uses_geometry

    def view_geometry(self, row: jax.Array, heading: jax.Array, moved: jax.Array) -> ViewGeometry:
        """Where a view shows the categories, by compass and odometry.

        Args:
          row: uint8 [R], the observation row.
          heading: int32 [], compass heading.
          moved: bool [], whether the last action changed the cell.
        """
        # Axes of the compass: x to the right and z ahead at heading 0.
        forward = jnp.asarray(self.rules.heading_directions(), jnp.float32)[heading]
        detections = self.row_format.detections(row).astype(jnp.float32)
        ahead, right = relative_position(detections)  # [K] each
        offsets = turn_offsets(ahead, right, forward[None])

        # A move leads to the next cell in the direction of the heading.
        move_step = jnp.asarray(self.rules.move_steps(), jnp.float32)[heading, ::-1]  # (z, x) to (x, z)
        return ViewGeometry(offsets, jnp.where(moved, CELL_SIZE * move_step, 0.0))

    @property
    def _uses_geometry(self) -> bool:
        """True where the layout gap reads the positions of detections."""
        return self.estimator_config is not None and self.estimator_config.gap == "surprise"

    @property
    def tracker(self) -> Any:
        """The tracker of the policy's method; None without one."""
        return None if self.spec is None else self.spec.method.tracker

    @property
    def _spatial_memory(self) -> SpatialMemory | None:
        return None if self.spec is None else self.spec.spatial_memory

    def _layout_estimator(self, knowledge: Any, room: jax.Array) -> LayoutEstimator | None:
        """The estimator with the prior of a room type; None without the layout."""
        if self.estimator_config is None:
            return None
        # Rows of this room type; without evidence the tree has no leaves and stays None.
        cooccurrence = jax.tree.map(lambda leaf: leaf[room], knowledge.cooccurrence)
        return LayoutEstimator(knowledge.priors[room], self.estimator_config, cooccurrence)


def embed_and_decide(
    policy: Decider, inputs: PolicyInputs, memory: PolicyState, use_direct: jax.Array | None = None
) -> Decision:
    """Run a policy: embed the pathways, then decide on them.

    Args:
      policy: policy with bound parameters.
      inputs: inputs of a batch [...] of decisions.
      memory: the policy's state, batch [...].
      use_direct: bool [...], False where both direct pathways are set to zero (training with `counterfactual: coin`);
        None keeps them.
    """
    pathways = policy.pathways(inputs, memory)
    pathways = mask_direct_pathways(pathways, use_direct)
    return policy.decide(pathways, memory)


def decide_counterfactually(
    policy: Decider,
    pathways: Pathways,
    memory: PolicyState,
    scene: jax.Array | float = 0.0,
    goal: jax.Array | float = 0.0,
) -> Decision:
    """Decide under do(S = scene, G = goal).

    The decision shares experience and previous action with the factual one, and also the recurrent state, unless the
    counterfactual branch has a state of its own.

    Args:
      policy: policy with bound parameters.
      pathways, memory: inputs of the factual decisions, leaves [...].
      scene, goal: values of the direct pathways, numbers or float32 [...].
    """
    return policy.decide(do(pathways, scene=scene, goal=goal), memory.counterfactual_state())


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
      agent: state after the action and before a reset; its perception excludes the view after the action.
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
    """Runs agents in B parallel episodes; hashable, so that jitted functions may take it as a static argument.

    Attributes:
      env: the environment.
      spec: spec of the policy; None where actions are given.
      estimator_config: configuration of the layout estimator; None leaves the layout out.
      inner_steps: adaptation steps that the method may take in an episode; 0 for none, None for its default.
      fallback_spec: spec of a layout-blind policy that acts after a hand-over; None without one.
      use_own_fallback: whether the policy itself under do(Z = 0) acts after a hand-over.
    """

    env: ObjectNav
    spec: PolicySpec | None = None
    estimator_config: EstimatorConfig | None = None
    inner_steps: int | None = None
    fallback_spec: PolicySpec | None = None
    use_own_fallback: bool = False

    @property
    def method(self) -> Method | None:
        """The policy's method; None where actions are given."""
        return None if self.spec is None else self.spec.method

    def bind(self, params: Params) -> Policy:
        """Bind parameters to the policy, with its adaptation limited to `inner_steps`."""
        if self.spec is None:
            raise ValueError("bind: this AgentLoop was created without a policy spec; give `spec`")
        policy = bind(self.spec, params)
        if self.inner_steps is not None:
            policy.adaptation = limit_inner_steps(policy.adaptation, self.inner_steps)
        return policy

    def bind_decider(self, params: Params) -> Decider:
        """Bind parameters to the policy, or to a `HandoverPolicy` of the policy and its fallback.

        Args:
          params: parameters of the policy; {"primary": ..., "fallback": ...} with a fallback.
        """
        if self.use_own_fallback:
            return HandoverPolicy(self.bind(params))
        if self.fallback_spec is None:
            return self.bind(params)
        return HandoverPolicy(self.bind(params["primary"]), bind(self.fallback_spec, params["fallback"]))

    def start(
        self, key: jax.Array, num_envs: int, memory: PolicyState | None, knowledge: Any, env_params: EnvParams
    ) -> Agent:
        """Start episodes in random states.

        Args:
          key: typed PRNG key; consumed.
          num_envs: B.
          memory: memory at the start, leaves [B, ...]; see `Policy.initial_memory`.
          knowledge: learned before training; None where neither layout nor tracker is used.
          env_params: parameters of the environment.
        """
        # Every episode has a key of its own.
        _, state = jax.vmap(self.env.reset, (0, None))(jax.random.split(key, num_envs), env_params)
        return self.start_from(state, memory, knowledge, env_params)

    def start_from(self, state: State, memory: PolicyState | None, knowledge: Any, env_params: EnvParams) -> Agent:
        """Start episodes in given states, leaves [B], and perceive the first view."""
        agent = self._init_agent(state, memory, knowledge, env_params)
        # No action led to the first view.
        no_action = jnp.full(state.pose.shape, NO_ACTION, jnp.int32)
        not_moved = jnp.zeros(state.pose.shape, bool)
        return self.perceive(agent, no_action, not_moved, knowledge, env_params)

    def policy_inputs(self, agent: Agent, knowledge: Knowledge | None, env_params: EnvParams) -> PolicyInputs:
        """Inputs of the policy in the current states, leaves [B, ...]."""
        observation = jax.vmap(self.env.observe, (0, None))(agent.state, env_params)
        return jax.vmap(self._perception.policy_inputs, (0, 0, None))(agent.perception, observation, knowledge)

    def read_tracker(self, perception: PerceptionState, goal: jax.Array, knowledge: Any) -> Any:
        """Readings of tracker states [B] for goals int32 [B], leaves [B, ...]; None without a tracker."""
        tracker = self._perception.tracker
        if tracker is None:
            return None
        return jax.vmap(tracker.read, (0, None, 0))(perception.tracker_state, knowledge, goal)

    def prior_weights(self, agent: Agent, knowledge: Knowledge, env_params: EnvParams) -> jax.Array:
        """Layout weights before the first view, w of the prior times g, float32 [B, K]; ones without the layout."""
        prior_agent = self._init_agent(agent.state, agent.memory, knowledge, env_params)
        return self.policy_inputs(prior_agent, knowledge, env_params).layout_weights

    def layout_gap(self, agent: Agent) -> jax.Array:
        """Layout gaps D of the current beliefs, float32 [B]; 0 without the layout."""
        layout = agent.perception.layout
        return jnp.zeros(agent.state.goal.shape) if layout is None else layout.gap

    def is_decision_step(self, agent: Agent) -> jax.Array | None:
        """True in episodes where the policy's next choice takes effect, bool [B]; None if every choice does."""
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
        reset_keys: jax.Array | None = None,
    ) -> tuple[Agent, StepResult]:
        """Act once in every episode and perceive the next view.

        Args:
          agent: the episodes, [B].
          choice: int32 [B], sampled from the decision; an action unless the method has a control of its own.
          knowledge: learned before training; None where neither layout nor tracker is used.
          env_params: parameters of the environment.
          policy, decision: the policy, which gives new episodes their initial memory, and its decision; None where
            actions are given.
          reset_keys: PRNG keys [B] of new episodes; ended episodes then reset in the same step. None disables the
            auto-reset.

        Returns:
          The agent after the step (after the reset, if its episode has ended and `reset_keys` are given), and the
          result of the step.
        """
        # Choice -> action -> environment.
        action, agent = self._apply_control(agent, choice, knowledge)
        final_state, reward, terminated, truncated, success, next_state = self._step_env(
            agent.state, action, reset_keys, env_params
        )

        # Odometry: did the action change the cell? Compare before any reset.
        moved = self.env.cell_of_pose(final_state.pose) != self.env.cell_of_pose(agent.state.pose)
        next_memory = None if decision is None else decision.next_state(action)
        before_reset = agent._replace(state=final_state, memory=next_memory)
        result = StepResult(
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            success=success,
            moved=moved,
            agent=before_reset,
        )

        # Without auto-reset the episodes continue.
        if reset_keys is None:
            return self.perceive(before_reset, action, moved, knowledge, env_params), result

        # Auto-reset: ended episodes get fresh memory and beliefs, and no previous action.
        fresh_memory = None if policy is None else policy.initial_memory(next_state.pose.shape)
        fresh_agent = self._init_agent(next_state, fresh_memory, knowledge, env_params)
        next_agent = tree_where(result.ended, fresh_agent, before_reset)._replace(state=next_state)
        action = jnp.where(result.ended, NO_ACTION, action)
        moved = moved & ~result.ended
        return self.perceive(next_agent, action, moved, knowledge, env_params), result

    def perceive(
        self, agent: Agent, action: jax.Array, moved: jax.Array, knowledge: Any, env_params: EnvParams
    ) -> Agent:
        """Update beliefs, maps and tracker states with the views at the current poses.

        Args:
          agent: the episodes, [B].
          action: int32 [B], the action that led to the current pose.
          moved: bool [B], whether that action changed the cell.
          knowledge, env_params: as in `step`.
        """
        pose = agent.state.pose
        room = env_params.room[agent.state.scene]
        _, heading, horizon = self.env.task.rules.split_pose(pose)
        percept = Percept(
            row=env_params.tables.rows[pose],
            heading=heading,
            action=action,
            moved=moved,
            horizon=horizon,
            goal=agent.state.goal,
        )

        # Knowledge is shared by the batch.
        update = jax.vmap(self._perception.update, (0, 0, None, 0))
        return agent._replace(perception=update(agent.perception, percept, knowledge, room))

    @property
    def _perception(self) -> Perception:
        return Perception(self.env.row_format, self.spec, self.estimator_config, self.env.task.rules)

    def _apply_control(self, agent: Agent, choice: jax.Array, knowledge: Any) -> tuple[jax.Array, Agent]:
        """Turn choices into actions; the method's control may change the tracker states."""
        if self.method is None:
            return choice, agent
        tracker_state = agent.perception.tracker_state
        # A control handles one episode.
        action, tracker_state = jax.vmap(self.method.control.act, (0, 0, None))(choice, tracker_state, knowledge)
        return action, agent._replace(perception=agent.perception._replace(tracker_state=tracker_state))

    def _step_env(
        self, state: State, action: jax.Array, reset_keys: jax.Array | None, env_params: EnvParams
    ) -> tuple[State, jax.Array, jax.Array, jax.Array, jax.Array, State]:
        """Step the environment, with auto-reset if keys are given.

        Returns:
          The state after the action, reward, terminated, truncated, success, and the state of the next step.
        """
        if reset_keys is None:
            # Without a reset the final state is also the next one. Done keeps the pose, so success may be read before.
            success = jax.vmap(self.env.done_succeeds, (0, None))(state, env_params)
            advance = jax.vmap(self.env.advance, (0, 0, None))
            final_state, reward, terminated, truncated = advance(state, action, env_params)
            return final_state, reward, terminated, truncated, terminated & success, final_state

        # With a reset the environment returns the final state in `info`.
        step = jax.vmap(self.env.step, (0, 0, 0, None))
        _, next_state, reward, terminated, truncated, info = step(reset_keys, state, action, env_params)
        return info["final_state"], reward, terminated, truncated, info["success"], next_state

    def _init_agent(self, state: State, memory: PolicyState | None, knowledge: Any, env_params: EnvParams) -> Agent:
        """Agents before their first view."""
        perception = jax.vmap(self._perception.init, (None, 0))(knowledge, env_params.room[state.scene])
        return Agent(state, perception, memory)


def policy_memory(agent: Agent) -> PolicyState:
    """The policies' memories of agents that a policy acts for."""
    assert agent.memory is not None
    return agent.memory
