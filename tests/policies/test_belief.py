"""Belief: looks, squares and scores against NumPy twins, exact removal, the fit, and homes that are refused."""

import dataclasses
import functools
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE, corridor_scene

from jaxnav.causal import do, remove_from_sum, stde, tde
from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.evaluation.removal import apply_removal
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.agent_loop import AgentLoop, policy_memory
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import belief_fit
from jaxnav.policies.methods.belief import (
    BELIEF,
    DIRICHLET,
    MAP_CELLS,
    MAP_SQUARES,
    TargetControl,
    check_belief_map,
    learn_belief_setup,
)
from jaxnav.policies.methods.belief_fit import (
    HomeObjects,
    LookCounts,
    Snapshots,
    count_looks,
    detection_rates,
    goal_losses,
    locate_objects,
)
from jaxnav.policies.methods.belief_map import (
    NO_TARGET_SCORE,
    RADII,
    box_sum,
    floor_features,
    missed_looks,
    nearby_categories,
    read_squares,
    relation_scores,
    score_targets,
    travel_costs,
)
from jaxnav.policies.methods.map_tracker import (
    EXPLORED_BIT,
    FREE_BIT,
    NUM_LOOK_DISTANCES,
    WALL_BIT,
    MapTracker,
    make_view_table,
    nearest_looks,
)
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.policies.testing import check_method
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, VIEW_BLOCKED, VIEW_FREE, VIEW_UNKNOWN, RowFormat
from jaxnav.scenes.task import Rules, Task

NUM_CATEGORIES = len(CATEGORIES)
SPECS = {method: PolicySpec(method, NUM_CATEGORIES) for method in (BELIEF, DIRICHLET)}
ROWS = RowFormat(NUM_CATEGORIES)
VIEW_TABLE = make_view_table(Rules(headings=8), ROWS.view)
#: Squares along each side of a small map; a map has 2 x 2 cells in each.
NUM_SQUARES = 20
ENV, PARAMS = tiny.world()


@functools.cache
def make_knowledge():
    setup = learn_belief_setup([tiny.BANK], np.zeros(0))
    return tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, setup))


def random_cells(rng, size=2 * NUM_SQUARES):
    """A map on which every bit is drawn at random."""
    words = np.zeros((size, size), np.uint32)
    for bit in (1 << BOOK, 1 << CHAIR, 1 << FRIDGE, int(EXPLORED_BIT), int(FREE_BIT), int(WALL_BIT)):
        words |= np.where(rng.random((size, size)) < 0.1, np.uint32(bit), np.uint32(0))
    return words


def random_policy_params(method=BELIEF, seed=0):
    """Random parameters, so that scores depend on all inputs."""
    rng = np.random.default_rng(seed)
    params = init_params(SPECS[method], jax.random.key(seed))
    params = jax.tree.map(lambda leaf: leaf + jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), params)
    rates = rng.uniform(0.1, 0.9, params["detection_rates"].shape)
    return params | {"detection_rates": jnp.asarray(rates, jnp.float32)}


# Squares and looks


@pytest.mark.slow
def test_squares_are_those_of_a_twin():
    rng = np.random.default_rng(0)
    cells = random_cells(rng)
    look_counts = rng.integers(0, 9, (NUM_LOOK_DISTANCES, NUM_SQUARES, NUM_SQUARES)).astype(np.uint8)
    squares = read_squares(jnp.asarray(cells), jnp.asarray(look_counts))
    for row, column in np.ndindex(NUM_SQUARES, NUM_SQUARES):
        square_cells = cells[2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
        assert squares.categories[row, column] == np.bitwise_or.reduce(square_cells, axis=None)
        shares = [(square_cells & flag > 0).mean() for flag in (EXPLORED_BIT, FREE_BIT, WALL_BIT)]
        np.testing.assert_allclose(squares.floor[:, row, column], shares, rtol=1e-6)
    np.testing.assert_array_equal(squares.looks, look_counts)


def neighbours(row, column, radius):
    """Rows and columns of the squares within a Chebyshev distance, on a map that wraps around."""
    span = np.arange(-radius, radius + 1)
    return np.ix_((row + span) % NUM_SQUARES, (column + span) % NUM_SQUARES)


@pytest.mark.slow
def test_features_of_a_square_are_those_of_a_twin():
    rng = np.random.default_rng(1)
    categories = rng.choice(np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 4], np.uint32), (NUM_SQUARES, NUM_SQUARES))
    floor = rng.random((3, NUM_SQUARES, NUM_SQUARES)).astype(np.float32)
    weights = rng.normal(size=(len(RADII), NUM_CATEGORIES)).astype(np.float32)
    features = np.asarray(floor_features(jnp.asarray(floor)))
    scores = np.asarray(relation_scores(nearby_categories(jnp.asarray(categories)), jnp.asarray(weights)))
    for row, column in ((0, 0), (3, 19), (10, 7), (19, 19)):
        # Floor shares of the square itself, and their means within 1 and 3 squares.
        expected_features = [floor[:, row, column]]
        for radius in (1, 3):
            expected_features.append(floor[(slice(None), *neighbours(row, column, radius))].mean(axis=(1, 2)))
        np.testing.assert_allclose(features[:, row, column], np.concatenate(expected_features), rtol=1e-5)

        # A category counts once within each radius in which it was seen.
        expected_score = 0.0
        for radius, radius_weights in zip(RADII, weights, strict=True):
            category_bits = np.bitwise_or.reduce(categories[neighbours(row, column, radius)], axis=None)
            for category in range(NUM_CATEGORIES):
                if category_bits >> category & 1:
                    expected_score += radius_weights[category]
        np.testing.assert_allclose(scores[row, column], expected_score, rtol=1e-4, atol=1e-5)


