"""Single steps of sTDE and its controls: the removed logits, the actions, and the layout gap of the removal."""

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
    """One cell of the evaluation grid, with changed fields."""
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
def removed_and_counterfactual_logits(cell, weights, agent, episode_keys, step_keys):
    """The logits that a cell removes, and those of the counterfactual decision."""
    policy = AGENT_LOOP.bind(weights)
    pathways = policy.pathways(AGENT_LOOP.policy_inputs(agent, KNOWLEDGE, PARAMS), agent.memory)
    counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), agent.memory)
    removed_logits = control_logits(cell, policy, pathways, agent.memory, episode_keys, step_keys)
    return removed_logits, counterfactual.logits


WEIGHTS = tiny.random_params(6)


@pytest.fixture(scope="module")
def agent():
    """The episodes after three steps of the layout row, with memories that are not empty and different gaps."""
    agent = start_agent(WEIGHTS, START, PARAMS)
    for _ in range(3):
        agent, *_ = take_step(LAYOUT_CELL, WEIGHTS, agent, ALL_RUNNING, EPISODE_KEYS, PARAMS)
    assert len(np.unique(agent.perception.layout.gap)) > 3
    return agent


def act(agent, running=ALL_RUNNING, **changes):
    """Actions and removal weights of one step by a cell with changed fields."""
    _, step_result, inferred = take_step(make_cell(**changes), WEIGHTS, agent, running, EPISODE_KEYS, PARAMS)
    return np.asarray(step_result.agent.memory.action), np.asarray(inferred.removal_weight)


# Removed logits


def test_stde_removes_the_decision_without_direct_pathways(agent):
    result, expected = removed_and_counterfactual_logits(make_cell(), WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-6)


def test_zeros_control_removes_zeros(agent):
    cell = make_cell(**CONTROLS["zeros"])
    removed_logits, _ = removed_and_counterfactual_logits(cell, WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS)
    assert not removed_logits.any()


def test_noise_control_has_the_spread_of_the_counterfactual_logits(agent):
    cell = make_cell(**CONTROLS["noise"])
    removed_logits, counterfactual_logits = removed_and_counterfactual_logits(
        cell, WEIGHTS, agent, EPISODE_KEYS, STEP_KEYS
    )
    standard_logits = np.asarray(removed_logits) / np.std(counterfactual_logits, axis=1, keepdims=True)
    # 48 episodes of 6 actions: 288 independent draws.
    assert kstest(standard_logits.ravel(), "norm").pvalue > 0.01
    correlation = np.corrcoef(np.asarray(removed_logits).ravel(), np.asarray(counterfactual_logits).ravel())[0, 1]
    assert abs(correlation) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("part", [ReplacedPart.EXPERIENCE, ReplacedPart.MEMORY])
def test_controls_replace_a_part_of_the_counterfactual_decision_by_another_episodes(agent, part):
    """The factual decision is unchanged, and the removed logits are those with the part of the other episode."""
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

    # Only the removed logits change.
    trace = infer(cell, agent)
    plain_trace = infer(make_cell("tde"), agent)
    np.testing.assert_array_equal(trace.factual_logits, plain_trace.factual_logits)
    np.testing.assert_allclose(trace.action_logits, trace.factual_logits - trace.removed_logits, atol=1e-6)

    # The counterfactual decision with experience or memory of the partner.
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

    # With `replaces_factual`, which is the default, the factual decision changes as well.
    factual_trace = infer(make_cell("tde", replaced_part=part), agent)
    np.testing.assert_allclose(factual_trace.removed_logits, trace.removed_logits, rtol=1e-5, atol=1e-6)
    assert np.abs(factual_trace.factual_logits - trace.factual_logits)[running].max() > 0.01


class ConcatenatingPolicy:
    """Policy whose logits are its pathways: two numbers of the scene, two of the goal, one of experience."""

    num_scene_factors = 0

    def decide(self, pathways, memory):
        logits = jnp.concatenate(pathways[:3], axis=-1)
        return Decision(logits=logits, value=logits[:, 0], hidden=memory.hidden)


