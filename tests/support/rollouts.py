"""Rollouts in the small world, and a plain loop that repeats them decision by decision."""

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

ENVS, LENGTH = 64, tiny.STEP_LIMITS[0]
SLOTS = 20  # of the plain loop
ENV, PARAMS = tiny.world()
KNOWLEDGE = tiny.knowledge()
PRIORS = KNOWLEDGE.layout
ACTING = AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR)
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
LEARNER = Learner(agent_loop=ACTING, config=CONFIG, counterfactual="distil")
ROWS, SUCCESSOR = tiny.BANK.rows, tiny.BANK.successor
SCENE = np.repeat([0, 1], tiny.BANK.num_cells * tiny.POSES_PER_CELL)  # of each pose


@functools.partial(jax.jit, static_argnums=(3, 4))
def act(weights, agent, key, coin, acting=ACTING):
    """The agent after a rollout, and the rollout."""
    return collect_rollout(acting, acting.bind(weights), agent, key, PARAMS, KNOWLEDGE, num_steps=LENGTH, use_coin=coin)


@functools.partial(jax.jit, static_argnums=1)
def begin(key, acting=ACTING):
    memory = acting.bind(tiny.random_params(0)).initial_memory((ENVS,))
    return acting.start(key, ENVS, memory, KNOWLEDGE, PARAMS)


@jax.jit
def decide_again(weights, transitions, memory):
    """The factual and the counterfactual decisions."""
    replayed = replay_rollout(ACTING.bind(weights), transitions, memory, PARAMS)
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


class Rolled(NamedTuple):
    """A rollout that continues another one, so that its episodes begin at all times.

    All leaves are NumPy arrays, which the types of the package do not name.

    Attributes:
      weights: parameters of the policy.
      before, after: the `Agent` before and after the rollout.
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
def rolled(coin: bool) -> Rolled:
    weights = tiny.random_params(5)
    key = jax.random.key(1)
    before, _ = act(weights, begin(jax.random.key(0)), jax.random.fold_in(key, 0), coin)
    after, rollout = act(weights, before, jax.random.fold_in(key, 1), coin)
    return jax.tree.map(np.asarray, Rolled(weights, before, after, *rollout))


class Retraced(NamedTuple):
    """Results of the plain loop: leaves [T, SLOTS], and parts of the last agents as lists [SLOTS]."""

    layout_weights: np.ndarray
    value: np.ndarray
    log_prob: np.ndarray
    next_value: np.ndarray
    layout: list[Any]
    memory: list[PolicyState]


@functools.cache
def retrace(coin: bool) -> Retraced:
    """Walk along the recorded actions, one episode slot after the other."""
    run = rolled(coin)
    shape = (LENGTH, SLOTS)
    value, log_prob, next_value = np.zeros((3, *shape), np.float32)
    retraced = Retraced(np.zeros((*shape, 3), np.float32), value, log_prob, next_value, [], [])
    for slot in range(SLOTS):
        _retrace_slot(run, retraced, slot)

    # Within an episode the next value is that of the next step, or that of the agent after the rollout.
    after = run.after
    for slot in range(SLOTS):
        row = ROWS[after.state.pose[slot]]
        goal = after.state.goal[slot]
        weights = tiny.goal_weights(retraced.layout[slot], goal)
        last_decision, _ = tiny.decide(run.weights, row, goal, weights, retraced.memory[slot])
        values = np.append(retraced.value[1:, slot], last_decision.value)
        goes_on = ~(run.transitions.terminated | run.transitions.truncated)[:, slot]
        retraced.next_value[goes_on, slot] = values[goes_on]
    return retraced


def _retrace_slot(run: Rolled, retraced: Retraced, slot: int) -> None:
    """Fill a column of the results, and append the last belief and memory."""
    layout = tiny.leaves_at(run.before.perception.layout, slot)
    memory = tiny.leaves_at(run.before.memory, slot)
    for time in range(LENGTH):
        # The decision.
        now = tiny.leaves_at(run.transitions, time, slot)
        weights = tiny.goal_weights(layout, now.goal)
        factual, counterfactual = tiny.decide(run.weights, ROWS[now.pose], now.goal, weights, memory)
        decision = factual if now.use_direct is None or now.use_direct else counterfactual
        retraced.layout_weights[time, slot] = weights
        retraced.value[time, slot] = decision.value
        retraced.log_prob[time, slot] = jax.nn.log_softmax(decision.logits)[now.action]

        # The recorded action.
        memory = decision.next_state(jnp.int32(now.action))
        pose = SUCCESSOR[now.pose, now.action]
        ended = now.terminated | now.truncated
        if now.truncated:  # the value of the cut state, with its own belief and memory
            last_layout = tiny.believe(PRIORS[PARAMS.room[SCENE[pose]]], layout, ROWS[pose])
            last_weights = tiny.goal_weights(last_layout, now.goal)
            last_decision, _ = tiny.decide(run.weights, ROWS[pose], now.goal, last_weights, memory)
            retraced.next_value[time, slot] = last_decision.value
        if ended:
            layout = None
            memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))

        # The next view; after an ending, that of the next episode's start.
        next_pose = run.transitions.pose[time + 1, slot] if time + 1 < LENGTH else run.after.state.pose[slot]
        assert ended or next_pose == pose
        layout = tiny.believe(PRIORS[PARAMS.room[SCENE[next_pose]]], layout, ROWS[next_pose])

    retraced.layout.append(layout)
    retraced.memory.append(memory)
