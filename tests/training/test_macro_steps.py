"""Macro-steps: only steps with a decision train the policy, and a policy learns where to search."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import AGENT_LOOP, ENVS, LENGTH, PARAMS, record_rollout
from support.scenes import CATEGORIES, corridor_scene

from jaxnav.env.make import build_environment
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.semexp import SEMEXP, learn_search_setup
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Task
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, ppo_loss, replay_rollout

#: A corridor of 10 m with a book at its north end.
CORRIDOR = corridor_scene(40)
BANK = compile_bank([CORRIDOR], Task(CATEGORIES))
#: So many actions suffice to search in one direction, but not in both directions.
LIMIT = 26


@pytest.mark.slow
def test_steps_without_a_decision_do_not_train_the_policy():
    """Choices and advantages of steps without a decision change no gradient; only the value learns from all steps."""
    recorded = record_rollout(False)
    is_decision = jnp.asarray(np.random.default_rng(0).random((LENGTH, ENVS)) < 0.3)
    advantage = np.random.default_rng(1).normal(size=(LENGTH, ENVS)).astype(np.float32)
    transitions = jax.tree.map(jnp.asarray, recorded.transitions)._replace(is_decision_step=is_decision)

    @jax.jit
    def loss_and_gradient(weights, transitions, advantage):
        def policy_loss(weights):
            replay = replay_rollout(AGENT_LOOP.bind(weights), transitions, recorded.memory, PARAMS)
            return ppo_loss(replay, advantage, PPOConfig(value=0.0).scalars(1), True, SEMEXP)[0]

        return jax.value_and_grad(policy_loss)(weights)

    # Other choices, probabilities and advantages at steps without a decision have no effect.
    expected = loss_and_gradient(recorded.weights, transitions, jnp.asarray(advantage))
    changed_transitions = transitions._replace(
        choice=jnp.where(is_decision, transitions.choice, 0),
        log_prob=jnp.where(is_decision, transitions.log_prob, -9.0),
    )
    result = loss_and_gradient(recorded.weights, changed_transitions, jnp.where(is_decision, advantage, 9.0))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7), result, expected)

    # Negative control: if every step is a decision, the loss differs.
    all_decisions = transitions._replace(is_decision_step=None)
    full_loss, _ = loss_and_gradient(recorded.weights, all_decisions, jnp.asarray(advantage))
    assert abs(float(full_loss - expected[0])) > 1e-4


@pytest.mark.exhaustive
@pytest.mark.usefixtures("optimised")
def test_a_policy_learns_where_to_search():
    """The book is always north; a random choice goes south as often, and finds the book too late.

    Without learning (a rate of 0) 43 % of the episodes succeed, with the usual rate 62 %: a difference of 0.19 between
    1,700 episodes each, whose drawing alone has a standard error of 0.017.
    """
    untrained_success = _train_success(0.0, 20)
    trained_success = _train_success(PPOConfig().learning_rate, 60)
    assert trained_success > untrained_success + 0.1


def _train_success(learning_rate: float, num_updates: int) -> float:
    """Train a policy in the corridor, and return the success rate in the last 20 updates."""
    # The corridor, and the knowledge of the method SemExp about it.
    env, params = build_environment(BANK, {}, LIMIT)
    knowledge = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_search_setup([BANK], np.zeros(0))))

    # A learner without any counterfactual loss.
    spec = dataclasses.replace(tiny.SPEC, method=find_method("semexp"), method_sizes=())
    config = PPOConfig(num_envs=ENVS, rollout=LIMIT, epochs=4, minibatches=2, gamma=0.97, learning_rate=learning_rate)
    learner = Learner(AgentLoop(env, spec, tiny.ESTIMATOR), config, "none")

    # Chunks of 20 updates.
    state = jax.jit(learner.init)(jax.random.key(0), params, knowledge)
    train = jax.jit(functools.partial(learner.train, num_updates=20))
    metrics = {}
    for _ in range(num_updates // 20):
        state, metrics = train(state, config.scalars(num_updates), params, knowledge)
    return float(metrics["success"])
