"""The evaluation grid against plain loops and against itself, cell by cell."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.evaluation_steps import AGENT_LOOP, KNOWLEDGE, start_agent, take_step

from jaxnav.causal import stde
from jaxnav.choices import Decoding
from jaxnav.evaluation.episodes import draw_episodes, join_episode_lists
from jaxnav.evaluation.grid import Evaluator, start_states
from jaxnav.evaluation.playback import play_episodes
from jaxnav.evaluation.removal import GapSource, RemovedLogits
from jaxnav.evaluation.variants import EvaluationRow, inference_grid, table_row, table_rows
from jaxnav.policies.pathways import NO_ACTION, PolicyState
from jaxnav.scenes.task import DONE, MOVE_AHEAD

SEEDS, LIMITS = 2, (12, 16)
PARAMS = tiny.world()[1].replace(step_limit=jnp.array(LIMITS, jnp.int32))
EPISODES = draw_episodes(tiny.BANK, 24, seed=1)
ARMS = ("baseline", "layout")
ROWS = table_rows([0.0, 0.2, 1.0], ["residual", "paper"], ARMS)
#: Parameters of the two baselines, then of the two layout policies; seeds that say Done here and there.
WEIGHTS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tiny.random_params(seed) for seed in (5, 9, 6, 11)))


def control_cells(epsilon, form, decoding, **changes):
    """The cells of sTDE with something changed."""
    cells = inference_grid([table_row("stde", epsilon, form, decoding)], ARMS, SEEDS)
    return cells.replace(**{name: jnp.full_like(getattr(cells, name), value) for name, value in changes.items()})


#: Controls whose gaps or logits are of other episodes or drawn by key.
CONTROLS = [
    control_cells(0.0, "paper", "argmax", gap_source=GapSource.OTHER),
    control_cells(0.2, "residual", "sample", gap_source=GapSource.MEAN),
    control_cells(0.2, "residual", "sample", gap_source=GapSource.GIVEN, given_gap=1.0, gap_begin=2, gap_end=5),
    control_cells(0.0, "paper", "argmax", removed_source=RemovedLogits.NOISE),
    control_cells(0.0, "paper", "sample", direct_noise=1.0),
]
CELLS = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), inference_grid(ROWS, ARMS, SEEDS), *CONTROLS)
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def evaluated():
    """All rows and controls [R + C, S, E], and the number of compilations that the evaluator reports."""
    evaluator = Evaluator(AGENT_LOOP)
    outcome = evaluator(CELLS, WEIGHTS, [(EPISODES, PARAMS)], KNOWLEDGE, KEY)
    reshaped_outcome = jax.tree.map(lambda leaf: leaf.reshape(-1, SEEDS, len(EPISODES.goal)), outcome)
    return reshaped_outcome, evaluator.compilations


@pytest.fixture(scope="module")
def outcome(evaluated):
    return evaluated[0]


def row_outcome(outcome, variant, epsilon=None, form=None, decoding: Decoding = "argmax"):
    """The outcome [S, E] of one row."""
    return tiny.leaves_at(outcome, ROWS.index(EvaluationRow(variant, epsilon, form, decoding)))


# Cells


def test_the_whole_grid_is_one_compilation(evaluated):
    _, compilations = evaluated
    assert compilations == 1
    # Of each decoding: baseline, layout, TDE, and two forms of three sTDE. And Random.
    assert len(ROWS) == 2 * (3 + 6) + 1


@pytest.mark.parametrize("decoding", ["argmax", "sample"])
@pytest.mark.parametrize("form", ["residual", "paper"])
def test_stde_at_epsilon_one_is_bit_identical_to_the_layout_row(outcome, form, decoding):
    layout = row_outcome(outcome, "layout", decoding=decoding)
    chex.assert_trees_all_equal(row_outcome(outcome, "stde", 1.0, form, decoding), layout)
    assert not layout.mean_weight.any()
    # At epsilon 0 something is taken out, and it matters.
    stde = row_outcome(outcome, "stde", 0.0, form, decoding)
    assert 0.1 < stde.mean_weight.max() < 1
    assert not np.array_equal(stde.length, layout.length)


def test_tde_removes_all_experience(outcome):
    np.testing.assert_array_equal(row_outcome(outcome, "tde", form="paper").mean_weight, np.ones((SEEDS, 24)))
    assert not np.array_equal(row_outcome(outcome, "tde", form="paper").length, row_outcome(outcome, "layout").length)


def test_removal_weight_falls_as_epsilon_rises(outcome):
    # The first step is the same for all, so that its gap is; afterwards they part.
    means = [row_outcome(outcome, "stde", epsilon, "residual").mean_weight.mean() for epsilon in (0.0, 0.2, 1.0)]
    assert means[0] > means[1] > means[2] == 0


def test_random_row_differs_between_seeds(outcome):
    random = row_outcome(outcome, "random", decoding="sample")
    assert not np.array_equal(random.length[0], random.length[1])
    # Done is one of six actions: of all last actions a sixth would be right at best.
    assert 2 < random.length.mean() < 9


def select_episodes(indices):
    """Those of the episodes, and all scenes."""
    return EPISODES._replace(**{name: getattr(EPISODES, name)[indices] for name in EPISODES._fields[:5]})


@pytest.mark.slow
def test_parts_share_a_compilation_and_cells_and_episodes_are_independent(outcome):
    """Two parts of few episodes, in another order and by some of the cells in another order."""
    part_indices = [np.array([0, 1, 2, 3, 20, 11]), np.array([12, 5, 4, 23, 8, 17])]
    row_indices = np.arange(len(ROWS))[::-3]
    grid = inference_grid([ROWS[row] for row in row_indices], ARMS, SEEDS)
    lists = [select_episodes(indices) for indices in part_indices]
    evaluator = Evaluator(AGENT_LOOP)
    result = evaluator(grid, WEIGHTS, [(indices, PARAMS) for indices in lists], KNOWLEDGE, KEY)
    assert evaluator.compilations == 1
    result = jax.tree.map(lambda leaf: leaf.reshape(len(row_indices), SEEDS, -1), result)
    expected = jax.tree.map(lambda leaf: leaf[row_indices][..., np.concatenate(part_indices)], outcome)
    is_argmax = np.array([ROWS[row].decoding == "argmax" for row in row_indices])
    chex.assert_trees_all_equal(tiny.leaves_at(result, is_argmax), tiny.leaves_at(expected, is_argmax))
    # Sampled actions follow the number of the episode in its part, which the first four keep.
    chex.assert_trees_all_equal(tiny.leaves_at(result, ..., slice(4)), tiny.leaves_at(expected, ..., slice(4)))
    assert not np.array_equal(result.length[~is_argmax], expected.length[~is_argmax])
    merged_episodes = join_episode_lists(lists)
    assert merged_episodes.scenes == 2 * EPISODES.scenes
    assert [merged_episodes.scenes[row] for row in merged_episodes.scene] == [
        EPISODES.scenes[row] for row in EPISODES.scene[np.concatenate(part_indices)]
    ]
    for name in ("goal", "pose", "best_length", "room"):
        np.testing.assert_array_equal(
            getattr(merged_episodes, name), getattr(EPISODES, name)[np.concatenate(part_indices)]
        )


@pytest.mark.slow
def test_evaluator_takes_a_single_episode():
    grid = tiny.leaves_at(CELLS, slice(1))
    result = Evaluator(AGENT_LOOP)(grid, WEIGHTS, [(select_episodes(np.array([3])), PARAMS)], KNOWLEDGE, KEY)
    assert result.length.shape == (1, 1)
    assert 1 <= result.length[0, 0] <= max(LIMITS)


# Against a plain loop


def run_plain_loop(seed, episode, layout, epsilon, form) -> dict[str, Any]:
    """One episode, best actions, by single calls."""
    scene, goal, pose = (int(getattr(EPISODES, name)[episode]) for name in ("scene", "goal", "pose"))
    prior, weights, belief = KNOWLEDGE.layout[PARAMS.room[scene]], tiny.leaves_at(WEIGHTS, seed), None
    memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
    length, action, total_weight, moves = 0, None, 0.0, 0
    while length < LIMITS[scene] and action != DONE:
        row = tiny.BANK.rows[pose]
        belief = tiny.believe(prior, belief, row)
        relevance = tiny.goal_weights(belief, goal) if layout else jnp.ones(3)
        factual, counterfactual = tiny.decide(weights, row, goal, relevance, memory)
        removal_weight = jnp.maximum(belief.gap - epsilon, 0)
        logits = stde(factual.logits, counterfactual.logits, belief.gap, epsilon, form)
        action = int(np.argmax(logits))
        length, moves, total_weight = length + 1, moves + (action == MOVE_AHEAD), total_weight + float(removal_weight)
        memory = PolicyState(factual.hidden, jnp.int32(action))  # what is carried on is factual
        pose = int(tiny.BANK.successor[pose, action])
    return {
        "success": action == DONE and tiny.BANK.best_length[pose, goal] == 1,
        "length": length,
        "moves": moves,
        "distance": tiny.BANK.goal_distance[pose // tiny.POSES_PER_CELL, goal],
        "mean_weight": total_weight / length,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "epsilon", "form"),
    [("baseline", None, None), ("layout", None, None), ("stde", 0.0, "paper"), ("stde", 0.2, "residual")],
)
def test_grid_outcomes_equal_a_plain_loop(outcome, variant, epsilon, form):
    result = row_outcome(outcome, variant, epsilon, form)
    layout, threshold = variant != "baseline", jnp.float32(np.inf if epsilon is None else epsilon)
    for seed in range(SEEDS):
        for episode in range(0, 24, 3):
            expected = run_plain_loop(seed + SEEDS * layout, episode, layout, threshold, form or "residual")
            for name, value in expected.items():
                assert getattr(result, name)[seed, episode] == pytest.approx(value, rel=1e-4, abs=1e-6), (name, episode)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(CONTROLS)))
def test_control_outcomes_equal_a_loop_that_keeps_ended_episodes(outcome, number):
    """Leaving ended episodes out changes no one's next running episode and no one's noise."""
    for seed in range(SEEDS):
        cell = tiny.leaves_at(CELLS, (len(ROWS) + number) * SEEDS + seed)
        weights = tiny.leaves_at(WEIGHTS, int(cell.policy_index))
        # Folded with the part, the parameters and the episode.
        policy_key = jax.random.fold_in(jax.random.fold_in(KEY, 0), cell.policy_index)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(policy_key, jnp.arange(len(EPISODES.goal)))
        agent = start_agent(weights, start_states(EPISODES), PARAMS)
        running = np.ones(len(EPISODES.goal), bool)
        success, length, total_weight = ~running, np.zeros(len(running), int), np.zeros(len(running))
        while running.any():
            agent, step_result, inferred = take_step(cell, weights, agent, running, keys, PARAMS)
            success |= running & np.asarray(step_result.success)
            length += running
            total_weight += np.where(running, inferred.removal_weight, 0.0)
            running &= ~np.asarray(step_result.ended)
        result = tiny.leaves_at(outcome, len(ROWS) + number, seed)
        np.testing.assert_array_equal(result.success, success)
        np.testing.assert_array_equal(result.length, length)
        np.testing.assert_allclose(result.mean_weight, total_weight / length, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_played_episodes_agree_with_the_grid(outcome):
    row = ROWS.index(EvaluationRow("stde", 0.2, "residual", "argmax"))
    cell = tiny.leaves_at(CELLS, row * SEEDS + 1)
    traces = play_episodes(
        cell, tiny.leaves_at(WEIGHTS, int(cell.policy_index)), start_states(EPISODES), AGENT_LOOP, PARAMS, KNOWLEDGE
    )
    for episode, trace in enumerate(traces):
        result = tiny.leaves_at(outcome, row, 1, episode)
        assert (len(trace.pose), trace.success) == (result.length, result.success)
        assert trace.pose[0] == EPISODES.pose[episode]
        assert not (trace.action[:-1] == DONE).any()
        assert np.maximum(trace.gap - 0.2, 0).mean() == pytest.approx(result.mean_weight, abs=1e-6)
        inferred, weight = trace.inferred, np.maximum(trace.gap - 0.2, 0)[:, None]
        np.testing.assert_allclose(inferred.removal_weight, weight[:, 0], atol=1e-7)
        # Equation 2 in its residual form, and the best action of what it gives.
        expected = (1 + weight) * inferred.factual_logits - weight * inferred.removed_logits
        np.testing.assert_allclose(inferred.action_logits, expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(trace.action, inferred.action_logits.argmax(axis=1))
        assert inferred.layout_weights.shape == (len(trace.pose), len(tiny.CATEGORIES))


def test_episodes_end_at_done_or_at_their_step_limit(outcome):
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
