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
from support.rollouts import ENV, ENVS, LENGTH, PARAMS, changed_parts, choice_log_probs, collect_rollouts

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
from jaxnav.policies.pathways import NO_ACTION, PolicyInputs, PolicyState
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, replay_rollout

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
    with jax.ensure_compile_time_eval():
        return policy_class(SPEC, 16, nnx.Rngs(params=3))


def draw_episode(num_decisions, seed=0):
    """Hidden states [T, H], and the actions between them [T - 1]."""
    rng = np.random.default_rng(seed)
    hidden = jnp.asarray(rng.uniform(-1, 1, (num_decisions, HIDDEN_SIZE)), jnp.float32)
    return hidden, jnp.asarray(rng.integers(0, NUM_ACTIONS, num_decisions - 1))


@jax.jit
def predict_along(hidden, actions):
    """Predicted logits [T, A] along an episode, and the values of the trials after it."""
    tentative_policy = make_tentative_policy()
    led_by = jnp.concatenate([jnp.array([NO_ACTION]), actions])

    def predict(trials, decision):
        logits, trials = tentative_policy(hidden[decision], led_by[decision], trials, decision)
        return trials, logits

    no_trials = jnp.zeros((NUM_TRIALS, HIDDEN_SIZE + NUM_ACTIONS))
    trials, logits = jax.lax.scan(predict, no_trials, jnp.arange(len(hidden)))
    return logits, trials


def released_memory(hidden, actions, *, value_offset=1, scale=1.0):
    """The answers [T, H + A] of the memory along an episode, by the released equations in float64.

    At decision t the keys are the states s_0, ..., s_{t-1} and the values (s_{i+1}, a_i); the softmax of the ten
    largest dot products with s_t mixes the values. Mistakes: `value_offset=0` takes (s_i, a_i), `scale` multiplies the
    scores.
    """
    states = np.asarray(jax.vmap(make_tentative_policy().state)(hidden), float)
    answers = np.zeros((len(states), HIDDEN_SIZE + NUM_ACTIONS))
    for time in range(1, len(states)):
        first = max(0, time - NUM_TRIALS)
        keys = states[first:time]
        next_states = states[first + value_offset : time + value_offset]
        values = np.hstack([next_states, np.eye(NUM_ACTIONS)[np.asarray(actions[first:time])]])

        scores = scale * keys @ states[time]
        most_similar = np.argsort(-scores)[:NUM_ATTENDED]
        attention = np.exp(scores[most_similar] - scores.max())
        answers[time] = attention / attention.sum() @ values[most_similar]
    return answers


def logits_of_answers(hidden, answers):
    """The logits that the network computes from answers of the memory, [T, A]."""
    tentative_policy = make_tentative_policy()
    state = tentative_policy.state(hidden)
    read_trials = tentative_policy.trial(jnp.asarray(answers, jnp.float32))
    return tentative_policy.expert(tentative_policy.both(jnp.concatenate([state, read_trials], axis=-1)))


@pytest.mark.slow
def test_memory_answers_as_the_released_one():
    """Along an episode longer than the memory: nothing at first, all trials up to ten, then the ten most similar."""
    hidden, actions = draw_episode(NUM_TRIALS + 30)
    logits, _ = predict_along(hidden, actions)
    expected = logits_of_answers(hidden, released_memory(hidden, actions))
    np.testing.assert_allclose(logits, expected, atol=2e-5)

    # Negative controls: the state before the action for the state after it, and scaled scores.
    for mistake in ({"value_offset": 0}, {"scale": HIDDEN_SIZE**-0.5}):
        mistaken = logits_of_answers(hidden, released_memory(hidden, actions, **mistake))
        assert np.median(np.abs(logits - mistaken).max(axis=1)) > 0.02


@pytest.mark.slow
def test_first_decision_of_an_episode_reads_nothing():
    hidden, actions = draw_episode(3)
    tentative_policy = make_tentative_policy()
    keys = jnp.ones((NUM_TRIALS, HIDDEN_SIZE))
    attention = tentative_policy.attention(tentative_policy.state(hidden[0]), keys, jnp.int32(0))
    np.testing.assert_array_equal(attention, np.zeros(NUM_TRIALS))

    # Whatever the memory still holds is not read.
    other_trials = jnp.full((NUM_TRIALS, HIDDEN_SIZE + NUM_ACTIONS), 7.0)
    logits, _ = tentative_policy(hidden[0], jnp.int32(NO_ACTION), other_trials, jnp.int32(0))
    np.testing.assert_allclose(logits, predict_along(hidden, actions)[0][0], atol=1e-5)


@pytest.mark.slow
def test_memory_retrieves_what_an_action_led_to():
    """A state that returns reads the next state and the action that followed its first visit."""
    hidden, actions = draw_episode(40)
    hidden = hidden.at[-1].set(hidden[17])
    answer = released_memory(hidden, actions)[-1]
    _, trials = predict_along(hidden, actions)
    tentative_policy = make_tentative_policy()
    state = tentative_policy.state(hidden[-1])
    keys = jnp.concatenate([jnp.zeros((1, HIDDEN_SIZE)), trials[:-1, :HIDDEN_SIZE]])
    attention = tentative_policy.attention(state, keys, jnp.int32(39))
    np.testing.assert_allclose(attention.sum(), 1.0, rtol=1e-5)
    assert (np.asarray(attention) > 0).sum() <= NUM_ATTENDED
    np.testing.assert_allclose(attention @ trials, answer, atol=1e-5)

    # Nearly all attention is on the trial from the same state, whose value is the state and action after it.
    assert attention[NUM_TRIALS - 39 + 17] > 0.9
    assert answer[HIDDEN_SIZE:].argmax() == actions[17]
    np.testing.assert_allclose(answer[:HIDDEN_SIZE], tentative_policy.state(hidden[18]), atol=0.3)