def test_missed_looks_follow_worked_arithmetic():
    # Two looks with rate 1/2 and one with rate 1/4 miss with (1/2)^2 x 3/4 = 3/16, unless hidden (odds 1: half).
    look_counts = jnp.zeros((NUM_LOOK_DISTANCES, 1, 2)).at[0, 0, 0].set(2.0).at[1, 0, 0].set(1.0)
    rates = jnp.zeros(NUM_LOOK_DISTANCES).at[0].set(0.5).at[1].set(0.25)
    missed = missed_looks(look_counts, rates, jnp.float32(0.0))
    np.testing.assert_allclose(np.exp(missed), [[0.5 + 0.5 * 3 / 16, 1.0]], rtol=1e-6)
    never_hidden = missed_looks(look_counts, rates, jnp.float32(-30.0))
    np.testing.assert_allclose(np.exp(never_hidden), [[3 / 16, 1.0]], rtol=1e-6)


def test_view_looks_at_its_squares_from_the_nearest_cell():
    """Heading north from cell (8, 8): cells 1 and 2 ahead are seen, 3 ahead is hidden, 4 ahead is blocked and seen."""
    view = np.full((1, ROWS.view, ROWS.view), VIEW_UNKNOWN, np.uint8)
    view[0, [1, 2, 4], ROWS.view // 2] = VIEW_FREE, VIEW_FREE, VIEW_BLOCKED
    row = jnp.asarray(ROWS.pack(np.zeros((1, NUM_CATEGORIES, 4), np.uint8), view)[0])
    distance_bin = np.asarray(nearest_looks(row, jnp.array([8, 8], jnp.int32), jnp.int32(0), ROWS, VIEW_TABLE, 32))
    # Cells (9, 8), 0.25 m, and (10, 8), 0.5 m, are in squares (4, 4) and (5, 4); (12, 8), 1 m, is in square (6, 4).
    expected = np.full((16, 16), NUM_LOOK_DISTANCES)
    expected[[4, 5, 6], 4] = 0, 1, 2
    np.testing.assert_array_equal(distance_bin, expected)


# Targets


def test_target_score_is_the_log_of_the_nearby_probability_per_action():
    rng = np.random.default_rng(2)
    log_belief = rng.normal(size=(NUM_SQUARES, NUM_SQUARES)).astype(np.float32)
    log_cost = rng.random((NUM_SQUARES, NUM_SQUARES)).astype(np.float32)
    scores = np.asarray(score_targets(jnp.asarray(log_belief), jnp.asarray(log_cost)))
    belief = np.exp(log_belief) / np.exp(log_belief).sum()
    for row, column in ((0, 0), (5, 18), (12, 3)):
        expected = np.log(belief[neighbours(row, column, 3)].sum()) - log_cost[row, column]
        np.testing.assert_allclose(scores[row, column], expected, rtol=1e-4)


@pytest.mark.slow
def test_only_reachable_unexplored_squares_are_targets():
    """A closed chamber of 6 x 6 cells around the agent, in which one cell is unexplored."""
    cells = np.zeros((32, 32), np.uint32)
    cells[9:17, 9:17] = WALL_BIT | EXPLORED_BIT
    cells[10:16, 10:16] = FREE_BIT | EXPLORED_BIT
    cells[15, 13] = FREE_BIT
    log_cost, has_target = travel_costs(jnp.asarray(cells), jnp.array([11, 12], jnp.int32))
    expected = np.zeros((16, 16), bool)
    expected[7, 6] = True  # cell (15, 13)
    np.testing.assert_array_equal(has_target, expected)
    # Four steps, plus the 6 extra actions that `travel_costs` adds to every distance.
    np.testing.assert_allclose(log_cost[7, 6], np.log(4 + 6.0), rtol=1e-6)


def test_box_sums_wrap_around():
    values = jnp.zeros((2, 8, 8)).at[1, 0, 7].set(3.0)
    expected = np.zeros((2, 8, 8))
    expected[1][np.ix_([7, 0, 1], [6, 7, 0])] = 3.0
    np.testing.assert_array_equal(box_sum(values, 1), expected)


# Policy and removal


@functools.cache
def make_agent(num_episodes=4):
    """Agents at the start of episodes in the tiny world, and policy inputs whose maps hold marks of all categories."""
    agent_loop = AgentLoop(ENV, SPECS[BELIEF], tiny.ESTIMATOR)
    knowledge = make_knowledge()
    memory = agent_loop.bind(random_policy_params()).initial_memory((num_episodes,))
    agent = jax.jit(lambda: agent_loop.start(jax.random.key(0), num_episodes, memory, knowledge, PARAMS))()
    inputs = jax.jit(lambda agent: agent_loop.policy_inputs(agent, knowledge, PARAMS))(agent)

    # Add random categories to the maps.
    category_bits = random_cells(np.random.default_rng(6), MAP_CELLS) & np.uint32((1 << NUM_CATEGORIES) - 1)
    cells = inputs.reading.cells | jnp.asarray(category_bits)[None]
    return agent, inputs._replace(reading=inputs.reading._replace(cells=cells))


def score_pathways(method, params):
    """Pathways of the agents, their factual logits, and their counterfactual logits."""
    agent, inputs = make_agent()

    @jax.jit
    def decide(params):
        policy = bind(SPECS[method], params)
        memory = policy_memory(agent)
        pathways = policy.pathways(inputs, memory)
        counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), memory)
        return pathways, policy.decide(pathways, memory).logits, counterfactual.logits

    return decide(params)


