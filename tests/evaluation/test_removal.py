"""sTDE and its controls, step by step: what is taken out, with which weight, and which actions follow."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest
from support import tiny_world as tiny
from support.evaluation_steps import AGENT_LOOP, KNOWLEDGE, start_agent, take_step

from jaxnav.causal import do
from jaxnav.choices import Decoding, Form, Variant
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import infer_and_act, start_states
from jaxnav.evaluation.removal import GapSource, RemovedLogits, control_logits, select_gap
from jaxnav.evaluation.replacements import DecisionContext, ReplacedPart, other_running_episode
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import Decision, Pathways, PolicyState
from jaxnav.scenes.task import NUM_ACTIONS

NUM_EPISODES = 48
_, PARAMS = tiny.world()
START = start_states(draw_episodes(tiny.BANK, NUM_EPISODES, seed=1))


def make_cell(
    variant: Variant = "stde", epsilon: float = 0.0, form: Form = "paper", decoding: Decoding = "argmax", **changes
):
    """One cell of the grid, changed."""
    grid = inference_grid([table_row(variant, epsilon, form, decoding)], ("baseline", "layout"), 1)
    plain_cell = tiny.leaves_at(grid, 0)
    values = {}
    for name, value in changes.items():
        values[name] = jnp.asarray(value, getattr(plain_cell, name).dtype)
    return plain_cell.replace(**values)


LAYOUT_CELL = make_cell("layout")
CONTROLS: dict[str, dict[str, Any]] = {
    "none": {},
    "other": {"gap_source": GapSource.OTHER},
    "course": {"gap_source": GapSource.MEAN},
    "zeros": {"removed_source": RemovedLogits.ZEROS},
    "noise": {"removed_source": RemovedLogits.NOISE},
    "random": {"direct_noise": 1.0},
}
EPISODE_KEYS, STEP_KEYS = jax.random.split(jax.random.key(3), (2, NUM_EPISODES))
ALL_RUNNING = np.ones(NUM_EPISODES, bool)


@jax.jit
def removed_and_counterfactual(cell, weights, agent, keys, step_keys):
    """The logits that are taken out, and those of the counterfactual decision."""
    policy = AGENT_LOOP.bind(weights)
    pathways = policy.pathways(AGENT_LOOP.policy_inputs(agent, KNOWLEDGE, PARAMS), agent.memory)
    zeroed = policy.decide(do(pathways, scene=0.0, goal=0.0), agent.memory)
    return control_logits(cell, policy, pathways, agent.memory, keys, step_keys), zeroed.logits


WEIGHTS = tiny.random_params(6)


@pytest.fixture(scope="module")
def agent():
    """The episodes after three steps of + w: the memory is alive and gaps differ."""
    agent = start_agent(WEIGHTS, START, PARAMS)
    for _ in range(3):
        agent, *_ = take_step(LAYOUT_CELL, WEIGHTS, agent, ALL_RUNNING, EPISODE_KEYS, PARAMS)
    assert len(np.unique(agent.perception.layout.gap)) > 3
    return agent


def act(agent, running=ALL_RUNNING, **changes):
    """What one step takes, and the weights that it takes it with."""
    _, step_result, inferred = take_step(make_cell(**changes), WEIGHTS, agent, running, EPISODE_KEYS, PARAMS)
    return np.asarray(step_result.agent.memory.action), np.asarray(inferred.removal_weight)


# What is taken out


def test_stde_removes_the_decision_without_direct_pathways(agent):
    result, expected = removed_and_counterfactual(make_cell(), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-6)


def test_zeros_control_removes_zeros(agent):
    assert not removed_and_counterfactual(make_cell(**CONTROLS["zeros"]), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)[
        0
    ].any()


def test_noise_control_has_the_spread_of_the_counterfactual_logits(agent):
    result, counterfactual = removed_and_counterfactual(
        make_cell(**CONTROLS["noise"]), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS
    )
    standard = np.asarray(result) / np.std(counterfactual, axis=1, keepdims=True)
    # 48 episodes of 6 actions: 288 independent draws.
    assert kstest(standard.ravel(), "norm").pvalue > 0.01
    assert abs(np.corrcoef(np.asarray(result).ravel(), np.asarray(counterfactual).ravel())[0, 1]) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("part", [ReplacedPart.EXPERIENCE, ReplacedPart.MEMORY])
def test_controls_take_a_part_of_the_counterfactual_decision_from_another_episode(agent, part):
    """The factual decision stays, and the removed logits are those with the partner's part."""
    running = np.arange(NUM_EPISODES) % 3 > 0
    cell = make_cell("tde", replaced_part=part, replaces_factual=False)

    @jax.jit
    def infer(cell, agent):
        context = DecisionContext(AGENT_LOOP.bind(WEIGHTS), cell.use_layout, AGENT_LOOP, KNOWLEDGE, PARAMS)
        return infer_and_act(
            cell,
            context,
            agent,
            jnp.asarray(running),
            EPISODE_KEYS,
            replaced_parts=(ReplacedPart.EXPERIENCE, ReplacedPart.MEMORY),
        )[2]

    trace = infer(cell, agent)
    plain_trace = infer(make_cell("tde"), agent)
    np.testing.assert_array_equal(trace.factual_logits, plain_trace.factual_logits)
    np.testing.assert_allclose(trace.action_logits, trace.factual_logits - trace.removed_logits, atol=1e-6)

    policy = AGENT_LOOP.bind(WEIGHTS)
    pathways = policy.pathways(AGENT_LOOP.policy_inputs(agent, KNOWLEDGE, PARAMS), agent.memory)
    without_direct = do(pathways, scene=0.0, goal=0.0)
    partner = np.asarray(other_running_episode(jnp.asarray(running), EPISODE_KEYS))
    memory = agent.memory
    if part == ReplacedPart.EXPERIENCE:
        without_direct = without_direct._replace(experience=pathways.experience[partner])
    else:
        memory = jax.tree.map(lambda leaf: leaf[partner], memory)
    expected = policy.decide(without_direct, memory).logits
    np.testing.assert_allclose(trace.removed_logits[running], expected[running], rtol=1e-4, atol=1e-5)
    assert np.abs(trace.removed_logits - plain_trace.removed_logits)[running].max() > 0.01

    # Without the restriction, the factual decision changes too.
    both_trace = infer(make_cell("tde", replaced_part=part), agent)
    np.testing.assert_allclose(both_trace.removed_logits, trace.removed_logits, rtol=1e-5, atol=1e-6)
    assert np.abs(both_trace.factual_logits - trace.factual_logits)[running].max() > 0.01


