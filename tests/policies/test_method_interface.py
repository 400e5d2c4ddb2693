"""The seam for methods: every part of it is used by a method, in acting, replay, learning and evaluation."""

import dataclasses
import functools
import math
from importlib import metadata
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import methods
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS, changed_parts, choice_log_probs, collect_rollouts
from support.tiers import params_by_tier

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator, start_states
from jaxnav.evaluation.playback import play_episodes
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Method
from jaxnav.policies.methods import METHODS, find_method, method_label
from jaxnav.policies.testing import check_method
from jaxnav.training.config import PPOConfig, stage_index_at
from jaxnav.training.ppo import Learner, ppo_loss, replay_rollout

METHOD_NAMES = ("ATTENTIVE", "COUNTING", "STAGED", "AUXILIARY", "ADAPTIVE", "CONTROLLED", "PATIENT", "STEPWISE")
SPECS = {
    name: dataclasses.replace(tiny.SPEC, method=find_method(f"support.methods:{name}"), method_sizes=())
    for name in METHOD_NAMES
}
LEARNED_KNOWLEDGE = KNOWLEDGE._replace(method={"table": jnp.linspace(0, 1, 9).reshape(3, 3)})


def make_agent_loop(name):
    return AgentLoop(ENV, SPECS[name], tiny.ESTIMATOR)


class MethodRollout(NamedTuple):
    """A rollout that begins in the middle of episodes.

    Attributes:
      weights: parameters of the policy.
      agent_before, agent_after: `Agent` before and after the rollout, leaves [ENVS, ...].
      rollout: `Rollout`, whose transitions have leaves [LENGTH, ENVS, ...].
    """

    weights: Any
    agent_before: Any
    agent_after: Any
    rollout: Any


@functools.cache
def collect_method_rollout(name) -> MethodRollout:
    weights = tiny.random_params(3, SPECS[name])
    agents, rollouts = collect_rollouts(make_agent_loop(name), weights, seeds=(1, 2), knowledge=LEARNED_KNOWLEDGE)
    _, agent_before, agent_after = agents
    rollout = rollouts[-1]
    assert rollout.transitions.ended.sum() > 20
    return MethodRollout(weights, agent_before, agent_after, rollout)


# The contract


#: Test methods whose parts no method of the package has.
TEST_METHODS = [f"support.methods:{name}" for name in ("COUNTING", "ADAPTIVE", "CONTROLLED", "PATIENT", "LEARNED")]
ABLATIONS = [
    f"jaxnav.policies.methods.{name}"
    for name in (
        "eotp:UNIFORM",
        "hoz:PERMUTED",
        "semexp:NEAREST",
        "sp:PERMUTED",
        "tpn:INDISCRIMINATE",
        "tpn:UNTRIED",
        "vtnet:AVERAGED",
    )
]


@pytest.mark.parametrize("name", params_by_tier([*METHODS, *ABLATIONS, *TEST_METHODS], fast=["anonymous"]))
def test_check_method_accepts_every_method_of_the_package(name):
    check_method(name, steps=4)


@pytest.mark.parametrize(
    ("name", "label"), [("org", "ORG"), ("theirs", "THEIRS"), ("pooled:POOLED", "POOLED"), ("a.b:Mine", "MINE")]
)
def test_method_label_is_the_name_without_its_module(name, label):
    assert method_label(name) == label


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("BATCH_DEPENDENT", AssertionError, "Values not approximately equal"),
        pytest.param("WRONG_WIDTH", TypeError, "contracting dimensions", marks=pytest.mark.exhaustive),
        ("NOT_FINITE", AssertionError, "non-finite value"),
        # The suite's strict promotion of dtypes raises this error when the tracker is read.
        pytest.param("DTYPE_CHANGING", ValueError, "dtype promotion path", marks=pytest.mark.exhaustive),
        ("INVALID_ACTION", AssertionError, "a choice does not become the index of an action"),
    ],
)
def test_check_method_rejects_a_method_that_breaks_one_promise(name, error, message):
    with pytest.raises(error, match=message):
        check_method(f"support.methods:{name}", steps=3)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("nothing", ("'nothing'", "choose one of", "anonymous", "eotp", "hoz", "org", "rgb", "savn")),
        ("orgg", ("'orgg'", "did you mean 'org'")),
        ("no.such.module:MINE", ("no.such.module", "ModuleNotFoundError")),
        ("support.methods:MISSING", ("MISSING", "AttributeError")),
        ("support.methods:NO_METHOD", ("NO_METHOD", "not jaxnav.Method")),
    ],
)
def test_find_method_refuses_a_name_without_a_method(name, parts):
    with pytest.raises(InputError) as refusal:
        find_method(name)
    for part in parts:
        assert part in str(refusal.value)