@pytest.mark.slow
@pytest.mark.parametrize("method", [BELIEF, DIRICHLET], ids=["loglinear", "dirichlet"])
def test_equation_1_leaves_the_search_by_places_bit_for_bit(method):
    params = random_policy_params(method)
    pathways, logits, counterfactual = score_pathways(method, params)
    assert logits.shape == (4, MAP_SQUARES**2)
    assert (np.asarray(pathways.scene) > NO_TARGET_SCORE).sum(axis=1).min() > 100
    assert np.abs(counterfactual).max() > 0.1  # there is experience to remove

    # A policy whose predictor adds nothing searches by places.
    places_params = params | {"method": jax.tree.map(jnp.zeros_like, params["method"])}
    _, places_logits, places_counterfactual = score_pathways(method, places_params)
    np.testing.assert_array_equal(tde(logits, counterfactual), places_logits)
    np.testing.assert_array_equal(places_counterfactual, np.zeros_like(places_counterfactual))


def paper_config(epsilon):
    """Inference by sTDE in its paper form."""
    grid = inference_grid([table_row("stde", epsilon, "paper", "argmax")], ("layout",), 1)
    return jax.tree.map(lambda leaf: leaf[0], grid)


@pytest.mark.slow
def test_removal_from_target_scores_is_equation_2_in_its_paper_form():
    # Compare the logits of targets; squares that are no target have a score far below.
    _, logits, counterfactual = score_pathways(BELIEF, random_policy_params())
    is_target = np.asarray(logits) > NO_TARGET_SCORE / 2
    gap = jnp.array([0.0, 0.3, 0.9, 1.0])
    for epsilon in (0.0, 0.25, 1.0):
        result, _ = apply_removal(paper_config(epsilon), logits, counterfactual, gap, has_additive_scores=True)
        expected = stde(logits, counterfactual, gap, epsilon, "paper")
        np.testing.assert_allclose(np.asarray(result)[is_target], np.asarray(expected)[is_target], atol=1e-5)
        if epsilon >= 1:
            np.testing.assert_array_equal(result, logits)

    # A gap of 1 with epsilon 0 removes everything.
    result, weight = apply_removal(paper_config(0.0), logits, counterfactual, gap, has_additive_scores=True)
    np.testing.assert_array_equal(result[3], tde(logits, counterfactual)[3])
    np.testing.assert_array_equal(weight, gap)


