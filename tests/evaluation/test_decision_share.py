"""Decision shares: closed forms, policies that provably use or ignore a part, and replacements without effect."""

import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.evaluation_steps import AGENT_LOOP, KNOWLEDGE, start_agent, take_step

from jaxnav.evaluation.decision_share import MIN_KL, ShareProbe, is_changed, share_interval
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator, start_states
from jaxnav.evaluation.replacements import DecisionContext, ReplacedPart, embed_decision_inputs, replace_part
from jaxnav.evaluation.statistics import leave_one_out, mean_interval
from jaxnav.evaluation.variants import Replacement, inference_grid, replacement_grid, table_row, table_rows
from jaxnav.policies.features import Features
from jaxnav.policies.methods.hoz import ZoneReading, ZoneRelations
from jaxnav.policies.methods.map_tracker import FREE_BIT, MapReading
from jaxnav.policies.methods.semexp import MappedCategories

PARTS = tuple(part for part in ReplacedPart if part != ReplacedPart.NONE)
ARMS = ("baseline", "layout")
PARAMS = tiny.world()[1].replace(step_limit=jnp.array((12, 16), jnp.int32))
EPISODES = draw_episodes(tiny.BANK, 24, seed=1)
KEY = jax.random.key(3)


def stack_params(change):
    """Stacked parameters of a baseline and a layout policy, after a change of their parameters."""
    changed_params = [change(tiny.random_params(seed)) for seed in (5, 6)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *changed_params)


def scale_inputs(params, scale_by_input):
    """Scale the kernel rows of `fuse` by input: scene, goal, experience, action."""
    input_scales = [scale_by_input.get(name, 1.0) for name in ("scene", "goal", "experience", "action")]
    row_scales = np.repeat(input_scales, AGENT_LOOP.bind(params).widths)
    kernel = params["fuse"]["kernel"] * jnp.asarray(row_scales, jnp.float32)[:, None]
    return params | {"fuse": params["fuse"] | {"kernel": kernel}}


def ignore_experience(params):
    """Parameters of a policy that does not read Z."""
    return scale_inputs(params, {"experience": 0.0})


def use_only_experience(params):
    """Parameters of a policy that reads only Z and its memory, neither direct pathways nor previous actions."""
    params = scale_inputs(params, {"scene": 0.0, "goal": 0.0, "action": 0.0, "experience": 20.0})
    actor = params["actor"] | {"kernel": 20.0 * params["actor"]["kernel"]}
    return params | {"actor": actor}


@pytest.fixture(scope="module")
def probe():
    """Function that measures the shares of every part [variants, parts], after a change of the parameters."""
    share_probe = ShareProbe(AGENT_LOOP, PARTS)
    rows = [table_row(variant, None, None, "sample") for variant in ARMS]
    grid = inference_grid(rows, ARMS, 1)

    def measure(change):
        counts = share_probe(grid, stack_params(change), start_states(EPISODES), PARAMS, KNOWLEDGE, KEY)
        return counts, counts.changed.sum(axis=1) / counts.weighted_decisions.sum(axis=1)[:, None]

    return measure


def test_a_decision_changes_if_its_best_action_does_and_kl_exceeds_the_bound():
    def changed(probs, changed_probs):
        return bool(is_changed(jnp.log(jnp.array(probs)), jnp.log(jnp.array(changed_probs))))

    # The bound, 0.02 nats, lies between KL((0.51, 0.49) || (0.49, 0.51)) = 0.02 ln (0.51 / 0.49) = 0.0008 and
    # KL((0.6, 0.4) || (0.4, 0.6)) = 0.2 ln 1.5 = 0.081.
    assert 0.02 * math.log(0.51 / 0.49) < MIN_KL < 0.2 * math.log(1.5)
    assert changed((0.6, 0.4), (0.4, 0.6))
    assert not changed((0.51, 0.49), (0.49, 0.51))
    # The best action does not change, although KL is large.
    assert not changed((0.98, 0.02), (0.51, 0.49))


def share_of(shares, part):
    """Column of a part in an array whose last axis has all parts."""
    return shares[..., PARTS.index(part)]


@pytest.mark.slow
def test_a_policy_that_ignores_experience_has_shares_of_zero(probe):
    counts, shares = probe(ignore_experience)
    experience_parts = (
        ReplacedPart.OTHER_CATEGORIES,
        ReplacedPart.EXPERIENCE,
        ReplacedPart.PRIOR_WEIGHTS,
        ReplacedPart.UNIFORM_WEIGHTS,
    )
    for part in experience_parts:
        assert (share_of(shares, part) == 0).all()
    assert counts.deleted.sum() == 0
    assert share_of(counts.partner_differences, ReplacedPart.EXPERIENCE).sum() == 0
    # Negative control: the policy reads scene and goal.
    assert (share_of(shares, ReplacedPart.SCENE_AND_GOAL) > 0.05).all()


