"""Rows and trials as cells of the grid, and what is told of the trials."""

from typing import get_args

import chex
import jax
import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import Outcome
from jaxnav.evaluation.inference import Branch
from jaxnav.evaluation.variants import inference_grid, table_rows
from jaxnav.study.trials import Control, Results, Trial, mean_weight, trial_grid

SEEDS = 2


# Cells

ROWS = table_rows([0.0, 0.2, 1.0], ["residual", "paper"])


def of_row(grid, i):
    """The cells of one row or trial."""
    return jax.tree.map(lambda leaf: leaf[SEEDS * i : SEEDS * (i + 1)], grid)


@pytest.mark.parametrize("epsilon", [float("nan"), -0.1, float("inf"), float("-inf")])
def test_impossible_epsilons_are_refused(epsilon):
    with pytest.raises(InputError, match=r"--epsilon (nan|-0.1|inf|-inf): give numbers from 0"):
        table_rows([0.5, epsilon], ["paper"])


def test_the_grid_holds_a_cell_per_row_and_seed():
    grid = inference_grid(ROWS, SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(ROWS) * SEEDS,)}
    by_row = {row: of_row(grid, i) for i, row in enumerate(ROWS)}
    # Baseline and Random use the first two sets of parameters, all others the last two.
    for row, cells in by_row.items():
        plain = row.variant in ("baseline", "random")
        np.testing.assert_array_equal(cells.params, [0, 1] if plain else [2, 3])
        np.testing.assert_array_equal(cells.layout, [not plain] * 2)
        np.testing.assert_array_equal(cells.greedy, [row.decoding == "argmax"] * 2)
        np.testing.assert_array_equal(cells.uniform, [row.variant == "random"] * 2)
        np.testing.assert_array_equal(cells.always, [row.variant == "tde"] * 2)
        np.testing.assert_array_equal(cells.epsilon, np.float32([np.inf if row.epsilon is None else row.epsilon] * 2))


def test_cells_are_those_of_stde_but_for_what_the_control_changes():
    plain = Trial("stde", "sample", 0.5, "residual").cells(SEEDS)
    changed = {
        "constant": {"always": np.float32(0.3), "epsilon": np.float32(np.inf)},
        "shuffled": {"shuffled": True},
        "zeros": {"branch": Branch.ZEROS},
        "noise": {"branch": Branch.NOISE},
        "random": {"intervention": 1.0},
    }
    assert set(changed) == set(get_args(Control))
    for control, expected in changed.items():
        cells = Trial("stde", "sample", 0.5, "residual", control, 0.3).cells(SEEDS)
        chex.assert_trees_all_equal_shapes_and_dtypes(cells, plain)
        for name in vars(plain):
            wanted = np.broadcast_to(expected.get(name, getattr(plain, name)), (SEEDS,))
            np.testing.assert_array_equal(getattr(cells, name), wanted, err_msg=f"{control}: {name}")


def test_the_grid_holds_the_seeds_of_one_trial_after_the_other():
    trials = [Trial("baseline", "sample"), Trial("stde", "argmax", 0.2, "paper", "noise"), Trial("tde", "argmax")]
    grid = trial_grid(trials, SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(trials) * SEEDS,)}
    for i, trial in enumerate(trials):
        chex.assert_trees_all_equal(of_row(grid, i), trial.cells(SEEDS))


# What is told

#: Four episodes of two seeds; L* = 2, so that success after 4 actions has SPL 0.5.
FEW = [
    Trial("baseline", "sample"),
    Trial("layout", "sample"),
    Trial("stde", "sample", 0.5, "residual"),
    Trial("layout", "argmax"),
]
SUCCESS = [
    [[0, 0, 1, 1], [0, 1, 0, 1]],  # 50 %
    [[1, 0, 1, 1], [1, 1, 1, 1]],  # 75 % and 100 %
    [[1, 1, 1, 1], [1, 1, 1, 0]],  # 100 % and 75 %
    [[0, 0, 0, 0], [0, 0, 0, 1]],  # 0 % and 25 %
]
LENGTH = np.array([[2, 4, 4, 10], [2, 4, 4, 10]])
WEIGHT = np.array([[0.5, 0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 0.0]], np.float32)