@pytest.mark.slow
@pytest.mark.parametrize("max_value", [0.25, 2.0])
def test_a_random_intervention_sets_only_scene_and_goal(max_value):
    num_episodes = 500
    policy = cast(Policy, ConcatenatingPolicy())
    pathways = Pathways(
        *(jnp.full((num_episodes, width), 9.0) for width in (2, 2, 1)), gate=jnp.ones((num_episodes, 1))
    )
    memory = PolicyState(hidden=jnp.zeros((num_episodes, 1)), action=jnp.zeros(num_episodes, jnp.int32))
    keys = jax.random.split(jax.random.key(0), (2, num_episodes))

    def removed_logits(**changes):
        return np.asarray(control_logits(make_cell(**changes), policy, pathways, memory, *keys))

    # Experience is unchanged, and the columns of scene and goal are uniform and independent.
    result = removed_logits(direct_noise=max_value)
    np.testing.assert_array_equal(result[:, 4], 9.0)
    for column in result[:, :4].T:
        assert kstest(column / max_value, "uniform").pvalue > 0.01
    assert np.abs(np.corrcoef(result[:, :4].T) - np.eye(4)).max() < 0.15
    np.testing.assert_array_equal(removed_logits()[:, :4], 0.0)

    # The factor of a stream, the last number of the scene, is 1 with noise, and 0 if the scene is set to 0.
    policy.num_scene_factors = 1  # pyright: ignore[reportAttributeAccessIssue]
    factor_result = removed_logits(direct_noise=max_value)
    np.testing.assert_array_equal(factor_result[:, 1], 1.0)
    np.testing.assert_array_equal(factor_result[:, [0, 2, 3]], result[:, [0, 2, 3]])
    np.testing.assert_array_equal(removed_logits()[:, 1], 0.0)


@pytest.mark.parametrize("name", ["noise", "random"])
def test_noise_follows_the_episode_key_and_intervention_the_step_key(agent, name):
    cell = make_cell(**CONTROLS[name])

    def removed_logits(*keys):
        return np.asarray(removed_and_counterfactual_logits(cell, WEIGHTS, agent, *keys)[0])

    def change_key(keys):
        return keys.at[7].set(jax.random.key(99))

    # Equal keys give equal logits.
    first_logits = removed_logits(EPISODE_KEYS, STEP_KEYS)
    np.testing.assert_array_equal(removed_logits(EPISODE_KEYS, STEP_KEYS), first_logits)

    # Noise depends only on the key of the episode, a random intervention only on the key of the step.
    followed_keys = (change_key(EPISODE_KEYS), STEP_KEYS)
    ignored_keys = (EPISODE_KEYS, change_key(STEP_KEYS))
    if name == "random":
        followed_keys, ignored_keys = ignored_keys, followed_keys
    np.testing.assert_array_equal(removed_logits(*ignored_keys), first_logits)
    # A changed key changes the logits of its episode and of no other episode.
    assert np.flatnonzero((removed_logits(*followed_keys) != first_logits).any(axis=1)).tolist() == [7]


# Actions


@pytest.mark.parametrize("form", ["paper", "residual"])
@pytest.mark.parametrize("weight", [0.3, 2.0])
def test_zeros_control_keeps_the_best_action(agent, form, weight):
    # Removal of zeros with a constant weight leaves the order of the logits unchanged.
    plain_actions, _ = act(agent, variant="layout")
    constant_gap = {"form": form, "epsilon": 0.0, "given_gap": weight, "gap_source": GapSource.GIVEN, "gap_end": 9}
    zeros_actions, weights = act(agent, **constant_gap, **CONTROLS["zeros"])
    np.testing.assert_array_equal(weights, np.float32(weight))
    np.testing.assert_array_equal(zeros_actions, plain_actions)
    # Negative controls: removal of the policy's counterfactual, of noise or of a random intervention changes actions.
    for control in ("none", "noise", "random"):
        assert (act(agent, **constant_gap | {"given_gap": 2.0}, **CONTROLS[control])[0] != plain_actions).any()