class ConcatenatingPolicy:
    """A policy whose logits are its pathways: two numbers of scene, two of goal, one of experience."""

    num_scene_factors = 0

    def decide(self, pathways, memory):
        logits = jnp.concatenate(pathways[:3], axis=-1)
        return Decision(logits=logits, value=logits[:, 0], hidden=memory.hidden)


@pytest.mark.slow
@pytest.mark.parametrize("max_value", [0.25, 2.0])
def test_a_random_intervention_sets_scene_and_goal_alone(max_value):
    num_episodes, policy = 500, cast(Policy, ConcatenatingPolicy())
    pathways = Pathways(
        *(jnp.full((num_episodes, width), 9.0) for width in (2, 2, 1)), gate=jnp.ones((num_episodes, 1))
    )
    memory = PolicyState(hidden=jnp.zeros((num_episodes, 1)), action=jnp.zeros(num_episodes, jnp.int32))
    keys = jax.random.split(jax.random.key(0), (2, num_episodes))

    def logits(**changes):
        return np.asarray(control_logits(make_cell(**changes), policy, pathways, memory, *keys))

    result = logits(direct_noise=max_value)
    np.testing.assert_array_equal(result[:, 4], 9.0)
    # Columns of scene and goal are uniform and owe nothing to each other.
    for column in result[:, :4].T:
        assert kstest(column / max_value, "uniform").pvalue > 0.01
    assert np.abs(np.corrcoef(result[:, :4].T) - np.eye(4)).max() < 0.15
    np.testing.assert_array_equal(logits()[:, :4], 0.0)

    # The factor of a stream, at the end of the scene, is 1 beside the noise, and 0 where the scene is.
    policy.num_scene_factors = 1  # pyright: ignore[reportAttributeAccessIssue]
    with_factor = logits(direct_noise=max_value)
    np.testing.assert_array_equal(with_factor[:, 1], 1.0)
    np.testing.assert_array_equal(with_factor[:, [0, 2, 3]], result[:, [0, 2, 3]])
    np.testing.assert_array_equal(logits()[:, 1], 0.0)