@pytest.mark.slow
def test_a_policy_of_experience_depends_on_no_direct_pathway(probe):
    _, shares = probe(use_only_experience)
    assert (share_of(shares, ReplacedPart.SCENE_AND_GOAL) == 0).all()
    assert (share_of(shares, ReplacedPart.EXPERIENCE) > 0.1).all()
    assert (share_of(shares, ReplacedPart.OTHER_CATEGORIES) > 0.05).all()
    # The baseline has no layout weights w to replace.
    assert share_of(shares, ReplacedPart.UNIFORM_WEIGHTS)[ARMS.index("baseline")] == 0


def replaced_and_factual_inputs(agent, partner, part, layout_weights=None):
    """Pathways and memory with a part of the partner, and the factual pathways and memory."""

    @jax.jit
    def replace(params, agent):
        policy = AGENT_LOOP.bind(params)
        context = DecisionContext(policy, jnp.bool_(True), AGENT_LOOP, KNOWLEDGE, PARAMS)
        factual = embed_decision_inputs(agent, context)
        if layout_weights is not None:
            inputs = factual.inputs._replace(layout_weights=layout_weights)
            factual = factual._replace(inputs=inputs, pathways=policy.pathways(inputs, factual.memory))
        return replace_part(part, partner, factual, context), (factual.pathways, factual.memory)

    return replace(tiny.random_params(6), agent)


@pytest.mark.slow
@pytest.mark.parametrize(
    "part", [ReplacedPart.OTHER_CATEGORIES, ReplacedPart.EXPERIENCE, ReplacedPart.SCENE_AND_GOAL, ReplacedPart.MEMORY]
)
def test_an_episode_as_its_own_partner_changes_nothing(part):
    # The agents after one step.
    weights = tiny.random_params(6)
    agent = start_agent(weights, start_states(EPISODES), PARAMS)
    cell = tiny.leaves_at(inference_grid([table_row("layout", None, None, "sample")], ("layout",), 1), 0)
    running = jnp.ones(len(EPISODES.goal), bool)
    keys = jax.random.split(KEY, len(EPISODES.goal))
    agent, *_ = take_step(cell, weights, agent, running, keys, PARAMS)

    own_index = jnp.arange(len(EPISODES.goal))
    replaced, factual = replaced_and_factual_inputs(agent, own_index, part)
    chex.assert_trees_all_equal(replaced, factual)
    # Negative control: another episode as partner.
    replaced, factual = replaced_and_factual_inputs(agent, jnp.roll(own_index, 1), part)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_equal(replaced, factual)


def test_uniform_weights_keep_the_weight_of_the_goal():
    """If the weights of all categories but the goal are uniform, their replacement changes nothing."""
    agent = start_agent(tiny.random_params(6), start_states(EPISODES), PARAMS)
    own_index = jnp.arange(len(EPISODES.goal))
    num_categories = KNOWLEDGE.priors.shape[-1]

    def replace_weights(goal_weight, other_weight):
        is_goal = jax.nn.one_hot(agent.state.goal, num_categories, dtype=bool)
        weights = jnp.where(is_goal, goal_weight, other_weight)
        return replaced_and_factual_inputs(agent, own_index, ReplacedPart.UNIFORM_WEIGHTS, weights)

    uniform_weight = 1.0 / (num_categories - 1)
    for goal_weight in (1.0, 1.3):
        replaced, factual = replace_weights(goal_weight, uniform_weight)
        chex.assert_trees_all_equal(replaced, factual)
    # Negative control: larger weights of the other categories.
    replaced, factual = replace_weights(1.3, 2 * uniform_weight)
    assert np.abs(replaced[0].experience - factual[0].experience).max() > 1e-3


