"""The evaluation grid equals plain loops, and its cells and episodes are independent."""

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

NUM_SEEDS = 2
#: Step limits of the kitchen and of the bedroom.
STEP_LIMITS = (12, 16)
PARAMS = tiny.world()[1].replace(step_limit=jnp.array(STEP_LIMITS, jnp.int32))
EPISODES = draw_episodes(tiny.BANK, 24, seed=1)
ARMS = ("baseline", "layout")
ROWS = table_rows([0.0, 0.2, 1.0], ["residual", "paper"], ARMS)
#: Parameters of the two baselines, then of the two layout policies; policies of these seeds sometimes choose Done.
WEIGHTS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tiny.random_params(seed) for seed in (5, 9, 6, 11)))


def control_cells(epsilon, form, decoding, **changes):
    """The cells of sTDE with changed fields."""
    cells = inference_grid([table_row("stde", epsilon, form, decoding)], ARMS, NUM_SEEDS)
    values = {}
    for name, value in changes.items():
        values[name] = jnp.full_like(getattr(cells, name), value)
    return cells.replace(**values)


#: Controls with gaps of other episodes, constant gaps, or random logits.
CONTROLS = [
    control_cells(0.0, "paper", "argmax", gap_source=GapSource.OTHER),
    control_cells(0.2, "residual", "sample", gap_source=GapSource.MEAN),
    control_cells(0.2, "residual", "sample", gap_source=GapSource.GIVEN, given_gap=1.0, gap_begin=2, gap_end=5),
    control_cells(0.0, "paper", "argmax", removed_source=RemovedLogits.NOISE),
    control_cells(0.0, "paper", "sample", direct_noise=1.0),
]
CELLS = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), inference_grid(ROWS, ARMS, NUM_SEEDS), *CONTROLS)
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def evaluated():
    """All rows and controls [R + C, S, E], and the number of compilations that the evaluator reports."""
    evaluator = Evaluator(AGENT_LOOP)
    outcome = evaluator(CELLS, WEIGHTS, [(EPISODES, PARAMS)], KNOWLEDGE, KEY)
    reshaped_outcome = jax.tree.map(lambda leaf: leaf.reshape(-1, NUM_SEEDS, len(EPISODES.goal)), outcome)
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
    # For each of two decodings: baseline, layout, TDE, and sTDE in two forms with three thresholds. In addition Random.
    assert len(ROWS) == 2 * (3 + 6) + 1


@pytest.mark.parametrize("decoding", ["argmax", "sample"])
@pytest.mark.parametrize("form", ["residual", "paper"])
def test_stde_at_epsilon_one_is_bit_identical_to_the_layout_row(outcome, form, decoding):
    layout_outcome = row_outcome(outcome, "layout", decoding=decoding)
    chex.assert_trees_all_equal(row_outcome(outcome, "stde", 1.0, form, decoding), layout_outcome)
    assert not layout_outcome.mean_weight.any()
    # Negative control: at epsilon 0 experience is removed, and episodes change.
    stde_outcome = row_outcome(outcome, "stde", 0.0, form, decoding)
    assert 0.1 < stde_outcome.mean_weight.max() < 1
    assert not np.array_equal(stde_outcome.length, layout_outcome.length)


def test_tde_removes_all_experience(outcome):
    tde_outcome = row_outcome(outcome, "tde", form="paper")
    np.testing.assert_array_equal(tde_outcome.mean_weight, np.ones((NUM_SEEDS, 24)))
    assert not np.array_equal(tde_outcome.length, row_outcome(outcome, "layout").length)


def test_removal_weight_falls_as_epsilon_rises(outcome):
    # The first step has an equal gap in all rows; later gaps differ, because the episodes do.
    mean_weights = []
    for epsilon in (0.0, 0.2, 1.0):
        mean_weights.append(row_outcome(outcome, "stde", epsilon, "residual").mean_weight.mean())
    assert mean_weights[0] > mean_weights[1] > mean_weights[2] == 0


def test_random_row_differs_between_seeds(outcome):
    random_outcome = row_outcome(outcome, "random", decoding="sample")
    assert not np.array_equal(random_outcome.length[0], random_outcome.length[1])
    # Done is one of six actions, so an episode without a step limit takes six steps on average.
    assert 2 < random_outcome.length.mean() < 9


