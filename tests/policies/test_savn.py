"""SAVN: its loss falls, and its changes belong to a single episode in rollout, replay and evaluation."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, PARAMS, choice_log_probs, collect_rollouts

from jaxnav.evaluation import grid
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.adaptation import WINDOW, replay_window, zero_output_changes
from jaxnav.policies.agent_loop import AgentLoop, policy_memory
from jaxnav.policies.methods import find_method
from jaxnav.policies.testing import check_method
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, replay_rollout

SPEC = dataclasses.replace(tiny.SPEC, method=find_method("savn"), method_sizes=())
AGENT_LOOP = AgentLoop(ENV, SPEC)
#: Episodes of up to 30 actions, which have five windows.
LONG_PARAMS = PARAMS.replace(step_limit=jnp.full(2, 30, jnp.int32))


def has_changes(fast_weights: Any) -> np.ndarray:
    """True for episodes all of whose layers are changed, bool [B]."""
    changed_layers = []
    for change in fast_weights.layer_changes.values():
        changed_layers.append(np.abs(change.outputs).max(axis=(-1, -2)) > 0)
    return np.all(changed_layers, axis=0)


@pytest.mark.slow
def test_replay_decides_and_adapts_as_the_rollout_did():
    policy_params = tiny.random_params(3, SPEC)
    agents, rollouts = collect_rollouts(AGENT_LOOP, policy_params, seeds=(1, 2))
    agent = agents[-1]
    rollout = rollouts[-1]
    transitions = rollout.transitions

    @jax.jit
    def replay():
        policy = AGENT_LOOP.bind(policy_params)
        return replay_rollout(policy, transitions, rollout.initial_memory, PARAMS).factual

    decisions = replay()
    log_prob = choice_log_probs(decisions.logits, transitions.choice)
    np.testing.assert_allclose(log_prob, transitions.log_prob, rtol=1e-4, atol=1e-4)

    # Episodes that go on have the changes of the last replayed step.
    fast_weights = policy_memory(agent).fast
    is_running = ~np.asarray(transitions.ended[-1])
    for layer, change in fast_weights.layer_changes.items():
        replayed_change = decisions.fast.layer_changes[layer].outputs[-1]
        np.testing.assert_allclose(change.outputs[is_running], replayed_change[is_running], rtol=1e-3, atol=1e-5)

    # A new episode has no changes before its sixth decision.
    np.testing.assert_array_equal(fast_weights.num_decisions, agent.state.time)
    np.testing.assert_array_equal(has_changes(fast_weights), np.asarray(agent.state.time) >= WINDOW)
    assert 0 < has_changes(fast_weights).sum() < ENVS


@functools.cache
def evaluate(inner_steps: int | None = None) -> EpisodeOutcome:
    """Evaluate a random policy with sampled actions, leaves [1, 32]."""
    episodes = draw_episodes(tiny.BANK, 32, seed=1)
    rows = inference_grid([table_row("baseline", None, None, "sample")], ("baseline",), 1)
    policy_params = tiny.random_params(0, SPEC)
    # Small logits make Done unlikely, so that episodes are long.
    policy_params["actor"]["kernel"] = 0.3 * policy_params["actor"]["kernel"]
    params_by_seed = jax.tree.map(lambda leaf: leaf[None], policy_params)
    evaluator = Evaluator(dataclasses.replace(AGENT_LOOP, inner_steps=inner_steps), can_remove=False)
    return evaluator(rows, params_by_seed, [(episodes, LONG_PARAMS)], KNOWLEDGE, jax.random.key(0))


@pytest.mark.slow
def test_smaller_batches_of_an_evaluation_keep_the_changes_of_running_episodes(monkeypatch):
    outcome = evaluate()
    assert len(set(outcome.length[0])) > 5
    assert (outcome.length > WINDOW).any()
    # The same episodes in one batch to the end.
    monkeypatch.setattr(grid, "_BATCH_DIVISORS", ())
    jax.tree.map(np.testing.assert_array_equal, outcome, evaluate.__wrapped__())


@pytest.mark.slow
def test_without_adaptation_actions_differ_only_after_the_first_window():
    adapted = evaluate()
    unadapted = evaluate(inner_steps=0)
    differs = (adapted.length != unadapted.length) | (adapted.moves != unadapted.moves)
    assert differs.any()
    ends_in_first_window = np.minimum(adapted.length, unadapted.length) <= WINDOW
    assert not differs[ends_in_first_window].any()


@functools.partial(jax.jit, static_argnums=1)
def losses_around_inner_steps(policy_params: Any, num_steps: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Act, and compute the learned loss of the current window before and after each decision's inner step.

    Returns:
      Where an inner step was taken, bool [T, B], and the losses before and after it, float32 [T, B].
    """
    policy = AGENT_LOOP.bind(policy_params)

    def window_loss(fast_weights):
        no_changes = zero_output_changes(fast_weights.layer_changes)
        rows, _ = replay_window(policy, fast_weights.window, fast_weights.layer_changes, no_changes)
        return policy.experience.learned_loss(rows)  # type: ignore[attr-defined]

    def act(agent, key):
        memory = policy_memory(agent)
        pathways = policy.pathways(AGENT_LOOP.policy_inputs(agent, KNOWLEDGE, LONG_PARAMS), memory)
        decision = policy.decide(pathways, memory)
        # The window after the decision, with the changes before and after the inner step.
        fast_after = decision.fast
        fast_before = fast_after._replace(layer_changes=memory.fast.layer_changes)
        has_adapted = (fast_after.num_decisions % WINDOW == 0) & (fast_after.num_decisions <= 4 * WINDOW)

        choice = jax.random.categorical(key, decision.logits)
        reset_keys = jax.random.split(key, ENVS)
        agent, _ = AGENT_LOOP.step(
            agent, choice, KNOWLEDGE, LONG_PARAMS, policy=policy, decision=decision, reset_keys=reset_keys
        )
        return agent, (has_adapted, window_loss(fast_before), window_loss(fast_after))

    agent = AGENT_LOOP.start(jax.random.key(0), ENVS, policy.initial_memory((ENVS,)), KNOWLEDGE, LONG_PARAMS)
    return jax.lax.scan(act, agent, jax.random.split(jax.random.key(1), num_steps))[1]