@pytest.mark.parametrize("name", ["noise", "random"])
def test_noise_follows_the_episode_key_and_intervention_the_step_key(agent, name):
    def removed_logits(*keys):
        return np.asarray(removed_and_counterfactual(make_cell(**CONTROLS[name]), WEIGHTS, agent, *keys)[0])

    def change_key(keys):
        return keys.at[7].set(jax.random.key(99))

    first_logits = removed_logits(EPISODE_KEYS, STEP_KEYS)
    np.testing.assert_array_equal(removed_logits(EPISODE_KEYS, STEP_KEYS), first_logits)
    followed_keys = (change_key(EPISODE_KEYS), STEP_KEYS)
    ignored_keys = (EPISODE_KEYS, change_key(STEP_KEYS))
    if name == "random":
        followed_keys, ignored_keys = ignored_keys, followed_keys
    np.testing.assert_array_equal(removed_logits(*ignored_keys), first_logits)
    # Other logits in the episode of the other key and nowhere else.
    assert np.flatnonzero((removed_logits(*followed_keys) != first_logits).any(axis=1)).tolist() == [7]


# Which actions follow


@pytest.mark.parametrize("form", ["paper", "residual"])
@pytest.mark.parametrize("weight", [0.3, 2.0])
def test_zeros_control_keeps_the_best_action(agent, form, weight):
    plain_actions, _ = act(agent, variant="layout")
    constant_gap = {"form": form, "epsilon": 0.0, "given_gap": weight, "gap_source": GapSource.GIVEN, "gap_end": 9}
    zeros_actions, weights = act(agent, **constant_gap, **CONTROLS["zeros"])
    np.testing.assert_array_equal(weights, np.float32(weight))
    np.testing.assert_array_equal(zeros_actions, plain_actions)
    # What the policy's own counterfactual, noise or a random intervention would change.
    for control in ("none", "noise", "random"):
        assert (act(agent, **constant_gap | {"given_gap": 2.0}, **CONTROLS[control])[0] != plain_actions).any()


def test_zeros_control_sharpens_only_the_residual_form(agent):
    """a - s 0 = a whatever the weight, sampled actions too; in the residual form the policy is sharper: (1 + s) a."""
    plain_actions, _ = act(agent, variant="layout", decoding="sample")
    constant_gap = {
        "decoding": "sample",
        "given_gap": 2.0,
        "gap_source": GapSource.GIVEN,
        "gap_end": 9,
        **CONTROLS["zeros"],
    }
    np.testing.assert_array_equal(act(agent, form="paper", **constant_gap)[0], plain_actions)
    assert (act(agent, form="residual", **constant_gap)[0] != plain_actions).any()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("form", ["paper", "residual"])
@pytest.mark.parametrize("decoding", ["argmax", "sample"])
def test_every_control_at_epsilon_one_equals_the_layout_row(agent, control, form, decoding):
    plain_actions, _ = act(agent, variant="layout", decoding=decoding)
    actions, weight = act(agent, epsilon=1.0, form=form, decoding=decoding, **CONTROLS[control])
    np.testing.assert_array_equal(actions, plain_actions)
    assert not weight.any()


def test_weight_of_one_in_the_papers_form_is_tde(agent):
    actions, weight = act(agent, given_gap=1.0, gap_source=GapSource.GIVEN, gap_end=9, epsilon=0.0)
    np.testing.assert_array_equal(actions, act(agent, variant="tde")[0])
    np.testing.assert_array_equal(weight, np.ones(NUM_EPISODES))


# Where the gap comes from

GAP = jnp.arange(NUM_EPISODES) / 100  # names the episode


