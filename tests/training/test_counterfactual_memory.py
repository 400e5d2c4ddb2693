"""A counterfactual branch with its own memory: the inputs that reach this memory, and its replay in training."""

import dataclasses
import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS, changed_parts, collect_rollouts

from jaxnav.causal import do
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind
from jaxnav.policies.pathways import Pathways
from jaxnav.training import ppo
from jaxnav.training.config import PPOConfig

OWN_MEMORY_SPEC = dataclasses.replace(tiny.SPEC, counterfactual_memory="own")
NUM_STEPS = 9
BATCH_SIZE = 16


def random_pathways(policy, rng, num_steps=NUM_STEPS):
    """Random embeddings, leaves [T, B, ...]."""
    embeddings = []
    for width in policy.widths[:3]:
        embeddings.append(jnp.asarray(rng.normal(size=(num_steps, BATCH_SIZE, width)), jnp.float32))
    scene, goal, experience = embeddings
    return Pathways(scene, goal, experience, jnp.ones((num_steps, BATCH_SIZE, 1)))


def decide_step_by_step(policy, pathways, actions, start=0):
    """Decisions of an episode, a list of T, from pathways [T, B, ...] and actions int32 [T, B]."""
    memory = policy.initial_memory((BATCH_SIZE,))
    decisions = []
    for time in range(start, len(actions)):
        decision = policy.decide(tiny.leaves_at(pathways, time), memory)
        decisions.append(decision)
        memory = decision.next_state(actions[time])
    return decisions


@pytest.fixture(scope="module")
def policy():
    return bind(OWN_MEMORY_SPEC, tiny.random_params(4))


@pytest.fixture(scope="module")
def actions():
    return jnp.asarray(np.random.default_rng(1).integers(0, 6, (NUM_STEPS, BATCH_SIZE)), jnp.int32)


@pytest.mark.slow
def test_own_memory_equals_the_factual_memory_if_scene_and_goal_are_always_zero(policy, actions):
    pathways = do(random_pathways(policy, np.random.default_rng(0)), scene=0.0, goal=0.0)
    for decision in decide_step_by_step(policy, pathways, actions):
        chex.assert_trees_all_equal(decision.counterfactual_hidden, decision.hidden)


def test_own_memory_equals_that_of_a_network_that_never_received_scene_and_goal(policy, actions):
    pathways = random_pathways(policy, np.random.default_rng(0))
    factual_policy = bind(tiny.SPEC, tiny.random_params(4))
    expected_decisions = decide_step_by_step(factual_policy, do(pathways, scene=0.0, goal=0.0), actions)
    decisions = decide_step_by_step(policy, pathways, actions)
    for decision, expected in zip(decisions, expected_decisions, strict=True):
        chex.assert_trees_all_equal(decision.counterfactual_hidden, expected.hidden)
        assert np.abs(decision.counterfactual_hidden - decision.hidden).max() > 0.1


def test_only_experience_and_actions_reach_the_own_memory(policy, actions):
    rng = np.random.default_rng(0)
    pathways = random_pathways(policy, rng)
    other_pathways = random_pathways(policy, rng)
    last_decision = decide_step_by_step(policy, pathways, actions)[-1]

    # Another scene and goal leave the own memory as it is. Negative control: the factual memory changes.
    other_scene = do(pathways, scene=other_pathways.scene, goal=other_pathways.goal)
    scene_decision = decide_step_by_step(policy, other_scene, actions)[-1]
    chex.assert_trees_all_equal(scene_decision.counterfactual_hidden, last_decision.counterfactual_hidden)
    assert np.abs(scene_decision.hidden - last_decision.hidden).max() > 0.1

    # Negative controls: the own memory changes with experience and with actions.
    other_experience = do(pathways, experience=other_pathways.experience)
    experience_decision = decide_step_by_step(policy, other_experience, actions)[-1]
    action_decision = decide_step_by_step(policy, pathways, (actions + 1) % 6)[-1]
    for decision in (experience_decision, action_decision):
        assert np.abs(decision.counterfactual_hidden - last_decision.counterfactual_hidden).max() > 0.01


def test_policies_have_no_second_memory_by_default():
    factual_policy = bind(tiny.SPEC, tiny.random_params(4))
    memory = factual_policy.initial_memory((3,))
    assert memory.counterfactual_hidden is None
    assert memory.counterfactual_state() is memory
    own_memory = bind(OWN_MEMORY_SPEC, tiny.random_params(4)).initial_memory((3,))
    np.testing.assert_array_equal(own_memory.counterfactual_hidden, np.zeros((3, tiny.SIZES.hidden)))


def test_policy_spec_refuses_an_own_memory_of_two_streams():
    with pytest.raises(ValueError, match="counterfactual_memory is 'own', but two streams"):
        dataclasses.replace(tiny.STREAMS, counterfactual_memory="own")


# Training


