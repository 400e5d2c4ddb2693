"""The evaluation grid against a plain loop, against itself cell by cell, and its episodes and metrics."""

import logging
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxnav.causal import remove_experience
from jaxnav.env.make import build_evaluation
from jaxnav.env.types import State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import Outcome, evaluate_grid
from jaxnav.evaluation.metrics import episode_metrics
from jaxnav.evaluation.variants import inference_grid, table_rows
from jaxnav.policies.acting import Acting
from jaxnav.policies.pathways import NO_ACTION, Memory
from jaxnav.scenes.compile import compile_bank
from jaxnav.scenes.lattice import DONE, MOVE_AHEAD, POSES_PER_CELL
from jaxnav.scenes.rooms import generate_rooms

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
    return evaluate_grid(grid, WEIGHTS, episodes, acting, tiny.SPEC, PARAMS, PRIORS, jax.random.key(3))[0]


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
                EPISODES,
                Acting(ENV, tiny.SETTING),
                tiny.SPEC,
                PARAMS,
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


def test_cells_alone_are_the_cells_of_the_grid(outcome):
    for row, seed in (
        (ROWS.index(("stde", 0.0, "paper", "argmax")), 1),
        (ROWS.index(("baseline", None, None, "sample")), 0),
    ):
        cell = jax.tree.map(lambda leaf: leaf[row * SEEDS + seed][None], inference_grid(ROWS, SEEDS))  # noqa: B023
        chex.assert_trees_all_equal(tiny.at(run(cell), 0), tiny.at(outcome, row, seed))


def subset(indices) -> EpisodeList:
    leaves = ("scene", "goal", "pose", "best_length", "room")
    return EPISODES._replace(**{name: getattr(EPISODES, name)[indices] for name in leaves})


def test_an_episode_does_not_depend_on_the_others(outcome):
    # Sampled actions follow the number of the episode in the list, so a list's beginning gives the same.
    begun = jax.tree.map(
        lambda leaf: leaf.reshape(len(ROWS), SEEDS, -1), run(inference_grid(ROWS, SEEDS), subset(slice(7)))
    )
    chex.assert_trees_all_equal(begun, jax.tree.map(lambda leaf: leaf[..., :7], outcome))