def select_episodes(indices):
    """The list of some episodes, with the names of all scenes."""
    return EPISODES._replace(**{name: getattr(EPISODES, name)[indices] for name in EPISODES._fields[:5]})


@pytest.mark.slow
def test_parts_share_a_compilation_and_cells_and_episodes_are_independent(outcome):
    """Two parts of six episodes each, in another order, give the outcome of the whole grid; so do fewer cells."""
    # Every third row, in reverse order, over two parts of the episodes.
    part_indices = [np.array([0, 1, 2, 3, 20, 11]), np.array([12, 5, 4, 23, 8, 17])]
    row_indices = np.arange(len(ROWS))[::-3]
    grid = inference_grid([ROWS[row] for row in row_indices], ARMS, NUM_SEEDS)
    episode_lists = [select_episodes(indices) for indices in part_indices]
    evaluator = Evaluator(AGENT_LOOP)
    result = evaluator(grid, WEIGHTS, [(episodes, PARAMS) for episodes in episode_lists], KNOWLEDGE, KEY)
    assert evaluator.compilations == 1

    # Episodes with best actions are equal.
    episode_indices = np.concatenate(part_indices)
    result = jax.tree.map(lambda leaf: leaf.reshape(len(row_indices), NUM_SEEDS, -1), result)
    expected = jax.tree.map(lambda leaf: leaf[row_indices][..., episode_indices], outcome)
    is_argmax = np.array([ROWS[row].decoding == "argmax" for row in row_indices])
    chex.assert_trees_all_equal(tiny.leaves_at(result, is_argmax), tiny.leaves_at(expected, is_argmax))
    # Sampled actions depend on the number of the episode in its part, and the first four episodes keep their numbers.
    chex.assert_trees_all_equal(tiny.leaves_at(result, ..., slice(4)), tiny.leaves_at(expected, ..., slice(4)))
    assert not np.array_equal(result.length[~is_argmax], expected.length[~is_argmax])

    # The joined list describes the episodes of both parts.
    joined_episodes = join_episode_lists(episode_lists)
    assert joined_episodes.scenes == 2 * EPISODES.scenes
    joined_names = [joined_episodes.scenes[scene] for scene in joined_episodes.scene]
    assert joined_names == [EPISODES.scenes[scene] for scene in EPISODES.scene[episode_indices]]
    for name in ("goal", "pose", "best_length", "room"):
        np.testing.assert_array_equal(getattr(joined_episodes, name), getattr(EPISODES, name)[episode_indices])


@pytest.mark.slow
def test_evaluator_accepts_a_single_episode():
    grid = tiny.leaves_at(CELLS, slice(1))
    result = Evaluator(AGENT_LOOP)(grid, WEIGHTS, [(select_episodes(np.array([3])), PARAMS)], KNOWLEDGE, KEY)
    assert result.length.shape == (1, 1)
    assert 1 <= result.length[0, 0] <= max(STEP_LIMITS)


# Comparison with a plain loop


def run_plain_loop(policy_index, episode, use_layout, epsilon, form) -> dict[str, Any]:
    """Outcome of one episode with best actions, by single calls."""
    scene = int(EPISODES.scene[episode])
    goal = int(EPISODES.goal[episode])
    pose = int(EPISODES.pose[episode])
    prior = KNOWLEDGE.priors[PARAMS.room[scene]]
    weights = tiny.leaves_at(WEIGHTS, policy_index)

    # State and outcome at the start of the episode.
    belief = None
    memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
    action = None
    length = 0
    moves = 0
    total_weight = 0.0
    while length < STEP_LIMITS[scene] and action != DONE:
        # The belief after the view, and the decision.
        row = tiny.BANK.rows[pose]
        belief = tiny.believe(prior, belief, row)
        layout_weights = tiny.goal_weights(belief, goal) if use_layout else jnp.ones(3)
        factual, counterfactual = tiny.decide(weights, row, goal, layout_weights, memory)
        removal_weight = jnp.maximum(belief.gap - epsilon, 0)
        logits = stde(factual.logits, counterfactual.logits, belief.gap, epsilon, form)
        action = int(np.argmax(logits))

        # The outcome so far, the memory of the factual decision, and the next pose.
        length += 1
        moves += action == MOVE_AHEAD
        total_weight += float(removal_weight)
        memory = PolicyState(factual.hidden, jnp.int32(action))
        pose = int(tiny.BANK.successor[pose, action])
    return {
        "success": action == DONE and tiny.BANK.best_length[pose, goal] == 1,
        "length": length,
        "moves": moves,
        "distance": tiny.BANK.goal_distance[pose // tiny.POSES_PER_CELL, goal],
        "total_weight": total_weight,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "epsilon", "form"),
    [("baseline", None, None), ("layout", None, None), ("stde", 0.0, "paper"), ("stde", 0.2, "residual")],
)
def test_grid_outcomes_equal_a_plain_loop(outcome, variant, epsilon, form):
    result = row_outcome(outcome, variant, epsilon, form)
    use_layout = variant != "baseline"
    threshold = jnp.float32(np.inf if epsilon is None else epsilon)
    for seed in range(NUM_SEEDS):
        policy_index = seed + NUM_SEEDS * use_layout
        for episode in range(0, 24, 3):
            expected = run_plain_loop(policy_index, episode, use_layout, threshold, form or "residual")
            for name, value in expected.items():
                assert getattr(result, name)[seed, episode] == pytest.approx(value, rel=1e-4, abs=1e-6), (name, episode)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(CONTROLS)))
