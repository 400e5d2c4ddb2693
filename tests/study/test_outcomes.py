"""Metrics and differences of trials, and their intervals."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.study_results import episodes_in

from jaxnav.evaluation.grid import Outcome
from jaxnav.study.intervals import Effect
from jaxnav.study.outcomes import TrialOutcomes, mean_weight
from jaxnav.study.trials import Trial

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


def outcome(success) -> Outcome:
    """Return an outcome [S, E]."""
    leaves = np.array(success, bool), LENGTH, np.ones((2, 4), int), np.full((2, 4), 2.5), WEIGHT
    return Outcome(*map(jnp.asarray, leaves))


def outcomes(success, episodes) -> TrialOutcomes:
    return TrialOutcomes({trial: outcome(values) for trial, values in zip(FEW, success, strict=False)}, episodes)


@pytest.fixture(scope="module")
def few():
    return outcomes(SUCCESS, episodes_in([0, 1, 2, 3], best_length=2))


def test_the_mean_weight_is_over_steps():
    # 0.5 in 2 steps and 0.1 in 10, of 2 x 20 steps: (1 + 1) / 40. Over episodes it would be 0.6 / 8.
    assert mean_weight(outcome(SUCCESS[2])) == pytest.approx(0.05)


def test_success_of_a_trial(few):
    np.testing.assert_array_equal(few.success(FEW[1]), SUCCESS[1])


def test_rows_hold_metrics_and_differences(few):
    baseline, layout, stde, other = few.rows(seed=0, gap="evidence")
    assert (stde.trial, stde.gap) == (FEW[2], "evidence")
    assert stde.mean_weight == pytest.approx(0.05)
    assert layout.sr.mean == 87.5
    assert layout.sr.seeds == (75.0, 100.0)
    # Each of 2 / length where found: (1 + 1/2 + 1/5) / 4 and (1 + 1/2 + 1/2 + 1/5) / 4.
    assert layout.spl.seeds == pytest.approx((42.5, 55.0))
    assert layout.dts.mean == 1.5  # 2.5 m less the radius
    # + w is compared with the baseline, trained apart; sTDE with + w, seed by seed.
    assert baseline.difference is None
    assert layout.difference.to == "baseline"
    assert layout.difference.sr.mean == 37.5
    assert stde.difference.to == "layout"
    assert stde.difference.sr.mean == 0.0
    # Differences of seeds: +25 and -25.
    assert stde.difference.sr.std == pytest.approx(25 * 2**0.5)
    # Apart: the baseline's seeds do not differ, the layout's by 25.
    assert layout.difference.sr.std == pytest.approx(25 / 2**0.5)
    # Best actions have no baseline to be compared with here.
    assert other.difference is None


def test_equal_results_have_equal_intervals(few):
    assert few.rows(seed=0, gap="novelty") == few.rows(seed=0, gap="novelty")
    equal = outcomes([SUCCESS[0], SUCCESS[1], SUCCESS[1]], episodes_in([0, 1, 2, 3], best_length=2))
    _, layout, stde = equal.rows(seed=0, gap="novelty")
    assert stde.sr == layout.sr
    assert stde.difference is not None
    assert stde.difference.sr == Effect(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("scene", "room", "low", "high"),
    [
        # Two scenes of two episodes, both seeds alike: 0, 1/2 or 1 with probabilities 1/4, 1/2, 1/4.
        ([0, 0, 1, 1], [0, 0], 0.0, 100.0),
        # Scenes with as many of both kinds have the mean whichever are drawn; episodes by themselves would not.
        ([0, 1, 0, 1], [0, 0], 50.0, 50.0),
        # Each the only scene of its room type: both are always there.
        ([0, 0, 1, 1], [0, 1], 50.0, 50.0),
        # A scene of three episodes, one found, and a scene of one: 2 of 6, 2 of 4 or 2 of 2.
        ([0, 0, 0, 1], [0, 0], 100 / 3, 100.0),
    ],
)
def test_intervals_draw_scenes_with_all_their_episodes(scene, room, low, high):
    episodes = episodes_in(scene, room=room, best_length=2)
    (row,) = outcomes([[[0, 0, 1, 1]] * 2], episodes).rows(seed=0, gap="novelty")
    assert row.sr.mean == 50.0
    assert (row.sr.low, row.sr.high) == pytest.approx((low, high))