def test_the_best_action_does_not_depend_on_the_number_of_the_episode(outcome):
    some = np.array([20, 3, 11])
    rows = [row for row in ROWS if row.decoding == "argmax"]
    found = jax.tree.map(
        lambda leaf: leaf.reshape(len(rows), SEEDS, -1), run(inference_grid(rows, SEEDS), subset(some))
    )
    chex.assert_trees_all_equal(found, jax.tree.map(lambda leaf: leaf[: len(rows)][..., some], outcome))


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
        "distance": tiny.BANK.goal_distance[pose // POSES_PER_CELL, goal],
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


# The shortest way in generated rooms


def test_an_oracle_has_full_marks():
    """It goes down the table of best lengths: SR 1 and SPL 1, exactly."""
    bank = compile_bank(generate_rooms(0, 4, 0, seed=5))
    env, params = build_evaluation(bank)
    episodes = episode_list(bank, 200)
    best = jnp.asarray(bank.best_length.astype(np.int32))
    advance = jax.jit(jax.vmap(env.advance, (0, 0, None)))
    time = np.zeros(len(episodes.goal), np.int32)
    state = State(*(jnp.asarray(leaf) for leaf in (episodes.pose, episodes.scene, episodes.goal, time)))
    running, success, length, moves = np.ones_like(time, bool), np.zeros_like(time, bool), time.copy(), time.copy()
    while running.any():
        here = np.asarray(best[state.pose, state.goal])
        ahead = np.asarray(best[params.tables.successor[state.pose][:, :DONE], state.goal[:, None]])
        action = np.where(here == 1, DONE, np.argmax(ahead == here[:, None] - 1, axis=1)).astype(np.int32)
        length += running
        moves += running & (action == MOVE_AHEAD)
        success |= running & (action == DONE) & np.asarray(jax.vmap(env.found, (0, None))(state, params))
        state, _, terminated, truncated = advance(state, jnp.asarray(action), params)
        running &= ~np.asarray(terminated | truncated)
    np.testing.assert_array_equal(length, episodes.best_length)
    distance = bank.goal_distance[np.asarray(state.pose) // POSES_PER_CELL, episodes.goal]
    metrics = episode_metrics(Outcome(success, length, moves, distance, np.zeros(200)), episodes.best_length)
    np.testing.assert_array_equal(metrics["sr"], np.ones(200))
    np.testing.assert_array_equal(metrics["spl"], np.ones(200))
    # Found means 1.5 m at most, of which DTS takes 1 m off.
    assert metrics["dts"].max() <= 0.5 + 1e-6
    assert metrics["sae"].max() <= 1
    assert np.median(length) > 3


# Metrics


def test_metrics_by_hand():
    outcome = Outcome(
        success=np.array([True, True, False, True]),
        length=np.array([10, 1, 30, 4], np.int32),
        moves=np.array([6, 0, 20, 3], np.int32),
        distance=np.array([1.4, 0.3, 3.5, 1.0], np.float32),
        weight=np.zeros(4, np.float32),
    )
    metrics = episode_metrics(outcome, np.array([5, 1, 6, 4]))
    np.testing.assert_array_equal(metrics["sr"], [1, 1, 0, 1])
    # Success x L* / length: 5 / 10, 1 / 1, no success, 4 / 4.
    np.testing.assert_array_equal(metrics["spl"], [0.5, 1, 0, 1])
    # Distance less 1 m, at least 0.
    np.testing.assert_allclose(metrics["dts"], [0.4, 0, 2.5, 0], atol=1e-6)
    # MoveAheads / (length - 1): 6 / 9; an episode of Done alone has none; no success; 3 / 3.
    np.testing.assert_allclose(metrics["sae"], [2 / 3, 0, 0, 1])


# Rows and episodes


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


def test_episodes_are_possible_and_know_their_best_length():
    for scene, goal, pose, best in zip(*EPISODES[:4], strict=True):
        assert goal in tiny.BANK.goals[scene, : tiny.BANK.num_goals[scene]]
        first = tiny.BANK.first_cell[scene] * POSES_PER_CELL
        assert first <= pose < first + tiny.BANK.num_cells[scene] * POSES_PER_CELL
        assert best == tiny.BANK.best_length[pose, goal] >= 1
    assert len(set(EPISODES.pose.tolist())) > 12  # all over the rooms


def test_episodes_are_equally_many_per_room_type_and_scene():
    bank = compile_bank(generate_rooms(0, 6, 0, seed=1))  # two kitchens and living rooms, one of the others
    assert len(bank.names) == 6
    episodes = episode_list(bank, 42)
    assert episodes.rooms == ("bathroom", "bedroom", "kitchen", "living_room")
    # 42 / 4 is rounded up to 11 of each; where there are two scenes they take turns: 6 and 5.
    np.testing.assert_array_equal(np.bincount(episodes.room), [11] * 4)
    by_scene = {bank.room_types[scene]: [] for scene in range(6)}
    for scene, number in enumerate(np.bincount(episodes.scene)):
        by_scene[bank.room_types[scene]].append(number)
    assert by_scene == {"kitchen": [6, 5], "living_room": [6, 5], "bedroom": [11], "bathroom": [11]}
    assert all(
        episodes.rooms[room] == bank.room_types[scene]
        for room, scene in zip(episodes.room, episodes.scene, strict=True)
    )
    assert (episodes.best_length >= 1).all()


def test_episodes_are_fixed_by_bank_and_seed():
    chex.assert_trees_all_equal(episode_list(tiny.BANK, 24, seed=1)[:5], EPISODES[:5])
    assert not np.array_equal(episode_list(tiny.BANK, 24, seed=2).pose, EPISODES.pose)


def test_no_episodes_are_refused():
    with pytest.raises(InputError, match="--episodes 0: give at least 1"):
        episode_list(tiny.BANK, 0)
