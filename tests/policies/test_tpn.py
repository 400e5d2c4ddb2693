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
from support.rollouts import ENV, ENVS, LENGTH, PARAMS

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

HIDDEN, BATCH = tiny.SIZES.hidden, 32
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("tpn"))
ACTING = AgentLoop(ENV, SPEC, tiny.ESTIMATOR)
LEARN, IMITATE = METHODS["tpn"].stages


KNOWN = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_motion([tiny.BANK], np.zeros(0))))


# Past trials


@functools.cache
def tentative(kind: type[TentativePolicy] = TentativePolicy) -> Any:
    return kind(SPEC, 16, nnx.Rngs(params=3))


def remembered(network, hidden, actions):
    """The trials after hidden states [M, H] and actions [M]."""
    trials = jnp.zeros((NUM_TRIALS, HIDDEN + NUM_ACTIONS))
    for state, action in zip(hidden, actions, strict=True):
        trials = network.remember(trials, state, action)
    return trials


@pytest.mark.slow
def test_the_trial_in_the_same_state_is_retrieved():
    draws, count = np.random.default_rng(0), 40
    hidden = jnp.asarray(draws.uniform(-1, 1, (count, HIDDEN)), jnp.float32)
    actions = jnp.asarray(draws.integers(0, NUM_ACTIONS, count))
    network = tentative()
    trials = remembered(network, hidden, actions)
    attention = jax.vmap(lambda h: network.attention(network.state(h), trials, jnp.int32(count)))(hidden)
    np.testing.assert_allclose(attention.sum(axis=1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(attention.argmax(axis=1), NUM_TRIALS - count + np.arange(count))
    assert attention.max(axis=1).min() > 0.3
    assert set((np.asarray(attention) > 0).sum(axis=1)) == {NUM_ATTENDED}
    # What was done there decides what is predicted.
    others = remembered(network, hidden, (actions + 1) % NUM_ACTIONS)
    predict = jax.vmap(lambda h, t: network(h, t, jnp.int32(count)), (0, None))
    assert np.abs(predict(hidden, trials) - predict(hidden, others)).max(axis=1).min() > 1e-3


def test_without_a_choice_all_trials_are_attended_to_equally():
    network, hidden = tentative(UniformTentativePolicy), jnp.linspace(-1, 1, 3 * HIDDEN).reshape(3, HIDDEN)
    trials = remembered(network, hidden, jnp.arange(3))
    attention = network.attention(network.state(hidden[0]), trials, jnp.int32(3))
    np.testing.assert_allclose(attention, [0.0] * (NUM_TRIALS - 3) + [1 / 3] * 3, rtol=1e-6)


# The step


def given(spec, decisions=7, seed=0):
    """A policy, pathways at poses half of which are repeated, and memories that have changed the actor."""
    draws = np.random.default_rng(seed)
    policy = bind(spec, tiny.random_params(seed, spec))
    row = jnp.asarray(tiny.BANK.rows[draws.integers(0, len(tiny.BANK.rows), BATCH)])
    goal = jnp.asarray(draws.integers(0, tiny.SPEC.num_categories, BATCH))
    reading = jnp.arange(BATCH) % 2 == 0
    memory: PolicyState = policy.initial_memory((BATCH,))
    fast = memory.fast._replace(
        actor_change=jnp.asarray(draws.normal(size=memory.fast.actor_change.shape), jnp.float32),
        num_decisions=jnp.full(BATCH, decisions, jnp.int32),
    )
    hidden = jnp.asarray(draws.uniform(-1, 1, memory.hidden.shape), jnp.float32)
    memory = memory._replace(hidden=hidden, action=jnp.arange(BATCH) % NUM_ACTIONS, fast=fast)
    inputs = PolicyInputs(Observation(row, goal), jnp.ones((BATCH, tiny.SPEC.num_categories)), reading)
    pathways = policy.pathways(inputs)
    return policy, pathways, memory


@pytest.mark.parametrize(
    "options",
    [{}, {"done_gate": True}, {"decision": "streams", "direct": "goal"}],
)
@pytest.mark.slow
def test_the_step_descends_the_cross_entropy_at_repeated_poses(options):
    policy, pathways, memory = given(dataclasses.replace(SPEC, **options))
    if "decision" in options:  # where experience is, no gradient is let through, though the step is the same
        pathways = do(pathways, experience=0.0)
    decision = policy.decide(pathways, memory)
    best = decision.fast.predicted_logits.argmax(axis=-1)

    def cross_entropy(change):
        log_pi = jax.nn.log_softmax(policy.decide_with_changes(pathways, memory, make_layer_changes(change)).logits)
        return -jnp.take_along_axis(log_pi, best[:, None], axis=-1).sum()

    gradient = jax.grad(cross_entropy)(memory.fast.actor_change)
    repeated = np.asarray(pathways.reading)
    moved = np.asarray(decision.fast.actor_change - memory.fast.actor_change)
    np.testing.assert_allclose(moved[repeated], -0.1 * np.asarray(gradient)[repeated], rtol=1e-3, atol=1e-6)
    assert np.abs(moved[repeated]).max(axis=(1, 2)).min() > 1e-6
    assert not moved[~repeated].any()


def test_the_actor_is_renewed():
    for decisions, is_kept in ((49, True), (50, False), (0, False)):
        policy, pathways, memory = given(SPEC, decisions)
        decision = policy.decide(pathways, memory)
        expected = policy.decide_with_changes(
            pathways, memory, make_layer_changes(memory.fast.actor_change) if is_kept else NO_CHANGES
        )
        np.testing.assert_allclose(decision.logits, expected.logits, rtol=1e-5, atol=1e-5)
        unrepeated = ~np.asarray(pathways.reading)
        assert np.asarray(decision.fast.actor_change)[unrepeated].any() == is_kept


def test_an_agent_that_does_not_try_decides_plainly():
    for acting in (
        dataclasses.replace(ACTING, inner_steps=0),
        dataclasses.replace(
            ACTING, spec=dataclasses.replace(SPEC, method=find_method("jaxnav.policies.methods.tpn:UNTRIED"))
        ),
    ):
        policy, (_, pathways, memory) = acting.bind(tiny.random_params(0, SPEC)), given(SPEC)
        memory = memory._replace(fast=memory.fast._replace(actor_change=jnp.zeros_like(memory.fast.actor_change)))
        decision = policy.decide(pathways, memory)
        chex.assert_trees_all_equal(decision.fast.actor_change, memory.fast.actor_change)
        np.testing.assert_allclose(decision.logits, policy.decide_with_changes(pathways, memory).logits, atol=1e-6)
    assert not dataclasses.replace(ACTING, inner_steps=0).bind(tiny.random_params(0, SPEC)).needs_stepwise_replay


# Training


def learner(stage, **settings):
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=2, learning_rate=3e-3, **settings)
    return Learner(ACTING, config, "distil", stage)


@pytest.fixture(scope="module")
def params():
    return PARAMS.replace(tables=PARAMS.tables.replace(expert=jnp.asarray(tiny.BANK.expert)))


def moved(before, after):
    """Which parts of the parameters differ, that of the method by its own parts."""
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), before, after)
    changed |= {f"method.{name}": part for name, part in changed.pop("method").items()}
    return {name for name, part in changed.items() if any(jax.tree.leaves(part))}


