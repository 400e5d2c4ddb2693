"""sTDE and its controls, step by step: what is taken out, with which weight, and which actions follow."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest
from support import tiny_world as tiny

from jaxnav.causal import Form, do
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import infer_and_act, start_states
from jaxnav.evaluation.removal import GapSource, RemovedLogits, logits_to_remove, select_gap
from jaxnav.evaluation.report import Decoding, Variant
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import Decision, Pathways, PolicyState
from jaxnav.scenes.task import NUM_ACTIONS

EPISODES = 48
ENV, PARAMS = tiny.world()
KNOWLEDGE = Knowledge(0.05 * tiny.knowledge().layout)  # a belief that gives way at once: large gaps
ACTING = AgentLoop(ENV, tiny.SPEC, tiny.SETTING)
START = start_states(draw_episodes(tiny.BANK, EPISODES, seed=1))


def cell(
    variant: Variant = "stde", epsilon: float = 0.0, form: Form = "paper", decoding: Decoding = "argmax", **changes
):
    """One cell of the grid, changed."""
    one = tiny.leaves_at(inference_grid([table_row(variant, epsilon, form, decoding)], ("baseline", "layout"), 1), 0)
    return one.replace(**{name: jnp.asarray(value, getattr(one, name).dtype) for name, value in changes.items()})


LAYOUT = cell("layout")
CONTROLS: dict[str, dict[str, Any]] = {
    "none": {},
    "other": {"gap_source": GapSource.OTHER},
    "course": {"gap_source": GapSource.MEAN},
    "zeros": {"removed": RemovedLogits.ZEROS},
    "noise": {"removed": RemovedLogits.NOISE},
    "random": {"intervention": 1.0},
}
EPISODE_KEYS, STEP_KEYS = jax.random.split(jax.random.key(3), (2, EPISODES))
EVERY = np.ones(EPISODES, bool)


@jax.jit
def begin(weights):
    """The episodes after their first view."""
    return ACTING.start_from(START, ACTING.bind(weights).initial_memory((EPISODES,)), KNOWLEDGE, PARAMS)


@jax.jit
def take(cell, weights, agent, running, keys):
    """One step."""
    policy = ACTING.bind(weights)
    return infer_and_act(cell, policy, agent, running, keys, agent_loop=ACTING, env_params=PARAMS, knowledge=KNOWLEDGE)


@jax.jit
def both(cell, weights, agent, keys, step_keys):
    """The logits that are taken out, and those of the counterfactual decision."""
    policy = ACTING.bind(weights)
    pathways = policy.pathways(ACTING.policy_inputs(agent, KNOWLEDGE, PARAMS), agent.memory)
    zeroed = policy.decide(do(pathways, scene=0.0, goal=0.0), agent.memory)
    return logits_to_remove(cell, policy, pathways, agent.memory, keys, step_keys), zeroed.logits


WEIGHTS = tiny.lively(6)


@pytest.fixture(scope="module")
def agent():
    """The episodes after three steps of + w: the memory is alive and gaps differ."""
    agent = begin(WEIGHTS)
    for _ in range(3):
        agent, *_ = take(LAYOUT, WEIGHTS, agent, EVERY, EPISODE_KEYS)
    assert len(np.unique(agent.perception.layout.gap)) > 3
    return agent


def step(agent, running=EVERY, **options):
    """What one step takes, and the weights that it takes it with."""
    _, step_result, inferred = take(cell(**options), WEIGHTS, agent, running, EPISODE_KEYS)
    return np.asarray(step_result.agent.memory.action), np.asarray(inferred.removal_weight)


# What is taken out


def test_stde_takes_out_the_decision_without_direct_pathways(agent):
    result, expected = both(cell(), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-6)


def test_zeros_are_zeros(agent):
    assert not both(cell(**CONTROLS["zeros"]), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)[0].any()


def test_noise_is_normal_with_the_spread_of_the_counterfactual_logits(agent):
    result, counterfactual = both(cell(**CONTROLS["noise"]), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)
    standard = np.asarray(result) / np.std(counterfactual, axis=1, keepdims=True)
    # 48 episodes of 6 actions: 288 independent draws.
    assert kstest(standard.ravel(), "norm").pvalue > 0.01
    assert abs(np.corrcoef(np.asarray(result).ravel(), np.asarray(counterfactual).ravel())[0, 1]) < 0.2


class Open:
    """A policy whose logits are its pathways: two numbers of scene, two of goal, one of experience."""

    def decide(self, pathways, memory):
        logits = jnp.concatenate(pathways[:3], axis=-1)
        return Decision(logits=logits, value=logits[:, 0], hidden=memory.hidden)


@pytest.mark.parametrize("highest", [0.25, 2.0])
def test_a_random_intervention_sets_scene_and_goal_alone(highest):
    count, policy = 500, cast(Policy, Open())
    pathways = Pathways(*(jnp.full((count, width), 9.0) for width in (2, 2, 1)), gate=jnp.ones((count, 1)))
    memory = PolicyState(hidden=jnp.zeros((count, 1)), action=jnp.zeros(count, jnp.int32))
    keys = jax.random.split(jax.random.key(0), (2, count))

    def logits(**changes):
        return np.asarray(logits_to_remove(cell(**changes), policy, pathways, memory, *keys))

    result = logits(intervention=highest)
    np.testing.assert_array_equal(result[:, 4], 9.0)
    # Columns of scene and goal are uniform and owe nothing to each other.
    for column in result[:, :4].T:
        assert kstest(column / highest, "uniform").pvalue > 0.01
    assert np.abs(np.corrcoef(result[:, :4].T) - np.eye(4)).max() < 0.15
    np.testing.assert_array_equal(logits()[:, :4], 0.0)


@pytest.mark.parametrize("name", ["noise", "random"])
def test_noise_is_the_same_throughout_an_episode_and_an_intervention_drawn_at_every_step(agent, name):
    def logits(*keys):
        return np.asarray(both(cell(**CONTROLS[name]), WEIGHTS, agent, *keys)[0])

    def changed(keys):
        return keys.at[7].set(jax.random.key(99))

    first = logits(EPISODE_KEYS, STEP_KEYS)
    np.testing.assert_array_equal(logits(EPISODE_KEYS, STEP_KEYS), first)
    of_episode, of_step = (changed(EPISODE_KEYS), STEP_KEYS), (EPISODE_KEYS, changed(STEP_KEYS))
    followed, ignored = (of_episode, of_step) if name == "noise" else (of_step, of_episode)
    np.testing.assert_array_equal(logits(*ignored), first)
    # Other logits in the episode of the other key and nowhere else.
    assert np.flatnonzero((logits(*followed) != first).any(axis=1)).tolist() == [7]


# Which actions follow


@pytest.mark.parametrize("form", ["paper", "residual"])
@pytest.mark.parametrize("weight", [0.3, 2.0])
def test_zeros_leave_the_best_action_as_it_is(agent, form, weight):
    plain, _ = step(agent, variant="layout")
    constant = {"form": form, "epsilon": 0.0, "given_gap": weight, "gap_source": GapSource.GIVEN, "gap_end": 9}
    zeros, weights = step(agent, **constant, **CONTROLS["zeros"])
    np.testing.assert_array_equal(weights, np.float32(weight))
    np.testing.assert_array_equal(zeros, plain)
    # What the policy's own counterfactual, noise or a random intervention would change.
    for control in ("none", "noise", "random"):
        assert (step(agent, **constant | {"given_gap": 2.0}, **CONTROLS[control])[0] != plain).any()


def test_zeros_are_no_control_of_the_papers_form(agent):
    """a - s 0 = a whatever the weight, sampled actions too; in the residual form the policy is sharper: (1 + s) a."""
    plain, _ = step(agent, variant="layout", decoding="sample")
    constant = {
        "decoding": "sample",
        "given_gap": 2.0,
        "gap_source": GapSource.GIVEN,
        "gap_end": 9,
        **CONTROLS["zeros"],
    }
    np.testing.assert_array_equal(step(agent, form="paper", **constant)[0], plain)
    assert (step(agent, form="residual", **constant)[0] != plain).any()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("form", ["paper", "residual"])
@pytest.mark.parametrize("decoding", ["argmax", "sample"])
def test_at_epsilon_one_every_control_is_plus_w(agent, control, form, decoding):
    plain, _ = step(agent, variant="layout", decoding=decoding)
    result, weight = step(agent, epsilon=1.0, form=form, decoding=decoding, **CONTROLS[control])
    np.testing.assert_array_equal(result, plain)
    assert not weight.any()


def test_a_constant_weight_of_one_in_the_papers_form_is_hard_tde(agent):
    result, weight = step(agent, given_gap=1.0, gap_source=GapSource.GIVEN, gap_end=9, epsilon=0.0)
    np.testing.assert_array_equal(result, step(agent, variant="tde")[0])
    np.testing.assert_array_equal(weight, np.ones(EPISODES))


# Where the gap comes from

GAP = jnp.arange(EPISODES) / 100  # names the episode


def used(running=EVERY, keys=EPISODE_KEYS, time=0, **changes):
    """The gaps of running episodes that a cell uses, with the numbers of these episodes."""
    gap = select_gap(cell(**changes), GAP, jnp.asarray(running), keys, jnp.full(EPISODES, time))
    return np.asarray(gap)[np.asarray(running)], np.flatnonzero(running)


def numbers(gap):
    return np.rint(100 * gap).astype(int)


@pytest.mark.parametrize("running", [EVERY, np.arange(EPISODES) % 7 != 3])
def test_the_gap_of_another_episode_is_that_of_each_once(running):
    gap, own = used(running, gap_source=GapSource.OTHER)
    other = numbers(gap)
    assert sorted(other) == own.tolist()  # a permutation of those that run
    assert (other != own).all()
    # One cycle through all of them.
    step = dict(zip(own, other, strict=True))
    place, visited = own[0], set()
    while place not in visited:
        visited.add(place)
        place = step[place]
    assert len(visited) == len(own)


def test_who_is_whose_other_is_drawn_and_stays():
    """The order owes nothing to the list: neighbours in a list may be of one scene or of one shift."""
    other = numbers(used(gap_source=GapSource.OTHER)[0])
    assert abs(np.corrcoef(other, np.arange(EPISODES))[0, 1]) < 0.4  # 48 at random: standard deviation 0.15
    np.testing.assert_array_equal(numbers(used(gap_source=GapSource.OTHER, time=9)[0]), other)
    assert (numbers(used(gap_source=GapSource.OTHER, keys=STEP_KEYS)[0]) != other).any()
    # Where an episode ends, only the one that had its gap takes another.
    ended = np.arange(EPISODES) != 7
    other_gap, own = used(ended, gap_source=GapSource.OTHER)
    assert (numbers(other_gap) != other[own]).sum() == 1


def test_one_that_runs_alone_keeps_its_gap():
    gap, own = used(np.arange(EPISODES) == 5, gap_source=GapSource.OTHER)
    assert numbers(gap) == own == [5]


def test_the_gap_of_equal_course_is_the_mean_of_those_that_run():
    # Of 0, 0.01 ... 0.47 the first ten: 0.045.
    gap, _ = used(np.arange(EPISODES) < 10, gap_source=GapSource.MEAN)
    np.testing.assert_allclose(gap, 0.045, rtol=1e-6)


@pytest.mark.parametrize(("time", "expected"), [(1, 0.0), (2, 0.7), (4, 0.7), (5, 0.0)])
def test_a_given_gap_lasts_from_one_step_to_before_another(time, expected):
    gap, _ = used(time=time, gap_source=GapSource.GIVEN, given_gap=0.7, gap_begin=2, gap_end=5)
    np.testing.assert_array_equal(gap, np.float32(expected))


def with_gap(agent, gap):
    layout = agent.perception.layout.replace(gap=gap)
    return agent._replace(perception=agent.perception._replace(layout=layout))


def test_the_gap_of_another_episode_changes_actions(agent):
    apart = with_gap(agent, (jnp.arange(EPISODES) % 2).astype(jnp.float32))
    plain, other = (step(apart, gap_source=source)[0] for source in (GapSource.OWN, GapSource.OTHER))
    assert (plain != other).any()


def test_actions_are_of_the_task(agent):
    result = np.concatenate([step(agent, decoding="sample", **changes)[0] for changes in CONTROLS.values()])
    assert set(result) == set(range(NUM_ACTIONS))