@pytest.mark.slow
def test_mixture_form_scores_targets_by_the_mixture_of_beliefs():
    rng = np.random.default_rng(0)
    log_places, log_layout, log_cost = rng.normal(size=(3, MAP_SQUARES, MAP_SQUARES)).astype(np.float32)
    places_scores = score_targets(jnp.asarray(log_places), jnp.asarray(log_cost))
    layout_scores = score_targets(jnp.asarray(log_layout), jnp.asarray(log_cost))
    experience = layout_scores - places_scores

    # Mix the normalised beliefs and score the mixture.
    places_belief = np.exp(log_places) / np.exp(log_places).sum()
    layout_belief = np.exp(log_layout) / np.exp(log_layout).sum()
    for gap in (0.0, 0.3, 1.0):
        mixed_belief = (1 - gap) * layout_belief + gap * places_belief
        expected = score_targets(jnp.log(jnp.asarray(mixed_belief)), jnp.asarray(log_cost))
        mixed_scores = remove_from_sum(places_scores, experience, jnp.full(MAP_SQUARES, gap), 0.0, "mixture")
        np.testing.assert_allclose(mixed_scores, expected, atol=1e-4)


@pytest.mark.slow
def test_scores_are_computed_only_where_a_target_is_due():
    _, inputs = make_agent()
    is_due = jnp.array([True, False, False, True])
    inputs = inputs._replace(reading=inputs.reading._replace(is_due=is_due))
    pathways = jax.jit(lambda params: bind(SPECS[BELIEF], params).pathways(inputs))(random_policy_params())
    np.testing.assert_array_equal(np.asarray(pathways.scene).any(axis=1), is_due)


def test_dirichlet_spreads_the_log_of_the_relative_weights():
    """One chair and a goal with weights 0.2 for the chair and 0.6 for the fridge: the chair is half of the mean."""
    cells = jnp.zeros((MAP_CELLS, MAP_CELLS), jnp.uint32).at[20, 20].set(1 << CHAIR)
    squares = read_squares(cells, jnp.zeros((NUM_LOOK_DISTANCES, MAP_SQUARES, MAP_SQUARES), jnp.uint8))
    params = init_params(SPECS[DIRICHLET], jax.random.key(0))
    params["method"]["radius_weights"] = jnp.array([1.0, 0.5, 0.25, 0.125])
    weights = jnp.array([1.0, 0.2, 0.6])

    @jax.jit
    def score_squares(params):
        return bind(SPECS[DIRICHLET], params).method.score_squares(squares, jnp.int32(BOOK), weights)  # type: ignore

    # Every radius within which the chair lies adds its weight times log(0.2 / 0.4): all radii in square (10, 10), 4
    # and 8 squares in square (10, 13), and none in square (10, 19).
    scores = np.asarray(score_squares(params))
    np.testing.assert_allclose(scores[10, 10], 1.875 * np.log(0.5), rtol=1e-5)
    np.testing.assert_allclose(scores[10, 13], 0.375 * np.log(0.5), rtol=1e-5)
    assert scores[10, 19] == 0.0


def test_control_walks_to_the_chosen_square():
    state = MapTracker().init(make_knowledge())
    control = TargetControl()
    assert control.num_choices == MAP_SQUARES**2
    choice = jnp.int32(7 * MAP_SQUARES + 30)
    _, next_state = jax.jit(control.act)(choice, state, make_knowledge())
    np.testing.assert_array_equal(next_state.block_start, [14, 60])
    assert next_state.actions_left == control.interval == 5


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["belief", "jaxnav.policies.methods.belief:DIRICHLET"])
def test_contract_of_methods_holds(name):
    check_method(name, steps=3)


# Fit


def test_objects_of_a_home_are_where_its_detector_reports_them():
    """In a corridor along z, a book is in the last cell, 23 cells from the first."""
    bank = compile_bank([corridor_scene(24)], Task(CATEGORIES, detector=PERFECT_DETECTOR))
    home_objects = locate_objects(bank)
    np.testing.assert_array_equal(home_objects.categories, [[BOOK]])
    np.testing.assert_array_equal(home_objects.positions, [[[23, 0]]])
    np.testing.assert_array_equal(home_objects.cell_positions[:3], [[0, 0], [1, 0], [2, 0]])