def few(success):
    """An outcome [S, E]."""
    return Outcome(np.array(success, bool), LENGTH, np.ones((2, 4), int), np.full((2, 4), 2.5), WEIGHT)


def episodes(scene, room=(0, 0, 0, 0)):
    """Four episodes in these scenes."""
    scene, room, two = np.array(scene), np.array(room), np.full(4, 2)
    names = tuple(f"scene {i}" for i in range(scene.max() + 1))
    return EpisodeList(scene, np.zeros(4, int), np.zeros(4, int), two, room, ("bedroom", "kitchen"), names)


def results(success, about):
    return Results({trial: few(own) for trial, own in zip(FEW, success, strict=False)}, about)


@pytest.fixture(scope="module")
def small():
    return results(SUCCESS, episodes([0, 1, 2, 3]))


def test_the_mean_weight_is_over_steps():
    # 0.5 in 2 steps and 0.1 in 10, of 2 x 20 steps: (1 + 1) / 40. Over episodes it would be 0.6 / 8.
    assert mean_weight(few(SUCCESS[2])) == pytest.approx(0.05)


def test_success_of_a_trial(small):
    np.testing.assert_array_equal(small.success(FEW[1]), SUCCESS[1])


def test_rows_tell_metrics_and_differences(small):
    baseline, layout, stde, other = small.rows(seed=0)
    about = {"variant": "stde", "decoding": "sample", "epsilon": 0.5, "form": "residual", "control": None}
    assert stde.items() >= about.items()
    assert stde["mean_weight"] == pytest.approx(0.05)
    assert layout["sr"]["mean"] == 87.5
    assert layout["sr"]["seeds"] == [75.0, 100.0]
    # Each of 2 / length where found: (1 + 1/2 + 1/5) / 4 and (1 + 1/2 + 1/2 + 1/5) / 4.
    assert layout["spl"]["seeds"] == pytest.approx([42.5, 55.0])
    assert layout["dts"]["mean"] == 1.5  # 2.5 m less the radius
    # + w is compared with the baseline, trained apart; sTDE with + w, seed by seed.
    assert "difference" not in baseline
    assert layout["difference"]["to"] == "baseline"
    assert layout["difference"]["sr"]["mean"] == 37.5
    assert stde["difference"]["to"] == "layout"
    assert stde["difference"]["sr"]["mean"] == 0.0
    # Differences of seeds: +25 and -25.
    assert stde["difference"]["sr"]["std"] == pytest.approx(25 * 2**0.5)
    # Apart: the baseline's seeds do not differ, the layout's by 25.
    assert layout["difference"]["sr"]["std"] == pytest.approx(25 / 2**0.5)
    # Best actions have no baseline to be compared with here.
    assert "difference" not in other


def test_equal_results_have_equal_intervals(small):
    assert small.rows(seed=0) == small.rows(seed=0)
    _, layout, stde = results([SUCCESS[0], SUCCESS[1], SUCCESS[1]], episodes([0, 1, 2, 3])).rows(seed=0)
    assert stde["sr"] == layout["sr"]
    assert stde["difference"]["sr"] == {"mean": 0.0, "std": 0.0, "ci95": (0.0, 0.0)}


@pytest.mark.parametrize(
    ("scene", "room", "interval"),
    [
        # Two scenes of two episodes, both seeds alike: 0, 1/2 or 1 with probabilities 1/4, 1/2, 1/4.
        ([0, 0, 1, 1], [0, 0, 0, 0], (0.0, 100.0)),
        # Scenes with as many of both kinds tell the mean whichever are drawn; episodes by themselves would not.
        ([0, 1, 0, 1], [0, 0, 0, 0], (50.0, 50.0)),
        # Each the only scene of its room type: both are always there.
        ([0, 0, 1, 1], [0, 0, 1, 1], (50.0, 50.0)),
        # A scene of three episodes, one found, and a scene of one: 2 of 6, 2 of 4 or 2 of 2.
        ([0, 0, 0, 1], [0, 0, 0, 0], (100 / 3, 100.0)),
    ],
)
def test_intervals_draw_scenes_with_all_their_episodes(scene, room, interval):
    (row,) = results([[[0, 0, 1, 1]] * 2], episodes(scene, room)).rows(seed=0)
    assert row["sr"]["mean"] == 50.0
    assert row["sr"]["ci95"] == pytest.approx(interval)
