"""ORG+TPN: what is remembered of past trials, the step that the actor takes, and the stages of training."""

import dataclasses
import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, LENGTH, PARAMS, changed_parts, choice_log_probs

from jaxnav.causal import do
from jaxnav.env.objectnav import Observation
from jaxnav.policies.agent_loop import AgentLoop, policy_memory
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.methods.tpn import (
    NUM_ATTENDED,
    NUM_TRIALS,
    TentativePolicy,
    UniformTentativePolicy,
    learn_motion,
    make_layer_changes,
)
from jaxnav.policies.network import NO_CHANGES, bind
from jaxnav.policies.pathways import PolicyInputs, PolicyState
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, collect_rollout, replay_rollout

HIDDEN_SIZE = tiny.SIZES.hidden
BATCH_SIZE = 32
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("tpn"))
UNTRIED_SPEC = dataclasses.replace(SPEC, method=find_method("jaxnav.policies.methods.tpn:UNTRIED"))
AGENT_LOOP = AgentLoop(ENV, SPEC, tiny.ESTIMATOR)
MAIN_STAGE, IMITATION_STAGE = METHODS["tpn"].stages
KNOWLEDGE = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_motion([tiny.BANK], np.zeros(0))))


# Past trials


@functools.cache
def make_tentative_policy(policy_class: type[TentativePolicy] = TentativePolicy) -> Any:
    return policy_class(SPEC, 16, nnx.Rngs(params=3))


def remember_trials(tentative_policy, hidden, actions):
    """The trials after hidden states [M, H] and actions [M]."""
    trials = jnp.zeros((NUM_TRIALS, HIDDEN_SIZE + NUM_ACTIONS))
    for hidden_state, action in zip(hidden, actions, strict=True):
        trials = tentative_policy.remember(trials, hidden_state, action)
    return trials


