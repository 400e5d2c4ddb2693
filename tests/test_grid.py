"""The evaluation grid against a plain loop and against itself, cell by cell, and its rows."""

import logging
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxnav.causal import remove_experience
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import episode_list, together
from jaxnav.evaluation.grid import Outcome, evaluate_grid
from jaxnav.evaluation.variants import inference_grid, table_rows
from jaxnav.policies.acting import Acting
from jaxnav.policies.pathways import NO_ACTION, Memory
from jaxnav.scenes.task import DONE, MOVE_AHEAD

SEEDS, LIMITS = 2, (12, 16)
ENV, PARAMS = tiny.world()
PARAMS = PARAMS.replace(step_limit=jnp.array(LIMITS, jnp.int32))
PRIORS = 0.05 * tiny.priors()  # a belief that gives way at once: large gaps
EPISODES = episode_list(tiny.BANK, 24, seed=1)
ROWS = table_rows([0.0, 0.2, 1.0], ["residual", "paper"])
#: Parameters of the two baselines, then of the two layout policies; seeds that say Done here and there.
WEIGHTS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tiny.lively(seed) for seed in (5, 9, 6, 11)))


def run(grid, episodes=EPISODES) -> Outcome:
    acting = Acting(ENV, tiny.SETTING)
    return evaluate_grid(grid, WEIGHTS, [(episodes, PARAMS)], acting, tiny.SPEC, PRIORS, jax.random.key(3))[0]