def selected_gaps(running=ALL_RUNNING, keys=EPISODE_KEYS, time=0, **changes):
    """The gaps of running episodes that a cell uses, with the numbers of these episodes."""
    gap = select_gap(make_cell(**changes), GAP, jnp.asarray(running), keys, jnp.full(NUM_EPISODES, time))
    return np.asarray(gap)[np.asarray(running)], np.flatnonzero(running)


def episode_numbers(gap):
    return np.rint(100 * gap).astype(int)


@pytest.mark.parametrize("running", [ALL_RUNNING, np.arange(NUM_EPISODES) % 7 != 3])
def test_other_gaps_are_one_cycle_through_the_running_episodes(running):
    gap, own_numbers = selected_gaps(running, gap_source=GapSource.OTHER)
    other_numbers = episode_numbers(gap)
    assert sorted(other_numbers) == own_numbers.tolist()  # a permutation of those that run
    assert (other_numbers != own_numbers).all()
    # One cycle through all of them.
    next_number = dict(zip(own_numbers, other_numbers, strict=True))
    number, visited_numbers = own_numbers[0], set()
    while number not in visited_numbers:
        visited_numbers.add(number)
        number = next_number[number]
    assert len(visited_numbers) == len(own_numbers)


def test_other_gaps_keep_their_random_assignment():
    """The order owes nothing to the list: neighbours in a list may be of one scene or of one shift."""
    other_numbers = episode_numbers(selected_gaps(gap_source=GapSource.OTHER)[0])
    assert abs(np.corrcoef(other_numbers, np.arange(NUM_EPISODES))[0, 1]) < 0.4  # 48 at random: standard deviation 0.15
    np.testing.assert_array_equal(episode_numbers(selected_gaps(gap_source=GapSource.OTHER, time=9)[0]), other_numbers)
    assert (episode_numbers(selected_gaps(gap_source=GapSource.OTHER, keys=STEP_KEYS)[0]) != other_numbers).any()
    # Where an episode ends, only the one that had its gap takes another.
    still_running = np.arange(NUM_EPISODES) != 7
    other_gap, own_numbers = selected_gaps(still_running, gap_source=GapSource.OTHER)
    assert (episode_numbers(other_gap) != other_numbers[own_numbers]).sum() == 1


def test_other_gap_of_a_single_running_episode_is_its_own():
    gap, own_numbers = selected_gaps(np.arange(NUM_EPISODES) == 5, gap_source=GapSource.OTHER)
    assert episode_numbers(gap) == own_numbers == [5]


def test_mean_gap_is_the_mean_of_the_running_episodes():
    # Of 0, 0.01 ... 0.47 the first ten: 0.045.
    gap, _ = selected_gaps(np.arange(NUM_EPISODES) < 10, gap_source=GapSource.MEAN)
    np.testing.assert_allclose(gap, 0.045, rtol=1e-6)


@pytest.mark.parametrize(("time", "expected"), [(1, 0.0), (2, 0.7), (4, 0.7), (5, 0.0)])
def test_given_gap_is_used_between_its_first_and_last_step(time, expected):
    gap, _ = selected_gaps(time=time, gap_source=GapSource.GIVEN, given_gap=0.7, gap_begin=2, gap_end=5)
    np.testing.assert_array_equal(gap, np.float32(expected))


def set_gap(agent, gap):
    layout = agent.perception.layout.replace(gap=gap)
    return agent._replace(perception=agent.perception._replace(layout=layout))


def test_other_gaps_change_actions(agent):
    agent_with_gaps = set_gap(agent, (jnp.arange(NUM_EPISODES) % 2).astype(jnp.float32))
    plain_actions, other_actions = (
        act(agent_with_gaps, gap_source=source)[0] for source in (GapSource.OWN, GapSource.OTHER)
    )
    assert (plain_actions != other_actions).any()


def test_sampled_actions_are_all_actions_of_the_task(agent):
    actions = np.concatenate([act(agent, decoding="sample", **changes)[0] for changes in CONTROLS.values()])
    assert set(actions) == set(range(NUM_ACTIONS))