def test_rates_are_hits_per_look_and_rare_categories_have_the_mean_rate():
    look_counts = np.zeros((2, NUM_LOOK_DISTANCES), np.float32)
    hits = np.zeros_like(look_counts)
    look_counts[0, 0] = 98.0
    hits[0, 0] = 73.5
    rates = np.asarray(detection_rates(LookCounts(jnp.asarray(look_counts), jnp.asarray(hits))))
    # Mean rate (73.5 + 0.5) / (98 + 1) = 74 / 99. Two looks with the mean rate are added to the 98 looks,
    # (73.5 + 2 x 74 / 99) / 100, and a category without looks has the mean rate itself.
    np.testing.assert_allclose(rates[:, 0], [(73.5 + 148 / 99) / 100, 74 / 99], rtol=1e-5)
    np.testing.assert_allclose(rates[:, 1], [0.5, 0.5], rtol=1e-5)


@pytest.mark.slow
def test_looks_at_an_object_are_counted_by_distance_and_hit_where_it_is_detected():
    """Looking north in a corridor at a book 4 cells ahead: a look from 1 m, and a hit."""
    # The agent is in cell 19, looks north (heading 0) and down (horizon 1).
    bank = compile_bank([corridor_scene(24)], Task(CATEGORIES, detector=PERFECT_DETECTOR))
    pose = (19 * 8 + 0) * 2 + 1
    row = jnp.asarray(bank.rows[pose])

    # Squares of a book 4 cells ahead and of a chair 40 cells ahead, out of sight.
    state = MapTracker().init(make_knowledge())
    object_squares = (state.position[None] + jnp.array([[4, 0], [40, 0]], jnp.int32)) % MAP_CELLS // 2
    object_categories = jnp.array([BOOK, CHAIR], jnp.int32)
    agent_loop = AgentLoop(dataclasses.replace(ENV, task=bank.task))
    counts = count_looks(state, row, object_squares, object_categories, agent_loop)
    expected = np.zeros((NUM_CATEGORIES, NUM_LOOK_DISTANCES))
    expected[BOOK, 2] = 1.0
    np.testing.assert_array_equal(counts.looks, expected)
    np.testing.assert_array_equal(counts.hits, expected)


def make_snapshot(rng):
    """A random map, and two books and a fridge that are not on it."""
    shape = (MAP_SQUARES, MAP_SQUARES)
    return Snapshots(
        categories=jnp.asarray(np.where(rng.random(shape) < 0.05, 1 << CHAIR, 0).astype(np.uint32)),
        floor=jnp.asarray(rng.integers(0, 5, (3, *shape)).astype(np.uint8)),
        looks=jnp.asarray(rng.integers(0, 3, (NUM_LOOK_DISTANCES, *shape)).astype(np.uint8)),
        object_squares=jnp.array([[3, 4], [10, 40], [7, 7], [0, 0]], jnp.int32),
        object_categories=jnp.array([BOOK, BOOK, FRIDGE, NUM_CATEGORIES], jnp.int32),
    )


@pytest.mark.slow
def test_losses_are_negative_log_likelihoods_of_the_goals_squares():
    snapshot = make_snapshot(np.random.default_rng(3))
    policy = bind(SPECS[BELIEF], random_policy_params())
    goals = jnp.array([BOOK, CHAIR, FRIDGE], jnp.int32)
    weights = jnp.ones((3, NUM_CATEGORIES))
    losses = jax.jit(lambda: goal_losses(policy, snapshot, goals, weights))()  # type: ignore[arg-type]
    places_loss, layout_loss, num_goals = losses
    assert num_goals == 2  # the chair is on the map

    # Minus the log of the probability on the squares of each goal, by either belief.
    squares = read_squares(jnp.zeros((MAP_CELLS, MAP_CELLS), jnp.uint32), snapshot.looks)
    squares = squares._replace(categories=snapshot.categories, floor=snapshot.floor.astype(jnp.float32) / 4)
    expected = np.zeros(2)
    for goal, goal_squares in ((BOOK, [(3, 4), (10, 40)]), (FRIDGE, [(7, 7)])):
        beliefs = policy.log_beliefs(squares, jnp.int32(goal), weights[0])  # type: ignore[attr-defined]
        for index, log_belief in enumerate(np.asarray(beliefs, np.float64)):
            belief = np.exp(log_belief) / np.exp(log_belief).sum()
            expected[index] -= np.log(sum(belief[square] for square in goal_squares))
    np.testing.assert_allclose([places_loss, layout_loss], expected, rtol=1e-4)