@pytest.mark.slow
def test_tentative_policy_attends_to_the_trial_in_the_same_state():
    rng = np.random.default_rng(0)
    num_trials = 40
    hidden = jnp.asarray(rng.uniform(-1, 1, (num_trials, HIDDEN_SIZE)), jnp.float32)
    actions = jnp.asarray(rng.integers(0, NUM_ACTIONS, num_trials))
    tentative_policy = make_tentative_policy()
    trials = remember_trials(tentative_policy, hidden, actions)

    # Each state attends to a few trials, and most to its own.
    @jax.vmap
    def attend(hidden_state):
        return tentative_policy.attention(tentative_policy.state(hidden_state), trials, jnp.int32(num_trials))

    attention = attend(hidden)
    np.testing.assert_allclose(attention.sum(axis=1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(attention.argmax(axis=1), NUM_TRIALS - num_trials + np.arange(num_trials))
    assert attention.max(axis=1).min() > 0.3
    assert set((np.asarray(attention) > 0).sum(axis=1)) == {NUM_ATTENDED}

    # The actions of the trials decide what is predicted.
    @functools.partial(jax.vmap, in_axes=(0, None))
    def predict(hidden_state, trials):
        return tentative_policy(hidden_state, trials, jnp.int32(num_trials))

    other_trials = remember_trials(tentative_policy, hidden, (actions + 1) % NUM_ACTIONS)
    change = np.abs(predict(hidden, trials) - predict(hidden, other_trials))
    assert change.max(axis=1).min() > 1e-3


def test_uniform_tentative_policy_attends_to_all_trials_equally():
    tentative_policy = make_tentative_policy(UniformTentativePolicy)
    hidden = jnp.linspace(-1, 1, 3 * HIDDEN_SIZE).reshape(3, HIDDEN_SIZE)
    trials = remember_trials(tentative_policy, hidden, jnp.arange(3))
    attention = tentative_policy.attention(tentative_policy.state(hidden[0]), trials, jnp.int32(3))
    np.testing.assert_allclose(attention, [0.0] * (NUM_TRIALS - 3) + [1 / 3] * 3, rtol=1e-6)


# The step


def random_policy_inputs(spec, num_decisions=7, seed=0):
    """A policy, pathways [BATCH_SIZE] at poses half of which are repeated, and memories with a changed actor."""
    rng = np.random.default_rng(seed)
    policy = bind(spec, tiny.random_params(seed, spec))
    row = jnp.asarray(tiny.BANK.rows[rng.integers(0, len(tiny.BANK.rows), BATCH_SIZE)])
    goal = jnp.asarray(rng.integers(0, tiny.SPEC.num_categories, BATCH_SIZE))
    is_repeated = jnp.arange(BATCH_SIZE) % 2 == 0

    memory: PolicyState = policy.initial_memory((BATCH_SIZE,))
    fast = memory.fast._replace(
        actor_change=jnp.asarray(rng.normal(size=memory.fast.actor_change.shape), jnp.float32),
        num_decisions=jnp.full(BATCH_SIZE, num_decisions, jnp.int32),
    )
    hidden = jnp.asarray(rng.uniform(-1, 1, memory.hidden.shape), jnp.float32)
    memory = memory._replace(hidden=hidden, action=jnp.arange(BATCH_SIZE) % NUM_ACTIONS, fast=fast)

    layout_weights = jnp.ones((BATCH_SIZE, tiny.SPEC.num_categories))
    pathways = policy.pathways(PolicyInputs(Observation(row, goal), layout_weights, is_repeated))
    return policy, pathways, memory


@pytest.mark.parametrize("options", [{}, {"done_gate": True}, {"decision": "streams", "direct": "goal"}])
@pytest.mark.slow
def test_actor_step_descends_the_cross_entropy_at_repeated_poses(options):
    policy, pathways, memory = random_policy_inputs(dataclasses.replace(SPEC, **options))
    if "decision" in options:  # where experience is, no gradient is let through, though the step is the same
        pathways = do(pathways, experience=0.0)
    decision = policy.decide(pathways, memory)
    predicted_action = decision.fast.predicted_logits.argmax(axis=-1)

    @jax.grad
    def cross_entropy_gradient(actor_change):
        changed_decision = policy.decide_with_changes(pathways, memory, make_layer_changes(actor_change))
        log_probs = jax.nn.log_softmax(changed_decision.logits)
        return -jnp.take_along_axis(log_probs, predicted_action[:, None], axis=-1).sum()

    # The learning rate is 0.1.
    is_repeated = np.asarray(pathways.reading)
    actor_step = np.asarray(decision.fast.actor_change - memory.fast.actor_change)
    gradient = np.asarray(cross_entropy_gradient(memory.fast.actor_change))
    np.testing.assert_allclose(actor_step[is_repeated], -0.1 * gradient[is_repeated], rtol=1e-3, atol=1e-6)
    assert np.abs(actor_step[is_repeated]).max(axis=(1, 2)).min() > 1e-6
    assert not actor_step[~is_repeated].any()


@pytest.mark.parametrize(("num_decisions", "is_kept"), [(49, True), (50, False), (0, False)])
def test_actor_change_is_reset_every_fifty_decisions(num_decisions, is_kept):
    policy, pathways, memory = random_policy_inputs(SPEC, num_decisions)
    decision = policy.decide(pathways, memory)
    layer_changes = make_layer_changes(memory.fast.actor_change) if is_kept else NO_CHANGES
    expected = policy.decide_with_changes(pathways, memory, layer_changes)
    np.testing.assert_allclose(decision.logits, expected.logits, rtol=1e-5, atol=1e-5)
    is_repeated = np.asarray(pathways.reading)
    assert np.asarray(decision.fast.actor_change)[~is_repeated].any() == is_kept


@pytest.mark.parametrize(
    "agent_loop",
    [dataclasses.replace(AGENT_LOOP, inner_steps=0), dataclasses.replace(AGENT_LOOP, spec=UNTRIED_SPEC)],
    ids=["no inner steps", "untried"],
)
def test_agent_without_trials_decides_without_changes(agent_loop):
    policy = agent_loop.bind(tiny.random_params(0, SPEC))
    _, pathways, memory = random_policy_inputs(SPEC)
    no_change = jnp.zeros_like(memory.fast.actor_change)
    memory = memory._replace(fast=memory.fast._replace(actor_change=no_change))
    decision = policy.decide(pathways, memory)
    plain_decision = policy.decide_with_changes(pathways, memory)
    chex.assert_trees_all_equal(decision.fast.actor_change, no_change)
    np.testing.assert_allclose(decision.logits, plain_decision.logits, atol=1e-6)


def test_policy_without_inner_steps_is_replayed_in_parallel():
    policy = dataclasses.replace(AGENT_LOOP, inner_steps=0).bind(tiny.random_params(0, SPEC))
    assert not policy.needs_stepwise_replay


# Training


def make_learner(stage):
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=2, learning_rate=3e-3)
    return Learner(AGENT_LOOP, config, "distil", stage)


@pytest.fixture(scope="module")
def params():
    """Parameters of the environment with the expert's actions."""
    return PARAMS.replace(tables=PARAMS.tables.replace(expert=jnp.asarray(tiny.BANK.expert)))


def changed_parts_of_method(params_before, params_after):
    """Names of the parts that differ, those of the method as `method.NAME`."""
    names = changed_parts(params_before, params_after) - {"method"}
    method_names = changed_parts(params_before["method"], params_after["method"])
    return names | {f"method.{name}" for name in method_names}


@pytest.mark.slow
def test_each_stage_of_tpn_trains_its_own_parameters(params):
    """The first stage trains as ORG does, the second the tentative policy alone."""
    scalars = PPOConfig().scalars(4)
    state = jax.jit(make_learner(MAIN_STAGE).init)(jax.random.key(0), params, KNOWLEDGE)
    main_state, _ = jax.jit(make_learner(MAIN_STAGE).update)(state, scalars, params, KNOWLEDGE)
    changed_by_main = changed_parts_of_method(state.params, main_state.params)
    assert {"actor", "core", "method.maps"} <= changed_by_main
    assert "method.tentative" not in changed_by_main
    chex.assert_trees_all_equal(policy_memory(main_state.agent).fast, policy_memory(state.agent).fast)

    # No gradient reaches other parameters, even where the stage would let all of them be trained.
    unrestricted_stage = dataclasses.replace(IMITATION_STAGE, lr_scale_by_path=None)
    unrestricted_update = jax.jit(make_learner(unrestricted_stage).update)
    imitation_state, metrics = unrestricted_update(state, scalars, params, KNOWLEDGE)
    assert changed_parts_of_method(state.params, imitation_state.params) == {"method.tentative"}
    chex.assert_trees_all_equal_shapes_and_dtypes(state, main_state, imitation_state)
    assert 0.05 < metrics["repeated"] < 0.95


@pytest.mark.slow
def test_tentative_policy_learns_the_actions_of_shortest_paths(params):
    learner = make_learner(IMITATION_STAGE)
    scalars = learner.config.scalars(400)
    train = jax.jit(learner.train, static_argnums=4)
    first_state = jax.jit(learner.init)(jax.random.key(0), params, KNOWLEDGE)
    middle_state, first_metrics = train(first_state, scalars, params, KNOWLEDGE, 50)
    last_state, last_metrics = train(middle_state, scalars, params, KNOWLEDGE, 50)

    # The loss falls and the agreement at repeated poses rises.
    first_agreement = first_metrics["imitation_agreement"] / first_metrics["repeated"]
    last_agreement = last_metrics["imitation_agreement"] / last_metrics["repeated"]
    assert last_metrics["imitation_loss"] < 0.9 * first_metrics["imitation_loss"]
    assert last_agreement > 1.1 * first_agreement
    assert changed_parts_of_method(first_state.params, last_state.params) == {"method.tentative"}

    # Negative control: a random expert is not to be learned.
    random_expert = jax.random.randint(jax.random.key(1), tiny.BANK.expert.shape, 0, NUM_ACTIONS).astype(jnp.uint8)
    random_params = params.replace(tables=params.tables.replace(expert=random_expert))
    _, random_metrics = train(middle_state, scalars, random_params, KNOWLEDGE, 50)
    random_loss = random_metrics["imitation_loss"] / random_metrics["repeated"]
    assert random_loss > 1.5 * last_metrics["imitation_loss"] / last_metrics["repeated"]


@pytest.mark.slow
def test_replay_of_tpn_recomputes_log_probs_and_actor_changes():
    weights = tiny.random_params(3, SPEC)

    @jax.jit
    def collect_and_replay():
        policy = AGENT_LOOP.bind(weights)
        memory = policy.initial_memory((ENVS,))
        agent = AGENT_LOOP.start(jax.random.key(0), ENVS, memory, KNOWLEDGE, PARAMS)
        for seed in (1, 2):
            agent, rollout = collect_rollout(
                AGENT_LOOP, policy, agent, jax.random.key(seed), PARAMS, KNOWLEDGE, num_steps=LENGTH
            )
        replayed = replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS)
        return agent, rollout, replayed.factual

    agent, rollout, decisions = collect_and_replay()
    transitions = rollout.transitions
    log_prob = choice_log_probs(decisions.logits, transitions.choice)
    np.testing.assert_allclose(log_prob, transitions.log_prob, rtol=1e-4, atol=1e-4)

    # The last change of the actor, which episodes that have ended begin without.
    running = ~np.asarray(transitions.ended[-1])
    actor_change = np.asarray(policy_memory(agent).fast.actor_change)
    replayed_change = np.asarray(decisions.fast.actor_change[-1])
    np.testing.assert_allclose(actor_change[running], replayed_change[running], rtol=1e-3, atol=1e-4)
    assert np.abs(actor_change[running]).max() > 0.01
    assert not actor_change[~running].any()