@pytest.mark.slow
def test_replacements_leave_other_rows_bit_identical():
    # The outcome of the table without replacements.
    weights = stack_params(ignore_experience)
    rows = table_rows([0.0, 0.5], ["residual"], ARMS)
    grid = inference_grid(rows, ARMS, 1)
    factual = Evaluator(AGENT_LOOP)(grid, weights, [(EPISODES, PARAMS)], KNOWLEDGE, KEY)

    # Two more rows with replacements leave the rows of the table bit-identical.
    layout_row = rows.index(table_row("layout", None, None, "sample"))
    replaced_parts = (ReplacedPart.EXPERIENCE, ReplacedPart.SCENE_AND_GOAL)
    replacements = [Replacement(rows[layout_row], part) for part in replaced_parts]
    replaced_grid = replacement_grid(replacements, ARMS, 1, max_room_episodes=6)
    joint_grid = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), grid, replaced_grid)
    evaluator = Evaluator(AGENT_LOOP, has_controls=False, replaced_parts=replaced_parts)
    outcome = evaluator(joint_grid, weights, [(EPISODES, PARAMS)], KNOWLEDGE, KEY)
    chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[: len(rows)], outcome), factual)

    # Rows with replacements run the first six episodes of each of two room types. The policies ignore Z, so its
    # replacement changes no action; the replacement of scene and goal does.
    has_replacement = EPISODES.room_rank < 6
    assert has_replacement.sum() == 12
    lengths = outcome.length[:, has_replacement]
    np.testing.assert_array_equal(lengths[-2], lengths[layout_row])
    assert (lengths[-1] != lengths[layout_row]).any()
    assert (outcome.length[-2:, ~has_replacement] == 0).all()


def test_share_interval_pools_decisions():
    # Two runs of three episodes: 1 of 10 decisions changes in the first run, and 5 of 20 in the second run.
    num_decisions = np.array([[4, 4, 2], [10, 5, 5]])
    num_changed = np.array([[1, 0, 0], [3, 1, 1]])
    share = share_interval(num_changed, num_decisions, EPISODES.take(np.array([0, 1, 12])).clusters())
    assert share.mean == pytest.approx(20.0)
    assert share.seeds == pytest.approx((10.0, 25.0))

    # A single run has a share without an interval, and without decisions the share is NaN.
    clusters = EPISODES.take(np.arange(3)).clusters()
    single_run_share = share_interval(num_changed[:1], num_decisions[:1], clusters)
    assert single_run_share.mean == pytest.approx(10.0)
    assert not single_run_share.has_bounds
    assert math.isnan(share_interval(num_changed, 0 * num_decisions, clusters).mean)


def test_share_of_fixed_policies_has_an_interval_over_scenes_alone():
    # One policy in 8 scenes of 3 episodes, with ten probed decisions in each: the share is the mean of their shares.
    scenes = leave_one_out(np.repeat(np.arange(8), 3))
    num_changed = np.random.default_rng(0).integers(0, 10, (1, 24))
    share = share_interval(num_changed, np.full_like(num_changed, 10), scenes, trained=False)
    assert share.has_bounds
    expected = mean_interval(10.0 * num_changed, scenes, trained=False)
    np.testing.assert_allclose((share.mean, share.low, share.high), (expected.mean, expected.low, expected.high))


# Replacement of other categories by the methods


def make_features(seed, goal):
    rng = np.random.default_rng(seed)
    goal_one_hot = np.eye(3, dtype=np.float32)[goal]
    return Features(
        view=jnp.zeros(2),
        visible=jnp.asarray(rng.random(3)),
        table=jnp.asarray(rng.random((3, 9))),
        goal=jnp.asarray(goal_one_hot),
    )


def test_hoz_uses_room_and_zones_of_the_other_episode():
    own_features = make_features(0, goal=1)
    other_features = make_features(1, goal=1)
    own_reading = ZoneReading(jnp.array([1.0, 0.0]), jnp.zeros((3, 3)))
    other_reading = ZoneReading(jnp.array([0.0, 1.0]), jnp.ones((3, 3)))
    features, reading = ZoneRelations.replace_other_categories(
        object.__new__(ZoneRelations), own_features, own_reading, other_features, other_reading
    )
    chex.assert_trees_all_equal(reading, other_reading)
    # The goal, category 1, keeps its features.
    for name in ("table", "visible"):
        own_values = getattr(own_features, name)
        other_values = getattr(other_features, name)
        expected = np.stack([other_values[0], own_values[1], other_values[2]])
        np.testing.assert_array_equal(getattr(features, name), expected)


def test_semexp_keeps_floor_and_goal_of_its_map():
    own_features = make_features(0, goal=1)
    other_features = make_features(1, goal=1)
    # Bits of categories 0 to 2; the goal is 1.
    own_reading = MapReading(jnp.array([0b011, 0b000], jnp.uint32) | FREE_BIT, jnp.array([0.0, 1.0]))
    other_reading = MapReading(jnp.array([0b100, 0b111], jnp.uint32), jnp.array([1.0, 0.0]))
    _, reading = MappedCategories.replace_other_categories(
        object.__new__(MappedCategories), own_features, own_reading, other_features, other_reading
    )
    np.testing.assert_array_equal(reading.blocks, np.array([0b110, 0b101], np.uint32) | FREE_BIT)
    np.testing.assert_array_equal(reading.compass, own_reading.compass)