def announce_method(monkeypatch, name, path):
    """Let an installed package announce a method as an entry point."""
    entry_point = metadata.EntryPoint(name, path, "jaxnav.methods")

    def list_entry_points(group):
        return [entry_point] if group == entry_point.group else []

    monkeypatch.setattr(metadata, "entry_points", list_entry_points)


def test_find_method_finds_methods_of_other_packages_by_entry_point(monkeypatch):
    announce_method(monkeypatch, "theirs", "support.methods:COUNTING")
    assert find_method("theirs") == dataclasses.replace(methods.COUNTING, name="theirs")
    find_method.cache_clear()


@pytest.mark.parametrize("path", ["theirs", "support.methods"])
def test_find_method_refuses_entry_points_that_announce_a_module(path, monkeypatch):
    announce_method(monkeypatch, "theirs", path)
    with pytest.raises(InputError, match=f"method 'theirs': .*'{path}'; announce package.module:NAME"):
        find_method("theirs")


# Acting and replay


@pytest.mark.parametrize(
    "name",
    params_by_tier(
        ["ATTENTIVE", "COUNTING", "ADAPTIVE", "CONTROLLED", "PATIENT", "STEPWISE"], slow=["ATTENTIVE", "CONTROLLED"]
    ),
)
def test_replay_rollout_recomputes_log_probs_and_values(name):
    weights, _, _, rollout = collect_method_rollout(name)
    transitions = rollout.transitions

    @jax.jit
    def replay():
        policy = make_agent_loop(name).bind(weights)
        return replay_rollout(policy, transitions, rollout.initial_memory, PARAMS).factual

    decisions = replay()
    log_prob = choice_log_probs(decisions.logits, transitions.choice)
    np.testing.assert_allclose(log_prob, transitions.log_prob, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(decisions.value, transitions.value, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_replay_with_attention_equals_the_parallel_replay():
    """Decisions, counterfactual decisions and the gradient of the whole loss are those of ORG."""
    rollout = collect_method_rollout("STEPWISE").rollout
    org_spec = dataclasses.replace(SPECS["STEPWISE"], method=find_method("org"))
    weights = tiny.random_params(7, org_spec)
    scalars = PPOConfig(distil=0.5).scalars(1)
    advantage = jnp.asarray(np.random.default_rng(0).normal(size=(LENGTH, ENVS)), jnp.float32)

    def loss(weights, spec):
        policy = AgentLoop(ENV, spec).bind(weights)
        replayed = replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS)
        total, _ = ppo_loss(replayed, advantage, scalars, True, METHODS["org"])
        return total, (replayed.factual, replayed.counterfactual._replace(fast=None))

    loss_and_gradient = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnums=1)
    (parallel_loss, parallel_decisions), parallel_gradient = loss_and_gradient(weights, org_spec)
    (stepwise_loss, stepwise_decisions), stepwise_gradient = loss_and_gradient(weights, SPECS["STEPWISE"])
    assert parallel_loss == pytest.approx(float(stepwise_loss), rel=1e-4)
    chex.assert_trees_all_close(parallel_decisions, stepwise_decisions, rtol=1e-4, atol=1e-5)
    chex.assert_trees_all_close(parallel_gradient, stepwise_gradient, rtol=1e-3, atol=1e-5)


