"""Rollouts against a plain loop over single decisions, single updates of the belief and the tables."""

import dataclasses
import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny

from jaxnav.policies.acting import Acting
from jaxnav.policies.pathways import NO_ACTION, Memory
from jaxnav.policies.policy import bind
from jaxnav.scenes.task import DONE
from jaxnav.training.collect import rollout
from jaxnav.training.loss import replay

ENVS, LENGTH = 64, tiny.LIMITS[0]
SLOTS = 20  # that the plain loop goes through
ENV, PARAMS = tiny.world()
PRIORS = tiny.priors()
ACTING = Acting(ENV, tiny.SETTING)
ROWS, SUCCESSOR = tiny.BANK.rows, tiny.BANK.successor
SCENE = np.repeat([0, 1], tiny.BANK.num_cells * tiny.POSES_PER_CELL)  # of each pose


@functools.partial(jax.jit, static_argnums=(3, 4))
def act(weights, agent, key, coin, acting=ACTING):
    return rollout(acting, bind(tiny.SPEC, weights), agent, key, LENGTH, coin, PARAMS, PRIORS)


@functools.partial(jax.jit, static_argnums=1)
def begin(key, acting=ACTING):
    return acting.start(key, ENVS, bind(tiny.SPEC, tiny.lively(0)), PARAMS, PRIORS)


@jax.jit
def decide_again(weights, transitions, memory):
    return replay(bind(tiny.SPEC, weights), transitions, memory, PARAMS)


class Rolled(NamedTuple):
    """A rollout that goes on from another, so that its episodes begin at all times; all leaves NumPy."""

    weights: dict
    before: tuple
    after: tuple
    transitions: tuple
    following: np.ndarray


@functools.cache
def rolled(coin: bool) -> Rolled:
    weights, key = tiny.lively(5), jax.random.key(1)
    agent = begin(jax.random.key(0))
    for i in range(2):
        before = agent
        agent, transitions, following = act(weights, before, jax.random.fold_in(key, i), coin)
    return jax.tree.map(np.asarray, Rolled(weights, before, agent, transitions, following))


class Retraced(NamedTuple):
    """What the plain loop finds: leaves [T, SLOTS], and the last agent's parts as lists [SLOTS]."""

    weights: np.ndarray
    value: np.ndarray
    log_prob: np.ndarray
    following: np.ndarray
    layout: list
    memory: list


@functools.cache
def retraced(coin: bool) -> Retraced:
    """Walk along the recorded actions, one episode slot after the other."""
    run = rolled(coin)
    shape = (LENGTH, SLOTS)
    found = Retraced(np.zeros((*shape, 3), np.float32), *(np.zeros(shape, np.float32) for _ in range(3)), [], [])
    for slot in range(SLOTS):
        layout, memory = tiny.at(run.before.layout, slot), tiny.at(run.before.memory, slot)
        for time in range(LENGTH):
            now = tiny.at(run.transitions, time, slot)
            weights = tiny.goal_weights(layout, now.goal)
            factual, counterfactual = tiny.decide(run.weights, ROWS[now.pose], now.goal, weights, memory)
            decision = factual if now.direct is None or now.direct else counterfactual
            found.weights[time, slot], found.value[time, slot] = weights, decision.value
            found.log_prob[time, slot] = jax.nn.log_softmax(decision.logits)[now.action]

            memory = Memory(np.asarray(decision.hidden), np.int32(now.action))
            pose, ended = SUCCESSOR[now.pose, now.action], now.terminated | now.truncated
            if now.truncated:  # the value of the cut state, with its own belief and memory
                last = tiny.believe(PRIORS[PARAMS.room[SCENE[pose]]], layout, ROWS[pose])
                cut = tiny.decide(run.weights, ROWS[pose], now.goal, tiny.goal_weights(last, now.goal), memory)[0]
                found.following[time, slot] = cut.value
            if ended:
                layout, memory = None, Memory(np.zeros(tiny.SIZES.hidden, np.float32), np.int32(NO_ACTION))
            following = (
                run.transitions.pose[time + 1, slot] if time + 1 < LENGTH else run.after.state.pose[slot]
            )  # after an ending, the start of the next episode
            assert ended or following == pose
            layout = tiny.believe(PRIORS[PARAMS.room[SCENE[following]]], layout, ROWS[following])
        found.layout.append(layout)
        found.memory.append(memory)
    after = run.after
    for slot in range(SLOTS):
        weights = tiny.goal_weights(found.layout[slot], after.state.goal[slot])
        row, goal = ROWS[after.state.pose[slot]], after.state.goal[slot]
        values = np.append(
            found.value[1:, slot], tiny.decide(run.weights, row, goal, weights, found.memory[slot])[0].value
        )
        goes_on = ~(run.transitions.terminated | run.transitions.truncated)[:, slot]
        found.following[goes_on, slot] = values[goes_on]
    return found


COIN = pytest.mark.parametrize("coin", [False, True])


