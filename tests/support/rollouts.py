"""Rollouts in the world of `support.tiny_world`, and a plain loop that repeats them decision by decision."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.pathways import NO_ACTION, PolicyState
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, collect_rollout, replay_rollout
from support import tiny_world as tiny

ENVS = 64
LENGTH = tiny.STEP_LIMITS[0]
SLOTS = 20  # environments that the plain loop repeats
ENV, PARAMS = tiny.world()
KNOWLEDGE = tiny.knowledge()
PRIORS = KNOWLEDGE.priors
AGENT_LOOP = AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR)
CONFIG = PPOConfig(
    num_envs=ENVS,
    rollout=LENGTH,
    epochs=4,
    minibatches=2,
    learning_rate=4e-3,
    gamma=0.97,
    gae_lambda=0.9,
    clip=0.2,
    entropy=0.05,
    value=0.5,
    max_grad_norm=0.5,
    distil=0.02,
)
LEARNER = Learner(agent_loop=AGENT_LOOP, config=CONFIG, counterfactual="distil")
ROWS = tiny.BANK.rows
SUCCESSOR = tiny.BANK.successor
#: Scene of each pose.
SCENE = np.repeat([0, 1], tiny.BANK.num_cells * tiny.POSES_PER_CELL)


@functools.partial(jax.jit, static_argnums=(3, 4))
def collect(weights, agent, key, mask_direct, agent_loop=AGENT_LOOP):
    """The agent after a rollout, and the rollout; with `mask_direct` steps have no direct pathways at random."""
    policy = agent_loop.bind(weights)
    return collect_rollout(agent_loop, policy, agent, key, PARAMS, KNOWLEDGE, num_steps=LENGTH, use_coin=mask_direct)


def collect_rollouts(agent_loop, weights, seeds, knowledge=KNOWLEDGE, first_agent: Any = None, **options):
    """Rollouts that continue one another, so that all but the first begin within episodes.

    Args:
      agent_loop: runs the agents.
      weights: parameters of the policy.
      seeds: seeds of the rollouts, one each.
      knowledge: knowledge from before training.
      first_agent: `Agent` before the first rollout; None for new episodes in all environments.
      **options: further options of `jaxnav.training.ppo.collect_rollout`.

    Returns:
      The agents before the first and after each rollout, and the rollouts.
    """

    @jax.jit
    def collect_one(agent, key):
        policy = agent_loop.bind(weights)
        return collect_rollout(agent_loop, policy, agent, key, PARAMS, knowledge, num_steps=LENGTH, **options)

    if first_agent is None:
        memory = agent_loop.bind(weights).initial_memory((ENVS,))
        first_agent = agent_loop.start(jax.random.key(0), ENVS, memory, knowledge, PARAMS)
    agents = [first_agent]
    rollouts = []
    for seed in seeds:
        agent, rollout = collect_one(agents[-1], jax.random.key(seed))
        agents.append(agent)
        rollouts.append(rollout)
    return agents, rollouts


@functools.partial(jax.jit, static_argnums=1)
def start_agents(key, agent_loop=AGENT_LOOP):
    """The agent at the start of an episode in every environment."""
    memory = agent_loop.bind(tiny.random_params(0)).initial_memory((ENVS,))
    return agent_loop.start(key, ENVS, memory, KNOWLEDGE, PARAMS)


@jax.jit
def replay_decisions(weights, transitions, memory):
    """The factual and the counterfactual decisions of recorded transitions."""
    replayed = replay_rollout(AGENT_LOOP.bind(weights), transitions, memory, PARAMS)
    return replayed.factual, replayed.counterfactual


def choice_log_probs(logits, choice):
    """Log-probabilities [T, B] of choices [T, B] under logits [T, B, A]."""
    return jnp.take_along_axis(jax.nn.log_softmax(logits), choice[..., None], axis=-1)[..., 0]


def changed_parts(params_before, params_after):
    """Names of the top-level parts of two trees of parameters that differ."""
    names = set()
    for name in params_before:
        is_equal = jax.tree.map(np.array_equal, params_before[name], params_after[name])
        if not all(jax.tree.leaves(is_equal)):
            names.add(name)
    return names


class RecordedRollout(NamedTuple):
    """A rollout that continues an earlier one, so that its episodes begin at all times.

    All leaves are NumPy arrays; the types of the package have JAX arrays.

    Attributes:
      weights: parameters of the policy.
      before: `Agent` before the rollout.
      after: `Agent` after the rollout.
      transitions: `Transition`, leaves [T, B].
      memory: `PolicyState` before the first step.
      next_value: float32 [T, B].
    """

    weights: dict[str, Any]
    before: Any
    after: Any
    transitions: Any
    memory: Any
    next_value: np.ndarray


@functools.cache
def record_rollout(mask_direct: bool) -> RecordedRollout:
    """The second of two rollouts; with `mask_direct`, each step has no direct pathways with probability 1/2."""
    weights = tiny.random_params(5)
    key = jax.random.key(1)
    agent, _ = collect(weights, start_agents(jax.random.key(0)), jax.random.fold_in(key, 0), mask_direct)
    last_agent, rollout = collect(weights, agent, jax.random.fold_in(key, 1), mask_direct)
    return jax.tree.map(np.asarray, RecordedRollout(weights, agent, last_agent, *rollout))


class PlainLoopResults(NamedTuple):
    """Results of the plain loop.

    Attributes:
      layout_weights: float32 [T, SLOTS, K], the layout's weights for the goal.
      value: float32 [T, SLOTS].
      log_prob: float32 [T, SLOTS].
      next_value: float32 [T, SLOTS].
      layout: the belief after the last step, of each slot.
      memory: the memory after the last step, of each slot.
    """

    layout_weights: np.ndarray
    value: np.ndarray
    log_prob: np.ndarray
    next_value: np.ndarray
    layout: list[Any]
    memory: list[PolicyState]


@functools.cache
def run_plain_loop(mask_direct: bool) -> PlainLoopResults:
    """Walk along the recorded actions, one slot (environment) after the other."""
    recording = record_rollout(mask_direct)
    results = PlainLoopResults(
        layout_weights=np.zeros((LENGTH, SLOTS, len(tiny.CATEGORIES)), np.float32),
        value=np.zeros((LENGTH, SLOTS), np.float32),
        log_prob=np.zeros((LENGTH, SLOTS), np.float32),
        next_value=np.zeros((LENGTH, SLOTS), np.float32),
        layout=[],
        memory=[],
    )
    for slot in range(SLOTS):
        _run_slot(recording, results, slot)

    # Within an episode the next value is that of the next step, or that of the agent after the rollout.
    last_state = recording.after.state
    for slot in range(SLOTS):
        row = ROWS[last_state.pose[slot]]
        goal = last_state.goal[slot]
        layout_weights = tiny.goal_weights(results.layout[slot], goal)
        last_decision, _ = tiny.decide(recording.weights, row, goal, layout_weights, results.memory[slot])
        next_values = np.append(results.value[1:, slot], last_decision.value)
        is_inside_episode = ~(recording.transitions.terminated | recording.transitions.truncated)[:, slot]
        results.next_value[is_inside_episode, slot] = next_values[is_inside_episode]
    return results


def _run_slot(recording: RecordedRollout, results: PlainLoopResults, slot: int) -> None:
    """Fill a column of the results, and append the last belief and memory."""
    layout = tiny.leaves_at(recording.before.perception.layout, slot)
    memory = tiny.leaves_at(recording.before.memory, slot)
    for time in range(LENGTH):
        # The decision.
        transition = tiny.leaves_at(recording.transitions, time, slot)
        row = ROWS[transition.pose]
        layout_weights = tiny.goal_weights(layout, transition.goal)
        factual, counterfactual = tiny.decide(recording.weights, row, transition.goal, layout_weights, memory)
        decision = factual if transition.use_direct is None or transition.use_direct else counterfactual
        results.layout_weights[time, slot] = layout_weights
        results.value[time, slot] = decision.value
        results.log_prob[time, slot] = jax.nn.log_softmax(decision.logits)[transition.action]

        # The recorded action. The value after a truncation is that of the last state, with its belief and memory.
        memory = decision.next_state(jnp.int32(transition.action))
        pose = SUCCESSOR[transition.pose, transition.action]
        if transition.truncated:
            last_layout = tiny.believe(PRIORS[PARAMS.room[SCENE[pose]]], layout, ROWS[pose])
            last_weights = tiny.goal_weights(last_layout, transition.goal)
            last_decision, _ = tiny.decide(recording.weights, ROWS[pose], transition.goal, last_weights, memory)
            results.next_value[time, slot] = last_decision.value
        is_end = transition.terminated | transition.truncated
        if is_end:
            layout = None
            memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))

        # The next view, which after an ending is the first view of the next episode.
        next_pose = recording.after.state.pose[slot]
        if time + 1 < LENGTH:
            next_pose = recording.transitions.pose[time + 1, slot]
        assert is_end or next_pose == pose
        layout = tiny.believe(PRIORS[PARAMS.room[SCENE[next_pose]]], layout, ROWS[next_pose])

    results.layout.append(layout)
    results.memory.append(memory)