# Each part


@pytest.mark.slow
def test_attending_experience_depends_on_the_memory():
    agent_loop = make_agent_loop("ATTENTIVE")
    weights, agent, _, _ = collect_method_rollout("ATTENTIVE")
    policy = agent_loop.bind(weights)
    inputs = agent_loop.policy_inputs(agent, LEARNED_KNOWLEDGE, PARAMS)
    assert agent.memory is not None

    @jax.jit
    def encode_experience(memory):
        return policy.pathways(inputs, memory).experience

    experience = encode_experience(agent.memory)
    experience_of_other_memory = encode_experience(agent.memory._replace(hidden=-agent.memory.hidden))
    assert np.abs(experience - experience_of_other_memory).max() > 1e-3
    with pytest.raises(ValueError, match="memory"):
        policy.pathways(inputs)


@pytest.mark.slow
def test_tracker_counts_every_view_once_and_restarts_with_the_episode():
    """Auto-resets begin a new state, whose first view counts; the first of the actions is `NO_ACTION`."""
    _, agent_before, agent_after, rollout = collect_method_rollout("COUNTING")
    for agent in (agent_before, agent_after):
        np.testing.assert_array_equal(agent.perception.tracker_state["views"], agent.state.time + 1)

    # The network read the state of each step: views, moves, goal. The length counts the action of this step.
    transitions = rollout.transitions
    views, moves, goals = np.moveaxis(np.asarray(transitions.reading), -1, 0) * 10
    np.testing.assert_allclose(views, transitions.episode_length, rtol=1e-6)
    np.testing.assert_allclose(goals, transitions.goal, rtol=1e-6)

    # Within an episode a move is counted where the cell changes.
    cell = transitions.pose // tiny.POSES_PER_CELL
    same_episode = ~np.asarray(transitions.ended[:-1])
    counted_moves = np.diff(moves, axis=0).round().astype(int)
    np.testing.assert_array_equal(counted_moves[same_episode], (cell[1:] != cell[:-1])[same_episode])


@pytest.mark.slow
def test_each_stage_trains_only_its_own_parameters():
    config = PPOConfig(num_envs=16, rollout=LENGTH, minibatches=2)
    learner = Learner(make_agent_loop("STAGED"), config, "none")
    learner_state = jax.jit(learner.init)(jax.random.key(0), PARAMS, LEARNED_KNOWLEDGE)
    changed_by_stage = []
    for stage in methods.STAGED.stages:
        update = jax.jit(dataclasses.replace(learner, stage=stage).update)
        next_state, _ = update(learner_state, config.scalars(4), PARAMS, LEARNED_KNOWLEDGE)
        changed_by_stage.append(changed_parts(learner_state.params, next_state.params))
    assert changed_by_stage[0] == {"critic"}
    assert {"critic", "actor", "method", "view"} <= changed_by_stage[1]

    # The first stage has a quarter of the updates.
    stage_indices = [stage_index_at(methods.STAGED.stages, num_done / 8) for num_done in range(8)]
    assert stage_indices == [0, 0, 1, 1, 1, 1, 1, 1]


@pytest.mark.slow
def test_ppo_loss_adds_and_reports_the_auxiliary_loss():
    weights, _, _, rollout = collect_method_rollout("AUXILIARY")
    policy = make_agent_loop("AUXILIARY").bind(weights)
    replayed = replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS)
    advantage = jnp.ones((LENGTH, ENVS))
    scalars = PPOConfig().scalars(1)
    plain_loss, plain_parts = ppo_loss(replayed, advantage, scalars, False, METHODS["org"])
    total_loss, total_parts = ppo_loss(replayed, advantage, scalars, False, methods.AUXILIARY)

    # The test method's loss is three times the penalty that it reports.
    penalty = float(np.square(replayed.factual.value).mean())
    assert penalty > 1e-4
    assert total_parts.keys() - plain_parts.keys() == {"squared_values"}
    assert total_parts["squared_values"] == pytest.approx(penalty, rel=1e-5)
    assert total_loss - plain_loss == pytest.approx(3 * penalty, rel=1e-4)