def test_zeros_control_sharpens_only_the_residual_form(agent):
    """In the paper's form a - s 0 = a, so sampled actions are equal; in the residual form (1 + s) a is sharper."""
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


# Layout gap of the removal

#: Gap of each episode, from which `episode_numbers` recovers the number of the episode.
GAP = jnp.arange(NUM_EPISODES) / 100


def selected_gaps(running=ALL_RUNNING, keys=EPISODE_KEYS, time=0, **changes):
    """The gaps that a cell uses in running episodes, and the numbers of these episodes."""
    gap = select_gap(make_cell(**changes), GAP, jnp.asarray(running), keys, jnp.full(NUM_EPISODES, time))
    return np.asarray(gap)[np.asarray(running)], np.flatnonzero(running)


def episode_numbers(gap):
    """Numbers of the episodes that the values of a gap belong to."""
    return np.rint(100 * gap).astype(int)


@pytest.mark.parametrize("running", [ALL_RUNNING, np.arange(NUM_EPISODES) % 7 != 3])
def test_other_gaps_are_one_cycle_through_the_running_episodes(running):
    gap, own_numbers = selected_gaps(running, gap_source=GapSource.OTHER)
    other_numbers = episode_numbers(gap)
    assert sorted(other_numbers) == own_numbers.tolist()  # a permutation of the running episodes
    assert (other_numbers != own_numbers).all()

    # The permutation is a single cycle: from the first episode, it visits all running episodes.
    next_number = dict(zip(own_numbers, other_numbers, strict=True))
    number = own_numbers[0]
    visited_numbers = set()
    while number not in visited_numbers:
        visited_numbers.add(number)
        number = next_number[number]
    assert len(visited_numbers) == len(own_numbers)


def test_other_gaps_keep_their_random_assignment():
    """The assignment does not follow the list of episodes, whose neighbours may share a scene or a shift."""
    other_numbers = episode_numbers(selected_gaps(gap_source=GapSource.OTHER)[0])
    correlation = np.corrcoef(other_numbers, np.arange(NUM_EPISODES))[0, 1]
    assert abs(correlation) < 0.4  # 48 numbers in random order: standard deviation 0.15

    # The assignment depends on the keys of the episodes, and not on time.
    later_numbers = episode_numbers(selected_gaps(gap_source=GapSource.OTHER, time=9)[0])
    np.testing.assert_array_equal(later_numbers, other_numbers)
    rekeyed_numbers = episode_numbers(selected_gaps(gap_source=GapSource.OTHER, keys=STEP_KEYS)[0])
    assert (rekeyed_numbers != other_numbers).any()

    # After the end of an episode, only the episode that used its gap gets another gap.
    still_running = np.arange(NUM_EPISODES) != 7
    other_gap, own_numbers = selected_gaps(still_running, gap_source=GapSource.OTHER)
    assert (episode_numbers(other_gap) != other_numbers[own_numbers]).sum() == 1


def test_a_single_running_episode_keeps_its_gap():
    gap, own_numbers = selected_gaps(np.arange(NUM_EPISODES) == 5, gap_source=GapSource.OTHER)
    assert episode_numbers(gap) == own_numbers == [5]


def test_mean_gap_is_the_mean_of_the_running_episodes():
    # The first ten of the gaps 0, 0.01 ... 0.47 have a mean of 0.045.
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
    plain_actions, _ = act(agent_with_gaps, gap_source=GapSource.OWN)
    other_actions, _ = act(agent_with_gaps, gap_source=GapSource.OTHER)
    assert (plain_actions != other_actions).any()


def test_sampled_actions_are_all_actions_of_the_task(agent):
    actions = np.concatenate([act(agent, decoding="sample", **changes)[0] for changes in CONTROLS.values()])
    assert set(actions) == set(range(NUM_ACTIONS))