class Compilations(logging.Handler):
    """The compilations of the grid that JAX reports."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def emit(self, record):
        self.count += record.getMessage().startswith("Compiling jit(run)")


@pytest.fixture(scope="module")
def evaluated():
    """All rows [R, S, E], the compilations that were counted and the number that was told."""
    handler, logger = Compilations(), logging.getLogger("jax")
    logger.addHandler(handler)
    try:
        with jax.log_compiles():
            outcome, told = evaluate_grid(
                inference_grid(ROWS, SEEDS),
                WEIGHTS,
                [(EPISODES, PARAMS)],
                Acting(ENV, tiny.SETTING),
                tiny.SPEC,
                PRIORS,
                jax.random.key(3),
            )
    finally:
        logger.removeHandler(handler)
    return jax.tree.map(lambda leaf: leaf.reshape(len(ROWS), SEEDS, -1), outcome), handler.count, told


@pytest.fixture(scope="module")
def outcome(evaluated):
    return evaluated[0]


def pick(outcome, variant, epsilon=None, form=None, decoding="argmax"):
    """The outcome [S, E] of one row."""
    return tiny.at(outcome, ROWS.index((variant, epsilon, form, decoding)))


# Cells


def test_the_whole_grid_is_one_compilation(evaluated):
    _, counted, told = evaluated
    assert counted == told == 1
    # Of each decoding: baseline, layout, TDE, and two forms of three sTDE. And Random.
    assert len(ROWS) == 2 * (3 + 6) + 1


@pytest.mark.parametrize("decoding", ["argmax", "sample"])
@pytest.mark.parametrize("form", ["residual", "paper"])
def test_at_epsilon_one_nothing_is_taken_out_bit_for_bit(outcome, form, decoding):
    layout = pick(outcome, "layout", decoding=decoding)
    chex.assert_trees_all_equal(pick(outcome, "stde", 1.0, form, decoding), layout)
    assert not layout.weight.any()
    # At epsilon 0 something is taken out, and it matters.
    stde = pick(outcome, "stde", 0.0, form, decoding)
    assert 0.1 < stde.weight.max() < 1
    assert not np.array_equal(stde.length, layout.length)


def test_hard_tde_takes_all_experience_out(outcome):
    np.testing.assert_array_equal(pick(outcome, "tde", form="paper").weight, np.ones((SEEDS, 24)))
    assert not np.array_equal(pick(outcome, "tde", form="paper").length, pick(outcome, "layout").length)


def test_the_weight_falls_as_epsilon_rises(outcome):
    # The first step is the same for all, so that its gap is; afterwards they part.
    means = [pick(outcome, "stde", epsilon, "residual").weight.mean() for epsilon in (0.0, 0.2, 1.0)]
    assert means[0] > means[1] > means[2] == 0


def test_random_is_another_for_every_seed_and_knows_no_policy(outcome):
    random = pick(outcome, "random", decoding="sample")
    assert not np.array_equal(random.length[0], random.length[1])
    # Done is one of six actions: of all last actions a sixth would be right at best.
    assert 2 < random.length.mean() < 9


def test_a_cell_alone_is_the_cell_of_the_grid(outcome):
    row, seed = ROWS.index(("stde", 0.0, "paper", "sample")), 1
    cell = jax.tree.map(lambda leaf: leaf[row * SEEDS + seed][None], inference_grid(ROWS, SEEDS))
    chex.assert_trees_all_equal(tiny.at(run(cell), 0), tiny.at(outcome, row, seed))


def test_parts_of_equal_shape_share_a_compilation_and_follow_each_other(outcome):
    grid = inference_grid([row for row in ROWS if row.decoding == "argmax"], SEEDS)
    halves = [
        EPISODES._replace(**{name: getattr(EPISODES, name)[half] for name in EPISODES._fields[:5]})
        for half in (slice(12), slice(12, 24))
    ]
    acting, key = Acting(ENV, tiny.SETTING), jax.random.key(3)
    parts = [(half, PARAMS) for half in halves]
    found, compilations = evaluate_grid(grid, WEIGHTS, parts, acting, tiny.SPEC, PRIORS, key)
    assert compilations == 1
    chex.assert_trees_all_equal(found, run(grid))
    merged = together(halves)
    assert merged.scenes == 2 * EPISODES.scenes
    assert [merged.scenes[i] for i in merged.scene] == [EPISODES.scenes[i] for i in EPISODES.scene]
    for name in ("goal", "pose", "best_length", "room"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(EPISODES, name))


def test_an_episode_does_not_depend_on_the_others(outcome):
    some = np.array([0, 1, 2, 3, 20, 11])
    leaves = ("scene", "goal", "pose", "best_length", "room")
    subset = EPISODES._replace(**{name: getattr(EPISODES, name)[some] for name in leaves})
    found = run(inference_grid(ROWS, SEEDS), subset)
    found = jax.tree.map(lambda leaf: leaf.reshape(len(ROWS), SEEDS, -1), found)
    expected = jax.tree.map(lambda leaf: leaf[..., some], outcome)
    # Sampled actions follow the number of the episode, which the first four keep; the best actions do not.
    chex.assert_trees_all_equal(tiny.at(found, ..., slice(4)), tiny.at(expected, ..., slice(4)))
    best = np.array([row.decoding == "argmax" for row in ROWS])
    chex.assert_trees_all_equal(tiny.at(found, best), tiny.at(expected, best))
    assert not np.array_equal(found.length[~best], expected.length[~best])


# Against a plain loop


def play(seed, episode, layout, epsilon, form) -> dict[str, Any]:
    """One episode, best actions, by single calls."""
    scene, goal, pose = (int(getattr(EPISODES, name)[episode]) for name in ("scene", "goal", "pose"))
    prior, weights, belief = PRIORS[PARAMS.room[scene]], tiny.at(WEIGHTS, seed), None
    memory = Memory(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
    length, action, total, moves = 0, None, 0.0, 0
    while length < LIMITS[scene] and action != DONE:
        row = tiny.BANK.rows[pose]
        belief = tiny.believe(prior, belief, row)
        relevance = tiny.goal_weights(belief, goal) if layout else jnp.ones(3)
        factual, counterfactual = tiny.decide(weights, row, goal, relevance, memory)
        weight = jnp.maximum(belief.gap - epsilon, 0)
        logits = remove_experience(factual.logits, counterfactual.logits, weight, form)
        action = int(np.argmax(logits))
        length, moves, total = length + 1, moves + (action == MOVE_AHEAD), total + float(weight)
        memory = Memory(factual.hidden, jnp.int32(action))  # what is carried on is factual
        pose = int(tiny.BANK.successor[pose, action])
    return {
        "success": action == DONE and tiny.BANK.best_length[pose, goal] == 1,
        "length": length,
        "moves": moves,
        "distance": tiny.BANK.goal_distance[pose // tiny.POSES_PER_CELL, goal],
        "weight": total / length,
    }


@pytest.mark.parametrize(
    ("variant", "epsilon", "form"),
    [("baseline", None, None), ("layout", None, None), ("stde", 0.0, "paper"), ("stde", 0.2, "residual")],
)
def test_outcomes_are_those_of_a_plain_loop(outcome, variant, epsilon, form):
    found = pick(outcome, variant, epsilon, form)
    layout, threshold = variant != "baseline", jnp.float32(np.inf if epsilon is None else epsilon)
    for seed in range(SEEDS):
        for episode in range(0, 24, 3):
            expected = play(seed + SEEDS * layout, episode, layout, threshold, form or "residual")
            for name, value in expected.items():
                assert getattr(found, name)[seed, episode] == pytest.approx(value, rel=1e-4, abs=1e-6), (name, episode)


def test_episodes_end_once(outcome):
    """There is no second episode after Done or after the limit of the scene."""
    limits = np.array(LIMITS)[EPISODES.scene]
    assert (outcome.length >= 1).all()
    assert (outcome.length <= limits).all()
    assert (outcome.length == limits).any()
    assert (outcome.moves <= outcome.length).all()
    # Success takes Done where the goal is found, so the shortest way at least.
    assert (outcome.length >= EPISODES.best_length)[outcome.success].all()
    assert outcome.success.any()
    assert not outcome.success.all()


# Rows


@pytest.mark.parametrize("epsilon", [float("nan"), -0.1, float("inf"), float("-inf")])
def test_impossible_epsilons_are_refused(epsilon):
    with pytest.raises(InputError, match=r"--epsilon (nan|-0.1|inf|-inf): give numbers from 0"):
        table_rows([0.5, epsilon], ["paper"])


def test_the_grid_holds_a_cell_per_row_and_seed():
    grid = inference_grid(ROWS, SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(ROWS) * SEEDS,)}
    by_row = {row: tiny.at(grid, slice(SEEDS * i, SEEDS * (i + 1))) for i, row in enumerate(ROWS)}
    # Baseline and Random use the first two sets of parameters, all others the last two.
    for row, cells in by_row.items():
        plain = row.variant in ("baseline", "random")
        np.testing.assert_array_equal(cells.params, [0, 1] if plain else [2, 3])
        np.testing.assert_array_equal(cells.layout, [not plain] * 2)
        np.testing.assert_array_equal(cells.greedy, [row.decoding == "argmax"] * 2)
        np.testing.assert_array_equal(cells.uniform, [row.variant == "random"] * 2)
        np.testing.assert_array_equal(cells.always, [row.variant == "tde"] * 2)
        np.testing.assert_array_equal(cells.epsilon, np.float32([np.inf if row.epsilon is None else row.epsilon] * 2))