@pytest.mark.exhaustive
def test_training_teaches_the_loss_and_inner_steps_make_it_fall():
    learner = Learner(AGENT_LOOP, PPOConfig(num_envs=ENVS, rollout=10, epochs=2, minibatches=2), "none")
    initial_state = jax.jit(learner.init)(jax.random.key(0), LONG_PARAMS, KNOWLEDGE)
    train = jax.jit(functools.partial(learner.train, num_updates=20))
    trained_state, _ = train(initial_state, learner.config.scalars(40), LONG_PARAMS, KNOWLEDGE)

    # Every parameter of the loss has learned.
    initial_loss = initial_state.params["method"]["learned_loss"]
    trained_loss = trained_state.params["method"]["learned_loss"]
    distances = jax.tree.map(lambda before, after: float(np.abs(after - before).max()), initial_loss, trained_loss)
    assert min(jax.tree.leaves(distances)) > 1e-3

    # Nine in ten inner steps make the loss fall, and without one it stays.
    has_adapted, loss_before, loss_after = map(np.asarray, losses_around_inner_steps(trained_state.params, 60))
    assert has_adapted.sum() > 100
    assert (loss_after < loss_before)[has_adapted].mean() >= 0.9
    np.testing.assert_array_equal(loss_after[~has_adapted], loss_before[~has_adapted])


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["savn:UNADAPTED", "savn:FIRST_ORDER", "eotp:ADAPTED"])
def test_variants_keep_the_contract(name):
    check_method(f"jaxnav.policies.methods.{name}", steps=7)
