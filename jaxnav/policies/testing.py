"""Test of the contract of methods, for methods of your own.

`check_method` acts with a method in a few scenes and raises an error that says which promise is broken. Call it in a
test, as `jaxnav.env.testing` is called for environments.
"""

from collections.abc import Mapping
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.causal import do
from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import NUM_PRIORS, EnvParams, ObjectNav
from jaxnav.layout import ESTIMATORS, prior_from_counts
from jaxnav.policies.agent_loop import Agent, AgentLoop, PolicyInputs, embed_and_decide, policy_memory
from jaxnav.policies.method import Knowledge, Method, Percept
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import Params, init_params
from jaxnav.policies.pathways import Decision, Pathways, PolicyState
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

_SIZES = Sizes(hidden=16, view_outputs=8, appearance=4, row_hidden=8, row_outputs=4)
_BATCH_SIZE = 6


def check_method(
    name: str,
    method_sizes: Mapping[str, int] | None = None,
    steps: int = 8,
    seed: int = 0,
    bank: Bank | None = None,
) -> None:
    """Check that a method keeps its contract.

    The method acts in a few scenes, and these promises are checked:

    * Pathways and decisions have the right shapes and dtypes and are finite.
    * A batch gives the same results as its single members.
    * `do` leaves the experience unchanged.
    * With both direct pathways zero and the experience given, logits do not depend on the view or the detection of the
      goal.
    * The tracker takes in every step once, the first view included, and its states keep their shapes.
    * A choice becomes a legal action.

    Args:
      name: name of the method, see `jaxnav.policies.methods.find_method`.
      method_sizes: sizes of the method that differ from their defaults.
      steps: number of environment steps.
      seed: seed of parameters, episodes and actions.
      bank: compiled scenes; None for two generated rooms.

    Raises:
      InputError: there is no such method.
      AssertionError: a promise is broken.
    """
    method = find_method(name)
    # Two generated rooms serve where the caller has no scenes.
    rooms = WORLDS["rooms"]
    if bank is None:
        scenes = make_generated_scenes("rooms", "train", 2, seed)
        bank = compile_bank([scenes[0], scenes[1]], rooms.task)
    env, env_params = build_environment(bank, {}, rooms.step_limit)

    # A small policy that is not indifferent between its choices.
    spec = PolicySpec(method, len(env.categories), _SIZES, tuple(sorted((method_sizes or {}).items())))
    agent_loop = AgentLoop(env, spec, ESTIMATORS["calibrated"] if method.hosts_layout else None)
    knowledge = _uniform_knowledge(method, env, bank)
    params_key, actor_key, start_key, choice_key = jax.random.split(jax.random.key(seed), 4)
    params = _with_random_actor(jax.jit(init_params, static_argnums=0)(spec, params_key), actor_key)

    # Rollouts and histories rely on a bound on how long a choice lasts.
    interval = getattr(method.control, "interval", 0)
    _require(isinstance(interval, int) and interval >= 1, "control.interval is not a whole number of 1 or more")

    # Act, and keep all agents and choices.
    @jax.jit
    def start_episodes() -> Agent:
        memory = agent_loop.bind(params).initial_memory((_BATCH_SIZE,))
        return agent_loop.start(start_key, _BATCH_SIZE, memory, knowledge, env_params)

    @jax.jit
    def act_once(agent: Agent, step_key: jax.Array) -> tuple[Agent, jax.Array]:
        policy = agent_loop.bind(params)
        inputs = agent_loop.policy_inputs(agent, knowledge, env_params)
        decision = embed_and_decide(policy, inputs, policy_memory(agent))
        # Sample the choices, and step all episodes without a reset.
        choice = jax.random.categorical(step_key, decision.logits)
        next_agent, _ = agent_loop.step(agent, choice, knowledge, env_params, policy=policy, decision=decision)
        return next_agent, choice

    # `choices[t]` leads from `agents[t]` to `agents[t + 1]`.
    agents = [start_episodes()]
    choices: list[jax.Array] = []
    for time in range(steps):
        agent, choice = act_once(agents[-1], jax.random.fold_in(choice_key, time))
        agents.append(agent)
        choices.append(choice)
        action = policy_memory(agent).action
        is_legal = (action >= 0) & (action < env.num_actions)
        _require(bool(is_legal.all()), "a choice does not become the index of an action")

    # The tracker is checked against the whole history, decisions in the last step.
    _check_tracker_states(method, agents, choices, env, knowledge, env_params)
    _check_decision(agent_loop, params, agents[-1], method.control.num_choices, knowledge, env_params)


def _uniform_knowledge(method: Method, env: ObjectNav, bank: Bank) -> Knowledge:
    """Return knowledge from counts that are all 1."""
    num_categories = len(env.categories)
    # Equal counts [rooms, K, K] prefer no pair of categories.
    counts = np.ones((NUM_PRIORS, num_categories, num_categories), np.float32)
    prior = jax.vmap(prior_from_counts)(jnp.asarray(counts))
    learned = {} if method.learn is None else jax.tree.map(jnp.asarray, method.learn([bank], counts))
    return Knowledge(prior, learned)