@pytest.mark.slow
def test_fit_learns_that_books_stand_near_chairs(monkeypatch):
    """The fit makes squares near chairs likelier for books, by the layout and not by the places."""
    monkeypatch.setattr(belief_fit, "NUM_FIT_STEPS", 30)
    monkeypatch.setattr(belief_fit, "FIT_BATCH", 8)

    # Snapshots with one chair each, and all objects on the square next to the chair.
    rng = np.random.default_rng(4)
    snapshots = [make_snapshot(rng) for _ in range(8)]
    for index, snapshot in enumerate(snapshots):
        chair_square = rng.integers(2, MAP_SQUARES - 2, 2)
        categories = np.zeros((MAP_SQUARES, MAP_SQUARES), np.uint32)
        categories[tuple(chair_square)] = 1 << CHAIR
        object_squares = jnp.asarray(np.repeat(chair_square[None] + [[0, 1]], 4, axis=0), jnp.int32)
        snapshots[index] = snapshot._replace(categories=jnp.asarray(categories), object_squares=object_squares)
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *snapshots)

    # Fit with the book as the only goal.
    agent_loop = AgentLoop(ENV, SPECS[BELIEF])
    params = init_params(SPECS[BELIEF], jax.random.key(0))
    goals = jnp.array([BOOK], jnp.int32)
    weights = jnp.ones((1, NUM_CATEGORIES))
    fitted_params = belief_fit.fit_weights(agent_loop, params, batch, goals, weights, jax.random.key(1))
    relations = np.asarray(fitted_params["method"]["relations"])
    assert relations[BOOK, :, CHAIR].sum() > 1.0
    assert not relations[FRIDGE].any()  # no goal of the fit
    np.testing.assert_array_equal(fitted_params["detection_rates"], params["detection_rates"])


# The custom predictor of the documentation


def test_documented_predictor_scores_by_its_weights():
    """A book is attracted by a chair with weight 1 within the smallest radius, halved from radius to radius."""
    # Run the only code block of the page.
    page = Path(__file__).parents[2] / "docs" / "belief.md"
    (code_block,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    definitions: dict[str, Any] = {"__name__": "page"}
    exec(compile(code_block, str(page), "exec"), definitions)

    # The book is attracted by the chair in square (10, 10).
    spec = PolicySpec(definitions["ATTRACTION"], NUM_CATEGORIES)
    params = init_params(spec, jax.random.key(0))
    assert not params["method"]["attraction"].any()
    params["method"]["attraction"] = params["method"]["attraction"].at[BOOK, CHAIR].set(1.0)
    cells = jnp.zeros((MAP_CELLS, MAP_CELLS), jnp.uint32).at[20, 20].set(1 << CHAIR)
    squares = read_squares(cells, jnp.zeros((NUM_LOOK_DISTANCES, MAP_SQUARES, MAP_SQUARES), jnp.uint8))

    @jax.jit
    def score_squares(params):
        return bind(spec, params).method.score_squares(squares, jnp.int32(BOOK), jnp.ones(3))  # type: ignore

    scores = np.asarray(score_squares(params))
    np.testing.assert_array_equal(scores[10, [10, 14, 18, 19]], [1.875, 0.375, 0.125, 0.0])


# Refusals


def test_home_larger_than_the_map_is_refused():
    # A corridor of 90 lines and the 11 of a view.
    bank = compile_bank([corridor_scene(90)], Task(CATEGORIES))
    knowledge = Knowledge(jnp.zeros((NUM_PRIORS, NUM_CATEGORIES, NUM_CATEGORIES)))
    with pytest.raises(InputError, match=r"search on a map: scene drawn needs a map of 101 x 101 cells.* 96 x 96"):
        check_belief_map(knowledge, bank)
    check_belief_map(knowledge, tiny.BANK)


def test_home_objects_have_as_many_entries_as_the_fullest_home():
    home_objects = locate_objects(tiny.BANK)
    assert isinstance(home_objects, HomeObjects)
    assert home_objects.positions.shape[:2] == home_objects.categories.shape
    counts = (np.asarray(home_objects.categories) < NUM_CATEGORIES).sum(axis=1)
    assert counts.max() == home_objects.categories.shape[1]
    assert counts.min() >= 1
