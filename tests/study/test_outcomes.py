"""Metrics and differences of trials, and their intervals."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.intervals import around, bounds
from support.study_results import episodes_in

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.measure import TrialOutcomes, mean_removal_weight
from jaxnav.study.records import Trial

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
#: Success of both runs in six episodes.
SIX = [0, 0, 1, 1, 0, 1]
APARTMENTS = ("val-apartment-00-0", "val-apartment-00-1", "val-apartment-01-0", "val-apartment-02-0")


def outcome(success, length=LENGTH, weight=WEIGHT) -> EpisodeOutcome:
    """Return an outcome [S, E]."""
    leaves = (
        np.ones_like(length, bool),
        np.array(success, bool),
        length,
        np.ones_like(length),
        np.full(length.shape, 2.5),
        length,
        weight,
    )
    return EpisodeOutcome(*map(jnp.asarray, leaves))


def outcomes(success, episodes) -> TrialOutcomes:
    return TrialOutcomes({trial: outcome(values) for trial, values in zip(FEW, success, strict=False)}, episodes)


@pytest.fixture(scope="module")
def few():
    return outcomes(SUCCESS, episodes_in([0, 1, 2, 3], best_length=2))


def test_the_mean_weight_is_over_steps():
    # 0.5 in 2 steps and 0.1 in 10, of 2 x 20 steps: (1 + 1) / 40. Over episodes it would be 0.6 / 8.
    assert mean_removal_weight(outcome(SUCCESS[2])) == pytest.approx(0.05)
    one = outcome(SUCCESS[2])
    assert mean_removal_weight(one._replace(choices=np.zeros_like(one.choices))) == 0.0


def test_success_of_a_trial(few):
    np.testing.assert_array_equal(few.success(FEW[1]), SUCCESS[1])


def test_rows_hold_metrics_and_differences(few):
    baseline, layout, stde, other = few.trial_rows("evidence")
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


def test_equal_results_have_equal_intervals():
    equal = outcomes([SUCCESS[0], SUCCESS[1], SUCCESS[1]], episodes_in([0, 1, 2, 3], best_length=2))
    _, layout, stde = equal.trial_rows("novelty")
    assert stde.sr == layout.sr
    assert stde.sr.has_bounds
    assert stde.difference is not None
    assert stde.difference.sr == Interval(0.0, 0.0, 0.0, 0.0, (0.0, 0.0))


def test_variants_of_a_network_are_paired_and_those_trained_apart_are_not(few):
    _, layout, stde, _ = few.trial_rows("novelty")
    # sTDE less + w: 0, 100, 0, 0 points in the first run, 0, 0, 0, -100 in the second, so 25 and -25. By run
    # 1250 / 2 = 625; by scene 0, 50, 0 and -50, 5000 / 3 / 4 = 417; what is left is 25 or -25 in all eight,
    # 8 x 625 / 3 / 8 = 208. In all 417 + 625 - 208 = 833; 833^2 / (417^2 / 3 + 625^2 / 1 + 208^2 / 3) = 1.51 degrees of
    # freedom.
    parts = np.array([5000 / 12, 625, 5000 / 24])
    variance = parts[0] + parts[1] - parts[2]
    degrees = variance**2 / (parts**2 / [3, 1, 3]).sum()
    assert bounds(stde.difference.sr) == pytest.approx(around(0, variance, degrees))
    assert stde.difference.sr.seeds == pytest.approx((25.0, -25.0))
    # Trained apart there are no gains run by run.
    assert layout.difference.sr.seeds == ()


def interval_of(success, episodes: EpisodeList) -> Interval:
    """Return the SR of runs that act twice in every episode."""
    length = np.full((2, len(episodes.scene)), 2)
    trials = TrialOutcomes({FEW[0]: outcome(success, length, np.zeros(length.shape, np.float32))}, episodes)
    (row,) = trials.trial_rows("novelty")
    return row.sr


@pytest.mark.parametrize(
    ("scene", "room", "names", "variance", "degrees"),
    [
        # Three scenes of two episodes: 0, 100 and 50 %, sample variance 2500.
        ([0, 0, 1, 1, 2, 2], [0, 0, 0], None, 2500 / 3, 2),
        # Scenes with as many of both kinds are alike; episodes by themselves would not be.
        ([0, 1, 0, 1, 2, 2], [0, 0, 0], None, 0.0, 2),
        # Two failures of one room type; of the other four 75 %, sample variance 2500, and 4 / 6 of all.
        ([0, 1, 2, 3, 4, 5], [0, 0, 1, 1, 1, 1], None, (4 / 6) ** 2 * 2500 / 4, 1 + 3),
        # An only scene of its room type shows no variance there: all are one stratum.
        ([0, 0, 1, 1, 2, 2], [0, 1, 1], None, 2500 / 3, 2),
        # One of three, one of two and one of one: without each 2 / 3, 2 / 4 and 2 / 5 instead of 1 / 2.
        ([0, 0, 0, 1, 1, 2], [0, 0, 0], None, 2 / 3 * ((50 / 3) ** 2 + 0 + 10**2), 2),
        # Two scenes of a floor plan are one, so this is the first case again.
        ([0, 1, 2, 2, 3, 3], [0, 0, 0, 0], APARTMENTS, 2500 / 3, 2),
    ],
)
def test_intervals_are_over_floor_plans_with_all_their_episodes(scene, room, names, variance, degrees):
    episodes = episodes_in(scene, room=room, names=names, best_length=2)
    assert bounds(interval_of([SIX] * 2, episodes)) == pytest.approx(around(50, variance, degrees))


def test_runs_that_disagree_widen_the_interval():
    episodes = episodes_in([0, 0, 1, 1, 2, 2], best_length=2)
    equal, unequal = (interval_of(runs, episodes) for runs in ([SIX] * 2, [[0, 0, 0, 1, 0, 0], [0, 1, 1, 1, 1, 1]]))
    # Equal runs: that of the scenes alone. Runs of 1 / 6 and 5 / 6: by run 33^2 = 1111 with one degree of freedom.
    assert bounds(equal) == pytest.approx(around(50, 2500 / 3, 2))
    assert unequal.mean == 50.0
    assert unequal.high - 50.0 > 2 * (equal.high - 50.0)


def test_effects_are_gains_by_scene_and_run():
    episodes = episodes_in([2, 0, 2, 0], room=[1, 0, 0], best_length=2)
    effects = outcomes(SUCCESS, episodes).scene_effects(FEW[2], FEW[1])
    # sTDE less + w: the second episode in the first run, and -1 at the fourth in the second; both are in scene 0.
    gains = dict(zip(effects.scenes, zip(effects.rooms, effects.episodes, effects.gain.T, strict=True), strict=True))
    for name, room, gain in (("room00", "kitchen", [100, -100]), ("room02", "bedroom", [0, 0])):
        assert gains[name][:2] == (room, 2)
        assert gains[name][2].tolist() == gain
    # The other scene was not drawn.
    assert gains.pop("room01", ("", 0))[1] == 0
    assert len(gains) == 2