@functools.cache
def collect_two_rollouts(method_name, counterfactual_memory="own"):
    """An agent loop, the weights of a policy, two rollouts in a row, and the agent after the second rollout.

    The second rollout begins within episodes.
    """
    spec = dataclasses.replace(
        tiny.SPEC,
        method=find_method(method_name),
        method_sizes=(),
        counterfactual_memory=counterfactual_memory,
    )
    agent_loop = AgentLoop(ENV, spec, tiny.ESTIMATOR)
    weights = tiny.random_params(3, spec)
    agents, rollouts = collect_rollouts(agent_loop, weights, seeds=range(2))
    return agent_loop, weights, rollouts, agents[-1]


def replay_as(replay_decisions: Any, agent_loop: AgentLoop, weights: Any, rollout: Any) -> Any:
    """Factual and counterfactual decisions of a rollout by a replay function, parallel or step by step."""
    policy = agent_loop.bind(weights)
    observation = ppo.Observation(PARAMS.tables.rows[rollout.transitions.pose], rollout.transitions.goal)
    inputs = ppo.PolicyInputs(observation, rollout.transitions.layout_weights)
    return replay_decisions(policy, policy.encode(inputs), rollout.transitions, rollout.initial_memory)


def distil_loss(decisions):
    """Sum of the divergences of the counterfactual decisions from the fixed factual ones."""
    factual, counterfactual = decisions
    target = jax.lax.stop_gradient(jax.nn.log_softmax(factual.logits))
    return (jnp.exp(target) * (target - jax.nn.log_softmax(counterfactual.logits))).sum()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["own", "factual"])
@pytest.mark.parametrize(
    "method_name", ["org", pytest.param("support.methods:ATTENTIVE", marks=pytest.mark.exhaustive)]
)
def test_parallel_and_stepwise_replay_agree_in_decisions_and_gradients(method_name, kind):
    agent_loop, weights, rollouts, _ = collect_two_rollouts(method_name, kind)
    rollout = rollouts[1]
    assert rollout.transitions.ended[:-1].sum() > 20

    def compute_gradients(replay_decisions):
        """Gradient and logits of the distillation loss, and the gradient of a loss on the factual decisions."""

        def distillation_loss(weights):
            decisions = replay_as(replay_decisions, agent_loop, weights, rollout)
            return distil_loss(decisions), [decision.logits for decision in decisions]

        def factual_loss(weights):
            factual, _ = replay_as(replay_decisions, agent_loop, weights, rollout)
            return jnp.square(factual.logits).mean() + jnp.square(factual.value).mean()

        @jax.jit
        def compute(weights):
            return *jax.grad(distillation_loss, has_aux=True)(weights), jax.grad(factual_loss)(weights)

        return compute(weights)

    results = [compute_gradients(ppo._replay_in_parallel), compute_gradients(ppo._replay_step_by_step)]
    chex.assert_trees_all_close(*results, rtol=1e-3, atol=1e-5)

    # Distillation trains no parameters that only the direct pathways use.
    gradient, *_ = results[0]
    trained_parts = changed_parts(jax.tree.map(jnp.zeros_like, gradient), gradient)
    assert trained_parts >= {"method", "core", "actor", "fuse"}
    assert not trained_parts & {"view", "sought", "critic"}


@pytest.mark.slow
@pytest.mark.parametrize("method_name", ["org", "support.methods:ATTENTIVE"])
def test_replay_repeats_the_memory_of_the_rollout(method_name):
    agent_loop, weights, rollouts, last_agent = collect_two_rollouts(method_name)
    memories = [rollouts[0].initial_memory, rollouts[1].initial_memory, last_agent.memory]
    for rollout, next_memory in zip(rollouts, memories[1:], strict=True):
        _, counterfactual = replay_as(ppo._replay_in_parallel, agent_loop, weights, rollout)
        has_ended = rollout.transitions.ended[-1][:, None]
        expected = np.where(has_ended, 0.0, counterfactual.hidden[-1])
        np.testing.assert_allclose(next_memory.counterfactual_hidden, expected, atol=1e-5)
    assert np.abs(memories[-1].counterfactual_hidden - memories[-1].hidden).max() > 0.1


@pytest.mark.slow
def test_actions_and_factual_decisions_do_not_depend_on_the_kind_of_memory():
    results = []
    for kind in ("factual", "own"):
        agent_loop, weights, rollouts, _ = collect_two_rollouts("org", kind)
        factual, counterfactual = replay_as(ppo._replay_in_parallel, agent_loop, weights, rollouts[1])
        results.append((rollouts[1].transitions, factual.logits, counterfactual.logits))
    factual_kind, own_kind = results
    chex.assert_trees_all_equal(factual_kind[:2], own_kind[:2])
    assert np.abs(factual_kind[2] - own_kind[2]).max() > 0.01


@pytest.mark.slow
def test_distillation_along_the_own_memory_lowers_its_divergence():
    agent_loop, _, _, _ = collect_two_rollouts("org")
    learner = ppo.Learner(agent_loop, PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=4), "distil")
    state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    scalars = learner.config.scalars(12).replace(distil_weight=jnp.float32(5.0))
    update = jax.jit(learner.update)
    losses = []
    for _ in range(12):
        state, metrics = update(state, scalars, PARAMS, KNOWLEDGE)
        losses.append(float(metrics["distil_loss"]))
    assert np.isfinite(losses).all()
    assert losses[-1] < 0.5 * max(losses)
