"""Experience dropout of the fused network: whole episodes without experience, in rollouts and when replayed."""

import dataclasses
import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS, choice_log_probs, collect_rollouts

from jaxnav.causal import do
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, replay_rollout

EXPERIENCE_PROB = 0.7
NUM_ROLLOUTS = 3
#: Replayed in parallel over time; attending with the memory; adapting.
HOSTS = [
    "org",
    *(pytest.param(f"support.methods:{name}", marks=pytest.mark.slow) for name in ("ATTENTIVE", "ADAPTIVE")),
]


def make_spec(method_name):
    return dataclasses.replace(tiny.SPEC, method=find_method(method_name), method_sizes=(), experience_dropout=True)


def make_loop(method_name):
    return AgentLoop(ENV, make_spec(method_name), tiny.ESTIMATOR)


@functools.cache
def collect_dropout_rollouts(method_name):
    """The weights of a policy, and rollouts that continue one another; transitions have leaves [LENGTH, ENVS, ...]."""
    agent_loop = make_loop(method_name)
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=4, experience=EXPERIENCE_PROB)
    weights = tiny.random_params(3, make_spec(method_name))
    first_state = jax.jit(Learner(agent_loop, config, "none").init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    _, rollouts = collect_rollouts(
        agent_loop, weights, range(NUM_ROLLOUTS), first_agent=first_state.agent, experience_prob=EXPERIENCE_PROB
    )
    return weights, rollouts


@pytest.mark.slow
def test_dropout_draws_whole_episodes():
    _, rollouts = collect_dropout_rollouts("org")
    use_experience = np.concatenate([rollout.transitions.use_experience for rollout in rollouts])
    ended = np.concatenate([rollout.transitions.ended for rollout in rollouts])
    has_changed = use_experience[1:] != use_experience[:-1]
    assert set(np.unique(use_experience)) == {0, 1}
    assert not has_changed[~ended[:-1]].any()
    assert has_changed[ended[:-1]].any()
    for rollout, next_rollout in itertools.pairwise(rollouts):
        is_running = ~rollout.transitions.ended[-1]
        expected = rollout.transitions.use_experience[-1]
        np.testing.assert_array_equal(next_rollout.initial_memory.use_experience[is_running], expected[is_running])

    # Of about 230 episodes, a share of 0.7 has experience: three standard deviations are 0.09.
    is_first = np.concatenate([np.ones_like(ended[:1]), ended[:-1]])
    assert is_first.sum() > 200
    assert use_experience[is_first].mean() == pytest.approx(EXPERIENCE_PROB, abs=0.09)


@pytest.mark.slow
@pytest.mark.parametrize("method_name", HOSTS)
def test_replay_recomputes_log_probs_and_values(method_name):
    weights, rollouts = collect_dropout_rollouts(method_name)
    agent_loop = make_loop(method_name)

    @jax.jit
    def replay(transitions, memory):
        return replay_rollout(agent_loop.bind(weights), transitions, memory, PARAMS).factual

    for transitions, memory, _ in rollouts[1:]:
        decisions = replay(transitions, memory)
        log_probs = choice_log_probs(decisions.logits, transitions.choice)
        np.testing.assert_allclose(log_probs, transitions.log_prob, atol=2e-5)
        np.testing.assert_allclose(decisions.value, transitions.value, rtol=1e-4, atol=2e-5)

        # Negative control: with experience throughout, the decisions differ.
        with_experience = transitions._replace(use_experience=jnp.ones_like(transitions.use_experience))
        other_log_probs = choice_log_probs(replay(with_experience, memory).logits, transitions.choice)
        assert np.abs(other_log_probs - transitions.log_prob).max() > 0.01


@pytest.mark.slow
def test_without_experience_the_network_decides_under_do_z_equals_0():
    agent_loop = make_loop("org")
    weights = tiny.random_params(3, make_spec("org"))
    policy = agent_loop.bind(weights)
    memory = policy.initial_memory((ENVS,))
    agent = agent_loop.start(jax.random.key(0), ENVS, memory, KNOWLEDGE, PARAMS)
    pathways = policy.pathways(agent_loop.policy_inputs(agent, KNOWLEDGE, PARAMS), memory)
    dropped = policy.decide(pathways, memory._replace(use_experience=jnp.zeros(ENVS)))
    intervened = policy.decide(do(pathways, experience=0.0), memory)
    chex.assert_trees_all_equal(dropped._replace(use_experience=None), intervened._replace(use_experience=None))

    # Evaluations start with experience, as a network without dropout always has it.
    plain_policy = bind(tiny.SPEC, weights)
    assert plain_policy.initial_memory().use_experience is None
    factual = policy.decide(pathways, memory)
    chex.assert_trees_all_equal(
        factual.logits, plain_policy.decide(pathways, plain_policy.initial_memory((ENVS,))).logits
    )
    assert np.abs(factual.logits - dropped.logits).max() > 0.01


def test_experience_is_complete_by_default_only_in_the_fused_network():
    fused = check_config(RunConfig())
    assert fused.ppo.experience == 1.0
    assert not fused.policy_spec(9).experience_dropout
    assert not fused.policy_spec(9).can_drop_experience
    dropping = check_config(RunConfig(ppo=PPOConfig(experience=0.8)))
    assert dropping.policy_spec(9).experience_dropout
    assert dropping.policy_spec(9).can_drop_experience
    streams = check_config(RunConfig(decision="streams"))
    assert streams.ppo.experience == 0.8
    assert streams.policy_spec(9).can_drop_experience