@pytest.mark.slow
def test_prediction_depends_on_the_actions_of_the_trials():
    hidden, actions = draw_episode(40)
    logits, _ = predict_along(hidden, actions)
    other_logits, _ = predict_along(hidden, (actions + 1) % NUM_ACTIONS)
    change = np.abs(logits - other_logits).max(axis=1)
    assert change[0] == 0
    assert change[1:].min() > 1e-3


@pytest.mark.slow
def test_no_gradient_passes_remembered_states():
    hidden, actions = draw_episode(12)

    def last_prediction(hidden):
        return predict_along(hidden, actions)[0][-1].sum()

    gradient = np.abs(jax.grad(last_prediction)(hidden)).max(axis=1)
    assert gradient[-1] > 0
    assert not gradient[:-1].any()


def test_uniform_tentative_policy_attends_to_all_trials_equally():
    tentative_policy = make_tentative_policy(UniformTentativePolicy)
    keys = jnp.linspace(-1, 1, NUM_TRIALS * HIDDEN_SIZE).reshape(NUM_TRIALS, HIDDEN_SIZE)
    for count in (3, 40):
        attention = tentative_policy.attention(keys[0], keys, jnp.int32(count))
        np.testing.assert_allclose(attention, [0.0] * (NUM_TRIALS - count) + [1 / count] * count, rtol=1e-6)


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


@pytest.mark.slow
@pytest.mark.parametrize(("num_decisions", "is_kept"), [(49, True), (50, False), (0, False)])
def test_actor_change_is_reset_every_fifty_decisions(num_decisions, is_kept):
    policy, pathways, memory = random_policy_inputs(SPEC, num_decisions)
    decision = policy.decide(pathways, memory)
    layer_changes = make_layer_changes(memory.fast.actor_change) if is_kept else NO_CHANGES
    expected = policy.decide_with_changes(pathways, memory, layer_changes)
    np.testing.assert_allclose(decision.logits, expected.logits, rtol=1e-5, atol=1e-5)
    is_repeated = np.asarray(pathways.reading)
    assert np.asarray(decision.fast.actor_change)[~is_repeated].any() == is_kept


@pytest.mark.slow
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


@pytest.mark.slow
def test_policy_without_inner_steps_has_no_adaptation():
    policy = dataclasses.replace(AGENT_LOOP, inner_steps=0).bind(tiny.random_params(0, SPEC))
    assert policy.adaptation is None


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


@pytest.mark.exhaustive
def test_tentative_policy_learns_the_actions_of_shortest_paths(params):
    learner = make_learner(IMITATION_STAGE)
    scalars = learner.config.scalars(400)
    train = jax.jit(learner.train, static_argnums=4)
    first_state = jax.jit(learner.init)(jax.random.key(0), params, KNOWLEDGE)
    middle_state, first_metrics = train(first_state, scalars, params, KNOWLEDGE, 50)
    last_state, last_metrics = train(middle_state, scalars, params, KNOWLEDGE, 50)

    # The loss falls and the agreement at repeated poses rises.
    assert last_metrics["imitation_loss"] < 0.9 * first_metrics["imitation_loss"]
    assert last_metrics["imitation_agreement"] > 1.1 * first_metrics["imitation_agreement"]
    assert changed_parts_of_method(first_state.params, last_state.params) == {"method.tentative"}

    # Negative control: a random expert is not to be learned.
    random_expert = jax.random.randint(jax.random.key(1), tiny.BANK.expert.shape, 0, NUM_ACTIONS).astype(jnp.uint8)
    random_params = params.replace(tables=params.tables.replace(expert=random_expert))
    _, random_metrics = train(middle_state, scalars, random_params, KNOWLEDGE, 50)
    random_loss = random_metrics["imitation_loss"] / random_metrics["repeated"]
    assert random_loss > 1.5 * last_metrics["imitation_loss"] / last_metrics["repeated"]


@pytest.mark.exhaustive
def test_replay_of_tpn_recomputes_log_probs_and_actor_changes():
    weights = tiny.random_params(3, SPEC)
    agents, rollouts = collect_rollouts(AGENT_LOOP, weights, seeds=(1, 2), knowledge=KNOWLEDGE)
    agent = agents[-1]
    rollout = rollouts[-1]
    transitions = rollout.transitions

    @jax.jit
    def replay():
        return replay_rollout(AGENT_LOOP.bind(weights), transitions, rollout.initial_memory, PARAMS).factual

    decisions = replay()
    log_prob = choice_log_probs(decisions.logits, transitions.choice)
    np.testing.assert_allclose(log_prob, transitions.log_prob, rtol=1e-4, atol=1e-4)

    # The last change of the actor, which episodes that have ended begin without.
    running = ~np.asarray(transitions.ended[-1])
    actor_change = np.asarray(policy_memory(agent).fast.actor_change)
    replayed_change = np.asarray(decisions.fast.actor_change[-1])
    np.testing.assert_allclose(actor_change[running], replayed_change[running], rtol=1e-3, atol=1e-4)
    assert np.abs(actor_change[running]).max() > 0.01
    assert not actor_change[~running].any()
