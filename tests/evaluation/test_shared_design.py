"""Intervals over conditions that share scenes, floor plans and training runs."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.intervals import bounds, student_interval, two_way_jackknife_interval

from jaxnav.evaluation.statistics import Interval, SharedDesign

NUM_SEEDS = 3
NUM_SCENES = 5
NUM_EPISODES = 4  # of each scene
NAMES = tuple("abcde")
OTHER_NAMES = tuple("vwxyz")
KITCHENS = ("kitchen",) * NUM_SCENES
EQUAL_WEIGHTS = np.full(NUM_SCENES, NUM_EPISODES)
MEANS = arrays(float, (NUM_SEEDS, NUM_SCENES), elements=st.integers(-20, 20).map(float))


def mean_interval_of(
    means: np.ndarray, weights=EQUAL_WEIGHTS, names: Sequence[str] = NAMES, rooms: Sequence[str] = KITCHENS
):
    """Return the interval of one condition, from means by scene."""
    design = SharedDesign.from_conditions([(names, rooms)], len(means))
    return design.interval(design.jackknife_means(means * weights, np.array(weights), names))


def growth_interval(first_means: np.ndarray, last_means: np.ndarray, names: Sequence[str] = NAMES) -> Interval:
    """Return how much the mean grows; `names` are those at the end."""
    design = SharedDesign.from_conditions([(NAMES, KITCHENS), (names, KITCHENS)], NUM_SEEDS)
    first_replicates = design.jackknife_means(NUM_EPISODES * first_means, EQUAL_WEIGHTS, NAMES)
    last_replicates = design.jackknife_means(NUM_EPISODES * last_means, EQUAL_WEIGHTS, names)
    return design.interval(last_replicates - first_replicates)


@given(MEANS)
def test_balanced_mean_interval_is_the_analysis_of_variance(means):
    # Mean squares of scenes, runs and the rest; the mean's variance is (scenes + runs - rest) / (S N), at least that of
    # scenes or of runs alone.
    by_scene = means.mean(axis=0)
    by_run = means.mean(axis=1)
    overall_mean = means.mean()
    residuals = means - by_scene - by_run[:, None] + overall_mean
    degrees = np.array([NUM_SCENES - 1, NUM_SEEDS - 1, (NUM_SCENES - 1) * (NUM_SEEDS - 1)])
    squares = (
        NUM_SEEDS * ((by_scene - overall_mean) ** 2).sum(),
        NUM_SCENES * ((by_run - overall_mean) ** 2).sum(),
        (residuals**2).sum(),
    )
    mean_squares = squares / degrees / (NUM_SEEDS * NUM_SCENES)
    variance = max(mean_squares[0] + mean_squares[1] - mean_squares[2], mean_squares[0], mean_squares[1])
    squared_spread = (mean_squares**2 / degrees).sum()
    satterthwaite_degrees = np.clip(variance**2 / squared_spread, 2, 4 + 2) if squared_spread > 1e-18 else 4 + 2
    assert bounds(mean_interval_of(means)) == pytest.approx(
        student_interval(overall_mean, variance, satterthwaite_degrees), abs=1e-6
    )


@given(MEANS, MEANS)
def test_growth_over_shared_scenes_is_the_interval_of_differences(first_means, last_means):
    assert bounds(growth_interval(first_means, last_means)) == pytest.approx(
        bounds(mean_interval_of(last_means - first_means)), abs=1e-6
    )


def test_growth_over_shared_scenes_has_a_narrower_interval():
    # Scenes with means from 10 to 50 gain 2, 4, 2, 4 and 3 points, equally in all runs.
    first_means = np.tile([10.0, 20, 30, 40, 50], (NUM_SEEDS, 1))
    last_means = first_means + np.array([2.0, 4, 2, 4, 3])
    shared_growth = growth_interval(first_means, last_means)
    separate_growth = growth_interval(first_means, last_means, OTHER_NAMES)
    assert shared_growth.mean == separate_growth.mean == pytest.approx(3.0)
    # Gains have squares 1 + 1 + 1 + 1 + 0: variance 4 / 4 of one, / 5 of the mean.
    assert bounds(shared_growth) == pytest.approx(student_interval(3, 1 / 5, 4))
    # With separate scenes, the jackknife leaves out ten scenes. Without a scene of mean x, the mean of its five scenes
    # changes by (x - mean) / 4. Squares about the means 30 and 33: 400 + 100 + 0 + 100 + 400 = 1000 and
    # 441 + 81 + 1 + 121 + 400 = 1044, with the jackknife's factor 9 / 10.
    assert bounds(separate_growth) == pytest.approx(student_interval(3, 0.9 * 2044 / 16, 9))
    assert shared_growth.low > 0 > separate_growth.low


def test_growth_matches_scenes_by_name_not_by_order():
    generator = np.random.default_rng(0)
    first_means, last_means = generator.random((2, NUM_SEEDS, NUM_SCENES))
    order = [3, 0, 4, 1, 2]
    shuffled_growth = growth_interval(first_means, last_means[:, order], [NAMES[index] for index in order])
    assert bounds(shuffled_growth) == pytest.approx(bounds(growth_interval(first_means, last_means)))


def test_growth_leaves_a_run_out_of_all_conditions():
    # Runs differ by 10 points, equally at both shifts, so every run grows by 1. If the runs of the last shift are
    # reversed, growth differs between runs.
    first_means = np.arange(NUM_SCENES) + 10.0 * np.arange(NUM_SEEDS)[:, None]
    assert bounds(growth_interval(first_means, first_means + 1.0)) == pytest.approx((1.0, 1.0, 1.0))
    assert growth_interval(first_means, first_means[::-1] + 1.0).low < 0


def test_scenes_are_weighted_by_their_episodes():
    generator = np.random.default_rng(1)
    weights = np.array([1.0, 5, 2, 3, 9])
    means = generator.random((NUM_SEEDS, NUM_SCENES))

    def mean(scene: int | None, run: int | None) -> float:
        has_scene = np.arange(NUM_SCENES) != scene
        has_run = np.arange(NUM_SEEDS) != run
        return float(np.average(means[has_run].mean(axis=0)[has_scene], weights=weights[has_scene]))

    assert bounds(mean_interval_of(means, weights)) == pytest.approx(
        two_way_jackknife_interval(mean, NUM_SCENES, NUM_SEEDS)
    )


def test_room_types_are_strata_of_the_mean():
    # Kitchens are at 0 and 10, bedrooms at 70, 80 and 90, alike in all runs: variance 50 of a kitchen and 100 of a
    # bedroom, so (2 / 5)^2 50 / 2 + (3 / 5)^2 100 / 3 = 16 of the mean.
    means = np.tile([0.0, 10, 70, 80, 90], (NUM_SEEDS, 1))
    result = mean_interval_of(means, rooms=("kitchen", "kitchen", "bedroom", "bedroom", "bedroom"))
    assert bounds(result) == pytest.approx(student_interval(50, 16, 1 + 2))
    # One stratum is wider: the types differ.
    assert mean_interval_of(means).low < result.low - 10
    # An only kitchen shows no variance of kitchens: all are one stratum.
    assert bounds(mean_interval_of(means, rooms=("kitchen", *("bedroom",) * 4))) == pytest.approx(
        bounds(mean_interval_of(means))
    )


def test_scenes_of_a_floor_plan_are_one_cluster():
    # Plan 0 is at 10, 20 and 30, plan 1 at 50 twice, plan 2 at 80, by equally many episodes: those of plans.
    names = [f"val-apartment-{plan:02}-{i}" for plan, i in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0))]
    means = np.tile([10.0, 20, 30, 50, 50, 80], (NUM_SEEDS, 1))
    result = mean_interval_of(means, np.full(6, NUM_EPISODES), names, ("apartment",) * 6)
    # Mean 40; without plan 0 it is 60, without 1 35, without 2 32: 2 / 3 of the squares 400 + 25 + 64.
    assert bounds(result) == pytest.approx(student_interval(40, 2 / 3 * 489, 2))


def test_untrained_means_vary_with_scenes_alone():
    means = np.array([[10.0, 20, 30, 40, 50]])
    design = SharedDesign.from_conditions([(NAMES, KITCHENS)], NUM_SEEDS)
    replicates = design.jackknife_means(means * EQUAL_WEIGHTS, EQUAL_WEIGHTS, NAMES, trained=False)
    np.testing.assert_allclose(replicates, [30, 35, 32.5, 30, 27.5, 25])  # without each scene in turn
    assert bounds(design.interval(replicates)) == pytest.approx(student_interval(30, 250 / 5, NUM_SCENES - 1))


def test_scenes_without_episodes_are_ignored():
    means = np.tile([50.0, 50, 7, 90, 90], (NUM_SEEDS, 1))
    rooms = ("kitchen",) * 3 + ("bedroom",) * 2
    # Scenes within a room type are equal, so the interval has no width; scene 2 has no episodes.
    result = mean_interval_of(means, np.array([4, 4, 0, 4, 4]), rooms=rooms)
    assert bounds(result) == pytest.approx((70.0, 70.0, 70.0))


def test_mean_of_a_single_scene_has_no_bounds():
    result = mean_interval_of(np.ones((NUM_SEEDS, NUM_SCENES)), np.array([4, 0, 0, 0, 0]))
    assert result.mean == 1.0
    assert not result.has_bounds
