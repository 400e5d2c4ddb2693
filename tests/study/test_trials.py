"""Rows and trials as cells of the grid."""

from typing import Any, get_args

import chex
import jax
import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.evaluation.removal import GapSource, RemovedLogits
from jaxnav.evaluation.variants import inference_grid, table_rows
from jaxnav.study.records import NEVER, GapSchedule, Trial, TrialControl, trial_grid

ARMS = ("baseline", "layout")
SEEDS = 2
ROWS = table_rows([0.0, 0.2, 1.0], ["residual", "paper"], ARMS)


def of_row(grid, i):
    """Return the cells of one row or trial."""
    return jax.tree.map(lambda leaf: leaf[SEEDS * i : SEEDS * (i + 1)], grid)


@pytest.mark.parametrize("epsilon", [float("nan"), -0.1, float("inf"), float("-inf")])
def test_impossible_epsilons_are_refused(epsilon):
    with pytest.raises(InputError, match=r"--epsilon (nan|-0.1|inf|-inf): give numbers from 0"):
        table_rows([0.5, epsilon], ["paper"], ARMS)


def test_the_grid_holds_a_cell_per_row_and_seed():
    grid = inference_grid(ROWS, ARMS, SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(ROWS) * SEEDS,)}
    by_row = {row: of_row(grid, i) for i, row in enumerate(ROWS)}
    # Baseline and Random use the first two sets of parameters, all others the last two.
    for row, cells in by_row.items():
        plain = row.variant in ("baseline", "random")
        np.testing.assert_array_equal(cells.policy_index, [0, 1] if plain else [2, 3])
        np.testing.assert_array_equal(cells.use_layout, [not plain] * 2)
        np.testing.assert_array_equal(cells.greedy, [row.decoding == "argmax"] * 2)
        np.testing.assert_array_equal(cells.act_randomly, [row.variant == "random"] * 2)
        np.testing.assert_array_equal(cells.use_tde, [row.variant == "tde"] * 2)
        np.testing.assert_array_equal(
            cells.epsilon, np.full(2, np.inf if row.epsilon is None else row.epsilon, np.float32)
        )


def test_cells_are_those_of_stde_but_for_what_the_control_changes():
    plain = Trial("stde", "sample", 0.5, "residual").grid_cells(ARMS, SEEDS)
    changed: dict[TrialControl | GapSchedule, dict[str, Any]] = {
        "shuffled": {"gap_source": GapSource.OTHER},
        "course": {"gap_source": GapSource.MEAN},
        "constant": {
            "gap_source": GapSource.GIVEN,
            "given_gap": np.float32(0.3),
            "gap_end": NEVER,
            "epsilon": np.float32(0.0),
        },
        "after": {"gap_source": GapSource.GIVEN, "given_gap": 1.0, "gap_begin": 7, "gap_end": NEVER},
        "until": {"gap_source": GapSource.GIVEN, "given_gap": 1.0, "gap_end": 7},
        "zeros": {"removed": RemovedLogits.ZEROS},
        "noise": {"removed": RemovedLogits.NOISE},
        "random": {"intervention": 1.0},
    }
    assert set(changed) == {*get_args(TrialControl), *get_args(GapSchedule)}
    for control, expected in changed.items():
        cells = Trial("stde", "sample", 0.5, "residual", control, 7, 0.3).grid_cells(ARMS, SEEDS)
        chex.assert_trees_all_equal_shapes_and_dtypes(cells, plain)
        for name in vars(plain):
            wanted = np.broadcast_to(expected.get(name, getattr(plain, name)), (SEEDS,))
            np.testing.assert_array_equal(getattr(cells, name), wanted, err_msg=f"{control}: {name}")


def test_the_grid_holds_the_seeds_of_one_trial_after_the_other():
    trials = [Trial("baseline", "sample"), Trial("stde", "argmax", 0.2, "paper", "noise"), Trial("tde", "argmax")]
    grid = trial_grid(trials, ARMS, SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(trials) * SEEDS,)}
    for i, trial in enumerate(trials):
        chex.assert_trees_all_equal(of_row(grid, i), trial.grid_cells(ARMS, SEEDS))


def test_trials_that_differ_by_weight_alone_are_equal():
    one, other = (Trial("stde", "argmax", 0.5, "residual", "constant", weight=weight) for weight in (0.1, 0.2))
    assert one == other
    assert hash(one) == hash(other)
    assert one != Trial("stde", "argmax", 0.5, "residual")