@pytest.mark.slow
def test_the_first_stage_is_orgs_and_the_second_teaches_the_tentative_policy_alone(params):
    scalars = PPOConfig().scalars(4)
    begin = jax.jit(learner(LEARN).init)(jax.random.key(0), params, KNOWN)
    middle, _ = jax.jit(learner(LEARN).update)(begin, scalars, params, KNOWN)
    assert {"actor", "core", "method.maps"} <= moved(begin.params, middle.params)
    assert "method.tentative" not in moved(begin.params, middle.params)
    chex.assert_trees_all_equal(policy_memory(middle.agent).fast, policy_memory(begin.agent).fast)
    # No gradient reaches the rest, even where all of it might be trained.
    open_to_all = dataclasses.replace(IMITATE, lr_scale_by_path=None)
    after, metrics = jax.jit(learner(open_to_all).update)(begin, scalars, params, KNOWN)
    assert moved(begin.params, after.params) == {"method.tentative"}
    chex.assert_trees_all_equal_shapes_and_dtypes(begin, middle, after)
    assert 0.05 < metrics["repeated"] < 0.95


@pytest.mark.slow
def test_the_tentative_policy_learns_what_shortest_paths_do(params):
    config = learner(IMITATE).config
    train = jax.jit(learner(IMITATE).train, static_argnums=4)
    before = jax.jit(learner(IMITATE).init)(jax.random.key(0), params, KNOWN)
    state, first = train(before, config.scalars(400), params, KNOWN, 50)
    after, last = train(state, config.scalars(400), params, KNOWN, 50)
    assert last["imitation_loss"] < 0.9 * first["imitation_loss"]
    assert last["imitation_agreement"] / last["repeated"] > 1.1 * first["imitation_agreement"] / first["repeated"]
    assert moved(before.params, after.params) == {"method.tentative"}
    # Negative control: an expert that does anything is not to be learned.
    anything = jax.random.randint(jax.random.key(1), tiny.BANK.expert.shape, 0, NUM_ACTIONS).astype(jnp.uint8)
    false = params.replace(tables=params.tables.replace(expert=anything))
    _, control = train(state, config.scalars(400), false, KNOWN, 50)
    assert control["imitation_loss"] / control["repeated"] > 1.5 * last["imitation_loss"] / last["repeated"]


@pytest.mark.slow
def test_replay_decides_and_adapts_as_the_rollout_did():
    weights = tiny.random_params(3, SPEC)

    @jax.jit
    def go():
        policy = ACTING.bind(weights)
        agent = ACTING.start(jax.random.key(0), ENVS, policy.initial_memory((ENVS,)), KNOWN, PARAMS)
        agent, _ = collect_rollout(ACTING, policy, agent, jax.random.key(1), PARAMS, KNOWN, num_steps=LENGTH)
        agent, rollout = collect_rollout(ACTING, policy, agent, jax.random.key(2), PARAMS, KNOWN, num_steps=LENGTH)
        return agent, rollout, replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS).factual

    agent, rollout, again = go()
    transitions = rollout.transitions
    log_pi = jax.nn.log_softmax(again.logits)
    log_prob = jnp.take_along_axis(log_pi, transitions.choice[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(log_prob, transitions.log_prob, rtol=1e-4, atol=1e-4)
    running = ~np.asarray(transitions.ended[-1])
    change = np.asarray(policy_memory(agent).fast.actor_change)
    np.testing.assert_allclose(change[running], np.asarray(again.fast.actor_change[-1])[running], rtol=1e-3, atol=1e-4)
    assert np.abs(change[running]).max() > 0.01
    assert not change[~running].any()
