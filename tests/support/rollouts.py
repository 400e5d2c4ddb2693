"""Rollouts in the small world, and a plain loop that goes along them decision by decision."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.policies.acting import Acting
from jaxnav.policies.pathways import NO_ACTION, Memory
from jaxnav.training.collect import collect
from jaxnav.training.config import PPOConfig
from jaxnav.training.learner import Learner
from jaxnav.training.loss import replay
from support import tiny_world as tiny

ENVS, LENGTH = 64, tiny.LIMITS[0]
SLOTS = 20  # that the plain loop goes through
ENV, PARAMS = tiny.world()
KNOWLEDGE = tiny.knowledge()
PRIORS = KNOWLEDGE.layout
ACTING = Acting(ENV, tiny.SPEC, tiny.SETTING)
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
LEARNER = Learner(acting=ACTING, config=CONFIG, counterfactual="distil")
ROWS, SUCCESSOR = tiny.BANK.rows, tiny.BANK.successor
SCENE = np.repeat([0, 1], tiny.BANK.num_cells * tiny.POSES_PER_CELL)  # of each pose


@functools.partial(jax.jit, static_argnums=(3, 4))
def act(weights, agent, key, coin, acting=ACTING):
    """The agent after a rollout, and the rollout."""
    return collect(acting, acting.bind(weights), agent, key, LENGTH, coin, PARAMS, KNOWLEDGE)


@functools.partial(jax.jit, static_argnums=1)
def begin(key, acting=ACTING):
    memory = acting.bind(tiny.lively(0)).initial_memory((ENVS,))
    return acting.start(key, ENVS, memory, KNOWLEDGE, PARAMS)


@jax.jit
def decide_again(weights, transitions, memory):
    """The factual and the counterfactual decisions."""
    replayed = replay(ACTING.bind(weights), transitions, memory, PARAMS)
    return replayed.decisions, replayed.counterfactual


class Rolled(NamedTuple):
    """Hold a rollout that goes on from another, so that its episodes begin at all times.

    Attributes:
      weights: of the policy.
      before, after: the `Agent` before and after it.
      transitions: `Transition`, leaves [T, B].
      memory: `Memory` before the first step.
      next_value: float32 [T, B].

    All leaves are NumPy arrays, which the types of the library do not name.
    """

    weights: dict[str, Any]
    before: Any
    after: Any
    transitions: Any
    memory: Any
    next_value: np.ndarray


@functools.cache
def rolled(coin: bool) -> Rolled:
    weights, key = tiny.lively(5), jax.random.key(1)
    agent = begin(jax.random.key(0))
    before, (agent, _) = agent, act(weights, agent, jax.random.fold_in(key, 0), coin)
    before, (agent, rollout) = agent, act(weights, agent, jax.random.fold_in(key, 1), coin)
    return jax.tree.map(np.asarray, Rolled(weights, before, agent, *rollout))


class Retraced(NamedTuple):
    """What the plain loop finds: leaves [T, SLOTS], and the last agent's parts as lists [SLOTS]."""

    weights: np.ndarray
    value: np.ndarray
    log_prob: np.ndarray
    next_value: np.ndarray
    layout: list[Any]
    memory: list[Memory]


@functools.cache
def retrace(coin: bool) -> Retraced:
    """Walk along the recorded actions, one episode slot after the other."""
    run = rolled(coin)
    shape = (LENGTH, SLOTS)
    value, log_prob, next_value = np.zeros((3, *shape), np.float32)
    retraced = Retraced(np.zeros((*shape, 3), np.float32), value, log_prob, next_value, [], [])
    for slot in range(SLOTS):
        layout, memory = tiny.at(run.before.perceived.layout, slot), tiny.at(run.before.memory, slot)
        for time in range(LENGTH):
            now = tiny.at(run.transitions, time, slot)
            weights = tiny.goal_weights(layout, now.goal)
            factual, counterfactual = tiny.decide(run.weights, ROWS[now.pose], now.goal, weights, memory)
            decision = factual if now.direct is None or now.direct else counterfactual
            retraced.weights[time, slot], retraced.value[time, slot] = weights, decision.value
            retraced.log_prob[time, slot] = jax.nn.log_softmax(decision.logits)[now.action]

            memory = decision.memory(jnp.int32(now.action))
            pose, ended = SUCCESSOR[now.pose, now.action], now.terminated | now.truncated
            if now.truncated:  # the value of the cut state, with its own belief and memory
                last = tiny.believe(PRIORS[PARAMS.room[SCENE[pose]]], layout, ROWS[pose])
                cut = tiny.decide(run.weights, ROWS[pose], now.goal, tiny.goal_weights(last, now.goal), memory)[0]
                retraced.next_value[time, slot] = cut.value
            if ended:
                layout, memory = None, Memory(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
            next_pose = (
                run.transitions.pose[time + 1, slot] if time + 1 < LENGTH else run.after.state.pose[slot]
            )  # after an ending, the start of the next episode
            assert ended or next_pose == pose
            layout = tiny.believe(PRIORS[PARAMS.room[SCENE[next_pose]]], layout, ROWS[next_pose])
        retraced.layout.append(layout)
        retraced.memory.append(memory)
    after = run.after
    for slot in range(SLOTS):
        weights = tiny.goal_weights(retraced.layout[slot], after.state.goal[slot])
        row, goal = ROWS[after.state.pose[slot]], after.state.goal[slot]
        values = np.append(
            retraced.value[1:, slot], tiny.decide(run.weights, row, goal, weights, retraced.memory[slot])[0].value
        )
        goes_on = ~(run.transitions.terminated | run.transitions.truncated)[:, slot]
        retraced.next_value[goes_on, slot] = values[goes_on]
    return retraced