@pytest.mark.slow
def test_fast_weights_start_anew_with_every_episode():
    """The habit counts the actions of the episode, half a point each."""
    _, agent_before, agent_after, rollout = collect_method_rollout("ADAPTIVE")
    transitions = rollout.transitions
    assert agent_before.memory is not None
    assert agent_after.memory is not None
    for slot in range(ENVS):
        end_times = np.flatnonzero(transitions.ended[:, slot])
        if not len(end_times):
            continue
        # After an ending at step e the last decision knew the actions e + 1 to T - 2.
        known_actions = transitions.action[end_times[-1] + 1 : -1, slot]
        expected = 0.5 * np.bincount(known_actions, minlength=6)
        np.testing.assert_allclose(agent_after.memory.fast[slot], expected)


@pytest.mark.slow
def test_control_turns_choices_into_actions():
    transitions = collect_method_rollout("CONTROLLED").rollout.transitions
    num_views = np.asarray(transitions.reading[..., 0] * 10).round().astype(int)
    np.testing.assert_array_equal(transitions.action, 2 * (num_views % 3) + transitions.choice)
    assert set(np.unique(transitions.choice)) == {0, 1}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ADAPTIVE", "CONTROLLED"])
def test_evaluator_runs_methods_with_fast_weights_and_control(name):
    episodes = draw_episodes(tiny.BANK, 12, seed=1)
    rows = [table_row("baseline", None, None, "sample"), table_row("stde", 0.0, "paper", "sample")]
    grid = inference_grid(rows, ("baseline", "layout"), 1)
    weights_by_policy = [tiny.random_params(seed, SPECS[name]) for seed in range(2)]
    stacked_weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *weights_by_policy)
    evaluator = Evaluator(make_agent_loop(name))
    outcome = evaluator(grid, stacked_weights, [(episodes, PARAMS)], LEARNED_KNOWLEDGE, jax.random.key(0))
    assert outcome.length.shape == (2, 12)
    assert (outcome.length >= 1).all()
    assert (outcome.mean_weight[1] > 0).any()


@pytest.mark.slow
def test_mean_weight_of_an_episode_averages_only_decision_steps():
    """Every second step is one, the first included."""
    agent_loop = make_agent_loop("PATIENT")
    episodes = draw_episodes(tiny.BANK, 4, seed=1)
    weights = tiny.random_params(0, SPECS["PATIENT"])
    stacked_weights = jax.tree.map(lambda leaf: leaf[None], weights)
    grid = inference_grid([table_row("stde", 0.0, "paper", "argmax")], ("layout",), 1)
    outcomes = Evaluator(agent_loop)(grid, stacked_weights, [(episodes, PARAMS)], LEARNED_KNOWLEDGE, jax.random.key(0))
    outcome = tiny.leaves_at(outcomes, 0)

    # The same episodes step by step.
    traces = play_episodes(
        tiny.leaves_at(grid, 0), weights, start_states(episodes), agent_loop, PARAMS, LEARNED_KNOWLEDGE
    )
    num_decisions = [math.ceil(len(trace.action) / 2) for trace in traces]
    mean_at_decisions = [trace.inferred.removal_weight[::2].mean() for trace in traces]
    mean_at_all_steps = [trace.inferred.removal_weight.mean() for trace in traces]
    np.testing.assert_array_equal(outcome.num_decisions, num_decisions)
    np.testing.assert_allclose(outcome.mean_weight, mean_at_decisions, rtol=1e-5)
    assert np.abs(outcome.mean_weight - mean_at_all_steps).max() > 0.01


def test_method_entries_are_hashable_and_compare_by_value():
    assert hash(Method(methods.Reading)) == hash(Method(methods.Reading))
    assert Method(methods.Reading) != methods.COUNTING
