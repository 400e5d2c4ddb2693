"""SAVN: its loss falls, its changes are an episode's own in rollout, replay and evaluation, and they change actions."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS

from jaxnav.evaluation import grid
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.adaptation import WINDOW, replay_window, zero_output_changes
from jaxnav.policies.agent_loop import AgentLoop, policy_memory
from jaxnav.policies.methods import find_method
from jaxnav.policies.testing import check_method
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, collect_rollout, replay_rollout

LIMIT = 30
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("savn"), method_sizes=())
ACTING = AgentLoop(ENV, SPEC)
LONG = PARAMS.replace(step_limit=jnp.full(2, LIMIT, jnp.int32))


def changed(fast):
    """Which episodes have changed kernels, bool [B]."""
    return np.stack([np.abs(factors.outputs).max(axis=(-1, -2)) > 0 for factors in fast.layer_changes.values()]).all(
        axis=0
    )


@pytest.mark.slow
def test_replay_decides_and_adapts_as_the_rollout_did():
    weights = tiny.random_params(3, SPEC)

    @jax.jit
    def go():
        policy = ACTING.bind(weights)
        agent = ACTING.start(jax.random.key(0), ENVS, policy.initial_memory((ENVS,)), KNOWLEDGE, PARAMS)
        agent, _ = collect_rollout(ACTING, policy, agent, jax.random.key(1), PARAMS, KNOWLEDGE, num_steps=LENGTH)
        agent, rollout = collect_rollout(ACTING, policy, agent, jax.random.key(2), PARAMS, KNOWLEDGE, num_steps=LENGTH)
        return agent, rollout, replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS).factual

    agent, rollout, again = go()
    transitions = rollout.transitions
    log_prob = jnp.take_along_axis(jax.nn.log_softmax(again.logits), transitions.choice[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(log_prob, transitions.log_prob, rtol=1e-4, atol=1e-4)
    fast, running = policy_memory(agent).fast, ~np.asarray(transitions.ended[-1])
    replayed = jax.tree.map(lambda leaf: leaf[-1], again.fast)
    for layer, factors in fast.layer_changes.items():
        expected = replayed.layer_changes[layer].outputs
        np.testing.assert_allclose(factors.outputs[running], expected[running], rtol=1e-3, atol=1e-5)
    # New with the episode: nothing is changed before its own sixth decision.
    np.testing.assert_array_equal(fast.num_decisions, agent.state.time)
    np.testing.assert_array_equal(changed(fast), np.asarray(agent.state.time) >= WINDOW)
    assert 0 < changed(fast).sum() < ENVS


@functools.cache
def outcome(inner_steps=None):
    episodes = draw_episodes(tiny.BANK, 32, seed=1)
    rows = inference_grid([table_row("baseline", None, None, "sample")], ("baseline",), 1)
    weights = tiny.random_params(0, SPEC)
    weights["actor"]["kernel"] = 0.3 * weights["actor"]["kernel"]  # long episodes
    weights = jax.tree.map(lambda leaf: leaf[None], weights)
    acting = dataclasses.replace(ACTING, inner_steps=inner_steps)
    return Evaluator(acting, can_remove=False)(rows, weights, [(episodes, LONG)], KNOWLEDGE, jax.random.key(0))


@pytest.mark.slow
def test_evaluation_carries_the_changes_of_episodes_that_go_on(monkeypatch):
    with_parts = outcome()
    assert len(set(with_parts.length[0])) > 5
    assert (with_parts.length > WINDOW).any()
    monkeypatch.setattr(grid, "_BATCH_DIVISORS", ())
    jax.tree.map(np.testing.assert_array_equal, with_parts, outcome.__wrapped__())


@pytest.mark.slow
def test_without_adaptation_actions_are_others_after_the_first_window():
    adapted, plain = outcome(), outcome(0)
    differs = (adapted.length != plain.length) | (adapted.moves != plain.moves)
    assert differs.any()
    assert not differs[np.minimum(adapted.length, plain.length) <= WINDOW].any()


@functools.partial(jax.jit, static_argnums=1)
def fall(weights, steps):
    """Which windows are full, bool [T, B], and the learned loss of each before and after its step."""
    policy = ACTING.bind(weights)

    def loss(fast):
        rows, _ = replay_window(policy, fast.window, fast.layer_changes, zero_output_changes(fast.layer_changes))
        return policy.method.learned_loss(rows)  # type: ignore[attr-defined]

    def step(agent, key):
        memory = policy_memory(agent)
        decision = policy.decide(policy.pathways(ACTING.policy_inputs(agent, KNOWLEDGE, LONG), memory), memory)
        after, before = decision.fast, decision.fast._replace(layer_changes=memory.fast.layer_changes)
        choice, keys = jax.random.categorical(key, decision.logits), jax.random.split(key, ENVS)
        agent, _ = ACTING.step(agent, choice, KNOWLEDGE, LONG, policy=policy, decision=decision, reset_keys=keys)
        full = (after.num_decisions % WINDOW == 0) & (after.num_decisions <= 4 * WINDOW)
        return agent, (full, loss(before), loss(after))

    agent = ACTING.start(jax.random.key(0), ENVS, policy.initial_memory((ENVS,)), KNOWLEDGE, LONG)
    return jax.lax.scan(step, agent, jax.random.split(jax.random.key(1), steps))[1]


@pytest.mark.exhaustive
def test_training_teaches_the_loss_and_its_steps_make_it_fall():
    learner = Learner(ACTING, PPOConfig(num_envs=ENVS, rollout=10, epochs=2, minibatches=2), "none")
    begin = jax.jit(learner.init)(jax.random.key(0), LONG, KNOWLEDGE)
    train = jax.jit(functools.partial(learner.train, num_updates=20))
    after, _ = train(begin, learner.config.scalars(40), LONG, KNOWLEDGE)
    loss_before, loss_after = (state.params["method"]["learned_loss"] for state in (begin, after))
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), loss_before, loss_after)
    assert min(jax.tree.leaves(moved)) > 1e-3
    full, before, now = map(np.asarray, fall(after.params, 60))
    assert full.sum() > 100
    assert (now < before)[full].mean() >= 0.9
    np.testing.assert_array_equal(now[~full], before[~full])


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["savn:UNADAPTED", "savn:FIRST_ORDER", "eotp:ADAPTED"])
def test_variants_keep_the_contract(name):
    check_method(f"jaxnav.policies.methods.{name}", steps=7)