def _with_random_actor(params: dict[str, Any], key: jax.Array) -> dict[str, Any]:
    """Replace the actor's kernel, which is nearly zero at first, by a random one; other policies change all over."""
    if "actor" not in params:
        # Every leaf has a key of its own, or leaves of one shape would change alike.
        leaves, structure = jax.tree.flatten(params)
        leaf_keys = jax.tree.unflatten(structure, list(jax.random.split(key, len(leaves))))
        return jax.tree.map(
            lambda leaf, leaf_key: leaf + 0.1 * jax.random.normal(leaf_key, leaf.shape), params, leaf_keys
        )
    kernel = jax.random.normal(key, params["actor"]["kernel"].shape)
    return params | {"actor": params["actor"] | {"kernel": kernel}}


def _check_tracker_states(
    method: Method,
    agents: list[Agent],
    choices: list[jax.Array],
    env: ObjectNav,
    knowledge: Knowledge,
    env_params: EnvParams,
) -> None:
    """Check that tracker states take in every view and every choice exactly once."""
    # A method without a tracker has nothing to check here.
    tracker = method.tracker
    if tracker is None:
        return

    @jax.jit
    def update(tracker_state: Any, percept: Percept) -> Any:
        return tracker.update(tracker_state, knowledge, percept)

    @jax.jit
    def apply_choice(choice: jax.Array, tracker_state: Any) -> Any:
        return method.control.act(choice, tracker_state, knowledge)[1]

    # Track every episode of the batch once more, and compare at every step.
    for i in range(_BATCH_SIZE):
        tracker_state = tracker.init(knowledge)
        for time, agent in enumerate(agents):
            pose = agent.state.pose[i]
            cell, heading, horizon = env.task.rules.split_pose(pose)
            # The control sees the state before the step, so its choice comes before the update.
            moved = jnp.bool_(False)
            if time > 0:
                tracker_state = apply_choice(choices[time - 1][i], tracker_state)
                moved = jnp.bool_(env.cell_of_pose(agents[time - 1].state.pose[i]) != cell)

            # Rebuild what the tracker perceived, from the tables of the environment.
            percept = Percept(
                row=env_params.tables.rows[pose],
                heading=heading,
                action=policy_memory(agent).action[i],
                moved=moved,
                horizon=horizon,
                goal=agent.state.goal[i],
            )
            tracker_state = update(tracker_state, percept)
            # Training carries the state from step to step, so an update must keep its shapes and dtypes.
            chex.assert_trees_all_equal_shapes_and_dtypes(tracker.init(knowledge), tracker_state)
            # The state that the agent carries must be that of a single update per step.
            agent_tracker_state = _member(agent.perception.tracker_state, i)
            chex.assert_trees_all_equal_shapes_and_dtypes(agent_tracker_state, tracker_state)
            chex.assert_trees_all_close(agent_tracker_state, tracker_state, rtol=1e-5, atol=1e-6)


def _check_decision(
    agent_loop: AgentLoop,
    params: Params,
    agent: Agent,
    num_choices: int,
    knowledge: Knowledge,
    env_params: EnvParams,
) -> None:
    """Check pathways and decisions in the middle of episodes."""
    inputs = agent_loop.policy_inputs(agent, knowledge, env_params)
    memory = policy_memory(agent)

    @jax.jit
    def embed(inputs: PolicyInputs, memory: PolicyState) -> Pathways:
        return agent_loop.bind(params).pathways(inputs, memory)

    @jax.jit
    def decide(pathways: Pathways, memory: PolicyState) -> Decision:
        return agent_loop.bind(params).decide(pathways, memory)

    # Shapes, dtypes, finite values.
    pathways = embed(inputs, memory)
    decision = decide(pathways, memory)
    chex.assert_shape(pathways.experience, (_BATCH_SIZE, agent_loop.bind(params).method.width))
    chex.assert_shape([decision.logits, decision.value], [(_BATCH_SIZE, num_choices), (_BATCH_SIZE,)])
    chex.assert_type([pathways.experience, decision.logits, decision.value], jnp.float32)
    chex.assert_trees_all_equal_shapes_and_dtypes(decision.next_state(memory.action), memory)
    chex.assert_tree_all_finite((pathways, decision))

    # Single members of the batch.
    for i in range(_BATCH_SIZE):
        member_inputs = _member(inputs, i)
        member_memory = _member(memory, i)
        member_decision = decide(embed(member_inputs, member_memory), member_memory)
        chex.assert_trees_all_close(member_decision, _member(decision, i), rtol=1e-4, atol=1e-5)

    # An intervention leaves the experience unchanged, and then only the experience matters.
    counterfactual = do(pathways, scene=0.0, goal=0.0)
    chex.assert_trees_all_equal(counterfactual.experience, pathways.experience)
    # Exchange the direct pathways between members: once they are zero, logits must not change.
    other_pathways = jax.tree.map(lambda leaf: jnp.roll(leaf, 1, axis=0), pathways)
    other_pathways = other_pathways._replace(experience=pathways.experience, gate=pathways.gate)
    other_logits = decide(do(other_pathways, scene=0.0, goal=0.0), memory).logits
    chex.assert_trees_all_equal(other_logits, decide(counterfactual, memory).logits)


def _member(tree: Any, index: int) -> Any:
    """Return one member of a batch."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _require(condition: bool, problem: str) -> None:
    """Raise an error that names a broken promise unless the condition holds."""
    if not condition:
        raise AssertionError(f"the method breaks its contract: {problem}")