def test_control_outcomes_equal_a_loop_that_keeps_ended_episodes(outcome, number):
    """The grid drops ended episodes from its batch, which changes neither the next running episode nor the noise."""
    for seed in range(NUM_SEEDS):
        cell = tiny.leaves_at(CELLS, (len(ROWS) + number) * NUM_SEEDS + seed)
        weights = tiny.leaves_at(WEIGHTS, int(cell.policy_index))
        # Keys of the episodes: folded with the index of the part, of the policy and of the episode.
        policy_key = jax.random.fold_in(jax.random.fold_in(KEY, 0), cell.policy_index)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(policy_key, jnp.arange(len(EPISODES.goal)))

        # A loop over the full batch until all episodes have ended.
        agent = start_agent(weights, start_states(EPISODES), PARAMS)
        running = np.ones(len(EPISODES.goal), bool)
        success = np.zeros(len(running), bool)
        length = np.zeros(len(running), int)
        total_weight = np.zeros(len(running))
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
    # Play all episodes of the second seed of one row.
    row = ROWS.index(EvaluationRow("stde", 0.2, "residual", "argmax"))
    cell = tiny.leaves_at(CELLS, row * NUM_SEEDS + 1)
    weights = tiny.leaves_at(WEIGHTS, int(cell.policy_index))
    traces = play_episodes(cell, weights, start_states(EPISODES), AGENT_LOOP, PARAMS, KNOWLEDGE)
    for episode, trace in enumerate(traces):
        # The outcome is that of the grid.
        result = tiny.leaves_at(outcome, row, 1, episode)
        assert (len(trace.pose), trace.success) == (result.length, result.success)
        assert trace.pose[0] == EPISODES.pose[episode]
        assert not (trace.action[:-1] == DONE).any()
        expected_weight = np.maximum(trace.gap - 0.2, 0)
        assert expected_weight.mean() == pytest.approx(result.mean_weight, abs=1e-6)
        inferred = trace.inferred
        np.testing.assert_allclose(inferred.removal_weight, expected_weight, atol=1e-7)

        # The logits follow equation 2 in its residual form, and the action is the best one.
        weight = expected_weight[:, None]
        expected = (1 + weight) * inferred.factual_logits - weight * inferred.removed_logits
        np.testing.assert_allclose(inferred.action_logits, expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(trace.action, inferred.action_logits.argmax(axis=1))
        assert inferred.layout_weights.shape == (len(trace.pose), len(tiny.CATEGORIES))


def test_episodes_end_at_done_or_at_their_step_limit(outcome):
    """No episode goes on after Done or after the step limit of its scene."""
    step_limits = np.array(STEP_LIMITS)[EPISODES.scene]
    assert (outcome.length >= 1).all()
    assert (outcome.length <= step_limits).all()
    assert (outcome.length == step_limits).any()
    assert (outcome.moves <= outcome.length).all()
    # A successful episode is at least as long as a shortest path, whose last action is Done.
    assert (outcome.length >= EPISODES.best_length)[outcome.success].all()
    assert outcome.success.any()
    assert not outcome.success.all()