def test_the_rollout_holds_every_case():
    """Without which the comparisons below would say little."""
    run = rolled(False)
    t = jax.tree.map(lambda leaf: leaf[:, :SLOTS], run.transitions)
    assert t.terminated.sum() > 4
    assert t.truncated.sum() > 5
    assert t.truncated[:-1].any()
    assert t.truncated[-1].any()
    assert (run.before.state.time > 0).any()
    assert len(np.unique(SCENE[t.pose])) == 2
    assert rolled(True).transitions.direct.mean() == pytest.approx(0.5, abs=0.2)
    assert t.direct is None


@COIN
def test_weights_values_and_probabilities_are_those_of_a_plain_loop(coin):
    stored, found = rolled(coin).transitions, retraced(coin)
    for name in ("weights", "value", "log_prob"):
        np.testing.assert_allclose(
            getattr(stored, name)[:, :SLOTS], getattr(found, name), rtol=1e-4, atol=1e-5, err_msg=name
        )


@COIN
def test_returns_go_on_with_the_cut_state_at_a_limit_and_with_nothing_after_done(coin):
    run, found = rolled(coin), retraced(coin)
    np.testing.assert_allclose(run.following[:, :SLOTS], found.following, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(run.following[run.transitions.terminated], 0)
    # The cut state's value is not that of the episode that comes after.
    inside = run.transitions.truncated[:-1]
    assert np.abs(run.following[:-1][inside] - run.transitions.value[1:][inside]).max() > 0.01


@COIN
def test_the_agent_after_the_rollout_is_that_of_the_plain_loop(coin):
    after, found = rolled(coin).after, retraced(coin)
    for slot in range(SLOTS):
        chex.assert_trees_all_close(tiny.at(after.memory, slot), found.memory[slot], rtol=1e-4, atol=1e-5)
        chex.assert_trees_all_close(tiny.at(after.layout, slot), found.layout[slot], rtol=1e-5)


@COIN
def test_replay_gives_the_decisions_again(coin):
    run = rolled(coin)
    decisions, _ = decide_again(run.weights, run.transitions, run.before.memory)
    log_prob = np.take_along_axis(jax.nn.log_softmax(decisions.logits), run.transitions.action[..., None], axis=-1)
    np.testing.assert_allclose(log_prob[..., 0], run.transitions.log_prob, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(decisions.value, run.transitions.value, rtol=1e-4, atol=1e-5)


def test_rewards_and_lengths():
    t = rolled(False).transitions
    found = (tiny.BANK.best_length == 1)[t.pose, t.goal]
    np.testing.assert_array_equal(t.terminated, t.action == DONE)
    np.testing.assert_array_equal(t.success, t.terminated & found)
    np.testing.assert_array_equal(t.reward, np.where(t.success, np.float32(5), np.float32(-0.01)))
    np.testing.assert_array_equal(t.length[t.truncated], np.array(tiny.LIMITS)[SCENE[t.pose]][t.truncated])


def test_poses_are_stored_as_integers():
    t = rolled(False).transitions
    chex.assert_type([t.pose, t.goal, t.action, t.length], jnp.int32)
    chex.assert_shape([t.pose, t.value, t.reward], (LENGTH, ENVS))


def test_an_episode_slot_is_cut_at_most_once():
    """A rollout as long as the shortest limit, by an agent that never says Done."""
    weights = tiny.lively(0)
    bias = weights["actor"]["bias"].at[DONE].set(-1e9)
    weights |= {"actor": weights["actor"] | {"bias": bias}}
    agent, cuts = begin(jax.random.key(0)), []
    for i in range(4):
        agent, transitions, _ = act(weights, agent, jax.random.key(i), False)
        cuts.append(np.asarray(transitions.truncated))
        assert not transitions.terminated.any()
    per_slot = np.array(cuts).sum(axis=1)  # [4, B]
    assert per_slot.max() == 1
    # All start together: kitchens, of limit 6, are cut once in every rollout of 6; the bedrooms' 8 leaves some out.
    assert per_slot.min() == 0


def test_equal_keys_give_equal_rollouts_and_others_do_not():
    weights, agent = tiny.lively(0), begin(jax.random.key(0))
    first = act(weights, agent, jax.random.key(5), False)
    chex.assert_trees_all_equal(act(weights, agent, jax.random.key(5), False), first)
    assert (act(weights, agent, jax.random.key(6), False)[1].action != first[1].action).any()


def test_without_a_setting_no_layout_is_carried_and_its_weights_are_ones():
    acting = dataclasses.replace(ACTING, setting=None)
    key = jax.random.key(0)
    agent, transitions, _ = jax.eval_shape(lambda: act(tiny.lively(0), begin(key, acting), key, False, acting))
    assert agent.layout is None
    assert transitions.weights.shape == (LENGTH, ENVS, 3)
    weights = acting.observe(begin(key)._replace(layout=None), PARAMS)[1]
    np.testing.assert_array_equal(weights, np.ones((ENVS, 3)))
