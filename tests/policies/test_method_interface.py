"""The seam for methods: every part of it is used by a method, in acting, replay, learning and evaluation."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import methods
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator, start_states
from jaxnav.evaluation.playback import play_episodes
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Method
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.testing import check_method
from jaxnav.training.config import PPOConfig, stage_index_at
from jaxnav.training.ppo import Learner, collect_rollout, ppo_loss, replay_rollout

SPECS = {
    name: dataclasses.replace(tiny.SPEC, method=find_method(f"support.methods:{name}"), method_sizes=())
    for name in ("ATTENTIVE", "COUNTING", "STAGED", "AUXILIARY", "ADAPTIVE", "CONTROLLED", "PATIENT", "STEPWISE")
}
KNOWN = KNOWLEDGE._replace(method={"table": jnp.linspace(0, 1, 9).reshape(3, 3)})


def acting_with(name):
    return AgentLoop(ENV, SPECS[name], tiny.ESTIMATOR)


@functools.cache
def rolled(name):
    """Weights, the agent before, the agent after and a rollout that begins in the middle of episodes."""
    acting, weights = acting_with(name), tiny.random_params(3, SPECS[name])

    @jax.jit
    def go(agent, key):
        return collect_rollout(acting, acting.bind(weights), agent, key, PARAMS, KNOWN, num_steps=LENGTH)

    memory = acting.bind(weights).initial_memory((ENVS,))
    agent = acting.start(jax.random.key(0), ENVS, memory, KNOWN, PARAMS)
    before, _ = go(agent, jax.random.key(1))
    after, rollout = go(before, jax.random.key(2))
    assert rollout.transitions.ended.sum() > 20
    return weights, before, after, rollout


# The contract


def some(names, quick):
    """Names as parameters, all but the quick ones marked slow."""
    return [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in names]


#: Those whose parts are in no method of the package.
THEIRS = [f"support.methods:{name}" for name in ("COUNTING", "ADAPTIVE", "CONTROLLED", "PATIENT", "LEARNED")]
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


@pytest.mark.parametrize("name", some([*METHODS, *ABLATIONS, *THEIRS], quick=("anonymous",)))
def test_methods_keep_the_contract(name):
    check_method(name, steps=4)


@pytest.mark.parametrize("name", some(["BATCH", "WIDTH", "FINITE", "NOTE", "ACTION"], quick=("ACTION",)))
def test_methods_that_break_the_contract_are_flagged(name):
    """Negative controls: each breaks one promise."""
    with pytest.raises((AssertionError, TypeError, ValueError)):
        check_method(f"support.methods:{name}", steps=3)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing", "method 'nothing': is unknown; choose one of anonymous, eotp, hoz, org, rgb, savn, "),
        ("orgg", "did you mean 'org'?"),
        ("no.such.module:MINE", "cannot be imported (ModuleNotFoundError"),
        ("support.methods:MISSING", "cannot be imported (AttributeError"),
        ("support.methods:NO_METHOD", "no jaxnav Method"),
    ],
)
def test_what_is_no_method_is_refused_by_name(name, message):
    with pytest.raises(InputError) as refusal:
        find_method(name)
    assert message in str(refusal.value)


def test_methods_of_other_packages_are_found_by_entry_point(monkeypatch):
    from importlib import metadata

    point = metadata.EntryPoint("theirs", "support.methods:COUNTING", "jaxnav.methods")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point] if group == point.group else [])
    assert find_method("theirs") == dataclasses.replace(methods.COUNTING, name="theirs")
    find_method.cache_clear()


# Acting and replay agree


@pytest.mark.parametrize("name", some([name for name in SPECS if name not in ("STAGED", "AUXILIARY")], quick=()))
def test_replay_decides_as_the_rollout_did(name):
    weights, _, _, rollout = rolled(name)
    again = jax.jit(
        lambda: replay_rollout(acting_with(name).bind(weights), rollout.transitions, rollout.initial_memory, PARAMS)
    )()
    log_pi = jax.nn.log_softmax(again.factual.logits)
    log_prob = jnp.take_along_axis(log_pi, rollout.transitions.choice[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(log_prob, rollout.transitions.log_prob, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(again.factual.value, rollout.transitions.value, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_step_by_step_replay_is_the_parallel_one():
    """Decisions, counterfactual decisions and the gradient of the whole loss are those of ORG."""
    _, _, _, rollout = rolled("STEPWISE")
    org = dataclasses.replace(SPECS["STEPWISE"], method=find_method("org"))
    weights = tiny.random_params(7, org)
    scalars = PPOConfig(distil=0.5).scalars(1)
    advantage = jnp.asarray(np.random.default_rng(0).normal(size=(LENGTH, ENVS)), jnp.float32)

    @functools.partial(jax.jit, static_argnums=1)
    def loss(weights, spec):
        policy = AgentLoop(ENV, spec).bind(weights)
        replayed = replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS)
        total, _ = ppo_loss(replayed, advantage, scalars, True, METHODS["org"])
        return total, (replayed.factual, replayed.counterfactual._replace(fast=None))

    (one, parts), gradient = jax.value_and_grad(loss, has_aux=True)(weights, org)
    (other, expected), wanted = jax.value_and_grad(loss, has_aux=True)(weights, SPECS["STEPWISE"])
    assert one == pytest.approx(float(other), rel=1e-4)
    chex.assert_trees_all_close(parts, expected, rtol=1e-4, atol=1e-5)
    chex.assert_trees_all_close(gradient, wanted, rtol=1e-3, atol=1e-5)


# Each part


@pytest.mark.slow
def test_experience_attends_with_the_memory():
    acting = acting_with("ATTENTIVE")
    weights, before, _, _ = rolled("ATTENTIVE")
    policy, view = acting.bind(weights), acting.policy_inputs(before, KNOWN, PARAMS)
    assert before.memory is not None
    experience = jax.jit(lambda memory: policy.pathways(view, memory).experience)
    first, other = experience(before.memory), experience(before.memory._replace(hidden=-before.memory.hidden))
    assert np.abs(first - other).max() > 1e-3
    with pytest.raises(ValueError, match="reads the memory"):
        policy.pathways(view)


@pytest.mark.slow
def test_a_tracker_takes_in_every_view_once():
    """Auto-resets begin a new note, whose first view counts; of the actions the first is `NO_ACTION`."""
    _, before, after, rollout = rolled("COUNTING")
    for agent in (before, after):
        np.testing.assert_array_equal(agent.perception.tracker_state["views"], agent.state.time + 1)
    t = rollout.transitions
    # What the network read at each step is the note of that step: views, moves, goal.
    # The length counts the action of this step.
    np.testing.assert_allclose(t.reading[..., 0] * 10, t.episode_length, rtol=1e-6)
    np.testing.assert_allclose(t.reading[..., 2] * 10, t.goal, rtol=1e-6)
    cell = t.pose // tiny.POSES_PER_CELL
    stayed = ~np.asarray(t.ended[:-1])
    moved = (np.asarray(t.reading[1:, :, 1] - t.reading[:-1, :, 1]) * 10).round().astype(int)
    np.testing.assert_array_equal(moved[stayed], (cell[1:] != cell[:-1])[stayed])


@pytest.mark.slow
def test_stages_train_their_own_part():
    learner = Learner(acting_with("STAGED"), PPOConfig(num_envs=16, rollout=LENGTH, minibatches=2), "none")
    before = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWN)
    scalars = learner.config.scalars(4)
    moved = []
    for stage in methods.STAGED.stages:
        update = jax.jit(dataclasses.replace(learner, stage=stage).update)
        after, _ = update(before, scalars, PARAMS, KNOWN)
        changes = jax.tree.map(lambda a, b: bool((a != b).any()), before.params, after.params)
        moved.append({name for name, change in changes.items() if any(jax.tree.leaves(change))})
    assert moved[0] == {"critic"}
    assert {"critic", "actor", "method", "view"} <= moved[1]
    shares = [stage_index_at(methods.STAGED.stages, done / 8) for done in range(8)]
    assert shares == [0, 0, 1, 1, 1, 1, 1, 1]


@pytest.mark.slow
def test_an_auxiliary_loss_is_added_and_reported():
    weights, _, _, rollout = rolled("AUXILIARY")
    policy = acting_with("AUXILIARY").bind(weights)
    replayed = replay_rollout(policy, rollout.transitions, rollout.initial_memory, PARAMS)
    advantage, scalars = jnp.ones((LENGTH, ENVS)), PPOConfig().scalars(1)
    plain, parts = ppo_loss(replayed, advantage, scalars, False, METHODS["org"])
    total, more = ppo_loss(replayed, advantage, scalars, False, methods.AUXILIARY)
    penalty = float(np.square(replayed.factual.value).mean())
    assert penalty > 1e-4
    assert more.keys() - parts.keys() == {"squared_values"}
    assert more["squared_values"] == pytest.approx(penalty, rel=1e-5)
    assert total - plain == pytest.approx(3 * penalty, rel=1e-4)


@pytest.mark.slow
def test_fast_weights_are_an_episodes_own():
    """The habit counts the actions of the episode, half a point each, and starts anew with it."""
    _, before, after, rollout = rolled("ADAPTIVE")
    t, memory = rollout.transitions, after.memory
    assert memory is not None
    assert before.memory is not None
    for slot in range(ENVS):
        ended = np.flatnonzero(t.ended[:, slot])
        if not len(ended):
            continue
        # After an ending at step e the last decision knew the actions e + 1 to T - 2.
        done = t.action[ended[-1] + 1 : -1, slot]
        np.testing.assert_allclose(memory.fast[slot], 0.5 * np.bincount(done, minlength=6))


@pytest.mark.slow
def test_choices_become_actions_by_the_control():
    _, _, _, rollout = rolled("CONTROLLED")
    t = rollout.transitions
    views = np.asarray(t.reading[..., 0] * 10).round().astype(int)
    np.testing.assert_array_equal(t.action, 2 * (views % 3) + t.choice)
    assert set(np.unique(t.choice)) == {0, 1}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ADAPTIVE", "CONTROLLED"])
def test_methods_are_evaluated(name):
    episodes = draw_episodes(tiny.BANK, 12, seed=1)
    rows = [table_row("baseline", None, None, "sample"), table_row("stde", 0.0, "paper", "sample")]
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tiny.random_params(s, SPECS[name]) for s in range(2)))
    grid = inference_grid(rows, ("baseline", "layout"), 1)
    outcome = Evaluator(acting_with(name))(grid, weights, [(episodes, PARAMS)], KNOWN, jax.random.key(0))
    assert outcome.length.shape == (2, 12)
    assert (outcome.length >= 1).all()
    assert (outcome.mean_weight[1] > 0).any()


@pytest.mark.slow
def test_the_weight_of_an_episode_is_the_mean_over_choices_that_count():
    """Every second one, the first included: those between are neither counted nor averaged."""
    episodes, weights = draw_episodes(tiny.BANK, 4, seed=1), tiny.random_params(0, SPECS["PATIENT"])
    grid = inference_grid([table_row("stde", 0.0, "paper", "argmax")], ("layout",), 1)
    stacked = jax.tree.map(lambda leaf: leaf[None], weights)
    acting = acting_with("PATIENT")
    outcome = tiny.leaves_at(Evaluator(acting)(grid, stacked, [(episodes, PARAMS)], KNOWN, jax.random.key(0)), 0)
    traces = play_episodes(tiny.leaves_at(grid, 0), weights, start_states(episodes), acting, PARAMS, KNOWN)
    np.testing.assert_array_equal(outcome.choices, [-(-len(trace.action) // 2) for trace in traces])
    expected = [trace.inferred.removal_weight[::2].mean() for trace in traces]
    np.testing.assert_allclose(outcome.mean_weight, expected, rtol=1e-5)
    # Over all actions it is another number.
    assert np.abs(outcome.mean_weight - [trace.inferred.removal_weight.mean() for trace in traces]).max() > 0.01


def test_a_method_is_one_hashable_entry():
    assert hash(Method(methods.Reading)) == hash(Method(methods.Reading))
    assert Method(methods.Reading) != methods.COUNTING
