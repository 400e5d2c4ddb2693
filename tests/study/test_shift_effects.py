"""What the layout shift changes: worked means, paired intervals."""

import numpy as np
import pytest
from support.intervals import around, bounds

from jaxnav.errors import InputError
from jaxnav.study.instrument import TRAINED_MEASURES, SceneTotals, compare_shifts
from jaxnav.study.records import CATEGORY_MEASURES, MEASURES, NO_EXPERIENCE_MEASURES, Measure

ROOMS, NAMES = ("kitchen", "kitchen", "bedroom"), ("a", "b", "c")  # the only bedroom: all are one stratum


def totals(names=NAMES, rooms=ROOMS, categories=None, seeds=2, **values) -> SceneTotals:
    """Return totals of two episodes in each scene.

    A measure is given by its mean in each scene, [N] or by seed [S, N]; else it is 1. What is trained has `seeds`.
    """
    ones = {name: np.ones((seeds if name in TRAINED_MEASURES else 1, len(names))) for name in MEASURES}
    means: dict[Measure, np.ndarray] = {
        name: np.atleast_2d(np.array(values.get(name, ones[name]), float)) for name in MEASURES
    }
    weights = np.full(len(names), 2.0)
    sums: dict[Measure, np.ndarray] = {name: 2.0 * mean for name, mean in means.items()}
    by_category: dict[Measure, np.ndarray] = dict.fromkeys(CATEGORY_MEASURES, np.full((len(names), 2), 50.0))
    by_category |= {"goal_detected": np.array(categories, float)} if categories else {}
    return SceneTotals(sums, dict.fromkeys(MEASURES, weights), by_category, rooms, names)


def test_means_and_changes_are_as_worked():
    first = totals(best_length=[10, 20, 30], random_sr=[1, 2, 3], baseline_argmax_sr=[[60, 40, 20], [80, 60, 40]])
    last = totals(best_length=[12, 20, 31], random_sr=[1, 2, 3.4], baseline_argmax_sr=[[50, 30, 10], [70, 50, 30]])
    report = compare_shifts([0.0, 1.0], [first, last])
    assert [(column.shift, column.episodes, column.scenes) for column in report.shifts] == [(0.0, 6, 3), (1.0, 6, 3)]
    # L*: 60 / 3 and 63 / 3, 5 % more; Random: 2 and 6.4 / 3, 6.7 % more.
    lengths = [column.measures["best_length"] for column in report.shifts]
    assert [length.mean for length in lengths] == pytest.approx([20.0, 21.0])
    matched = {change.measure: change for change in report.matched}
    assert matched["best_length"].change.mean == pytest.approx(5.0)
    assert matched["random_sr"].change.mean == pytest.approx(100 * 0.4 / 6)
    assert [change.holds for change in report.matched] == [True, False, True, True]
    # Sample variances 100 and (9^2 + 1 + 10^2) / 2 = 91 of three scenes, / 3 of their mean.
    assert bounds(lengths[0]) == pytest.approx(around(20.0, 100 / 3, 2))
    assert bounds(lengths[1]) == pytest.approx(around(21.0, 91 / 3, 2))
    # SR 40 and 60 of the seeds, 20 apart in all scenes: 400 / 3 by scene, 200 / 2 by run, nothing by both. Degrees of
    # freedom (400 / 3 + 100)^2 / ((400 / 3)^2 / 2 + 100^2 / 1) = 2.88.
    argmax_sr = report.shifts[0].measures["baseline_argmax_sr"]
    assert bounds(argmax_sr) == pytest.approx(around(50.0, 700 / 3, (700 / 3) ** 2 / ((400 / 3) ** 2 / 2 + 100**2)))
    # All scenes and seeds lose 10 points, however they differ.
    argmax, sample = report.discriminating
    assert (argmax.measure, argmax.start, argmax.end, argmax.holds) == ("baseline_argmax_sr", 0.0, 1.0, True)
    assert (argmax.change.mean, argmax.change.low, argmax.change.high) == pytest.approx((10.0, 10.0, 10.0))
    assert bounds(sample.change) == (0.0, 0.0, 0.0)
    assert not sample.holds


@pytest.mark.parametrize(
    ("seeds", "holds"),
    [
        ([[7.9] * 3] * 2, False),
        ([[8.1] * 3] * 2, True),
        ([[20.0] * 3, [-1.0] * 3], False),  # the seeds disagree
        ([[0.0, 0.0, 30.0]] * 2, False),  # the scenes disagree
        ([[8.0, 9.0, 10.0]] * 2, True),  # 9 +- 4.3 * sqrt(1 / 3) = 2.5
    ],
)
def test_a_loss_must_be_large_and_sure(seeds, holds):
    report = compare_shifts([0.0, 1.0], [totals(baseline_argmax_sr=seeds), totals(baseline_argmax_sr=np.zeros((2, 3)))])
    assert report.discriminating[0].holds == holds


def test_scenes_that_are_missing_at_a_shift_are_left_out_there():
    first, last = totals(best_length=[10, 20, 30]), totals(("c", "a"), ("bedroom", "kitchen"), best_length=[30, 10])
    report = compare_shifts([0.0, 1.0], [first, last])
    assert [column.scenes for column in report.shifts] == [3, 2]
    assert [column.measures["best_length"].mean for column in report.shifts] == [20.0, 20.0]


def test_scenes_are_left_out_of_all_shifts_at_once():
    # L* is 5 % longer in every scene, which any scenes and none of them show; here they stand in another order.
    lengths = np.array([10.0, 20.0, 30.0])
    first, last = totals(best_length=lengths), totals(NAMES[::-1], ROOMS[::-1], best_length=1.05 * lengths[::-1])
    assert bounds(compare_shifts([0.0, 1.0], [first, last]).matched[0].change) == pytest.approx((5.0, 5.0, 5.0))
    # The same lengths in other scenes do not.
    others = totals(("d", "e", "f"), ROOMS, best_length=1.05 * lengths)
    change = compare_shifts([0.0, 1.0], [first, others]).matched[0].change
    assert change.mean == pytest.approx(5.0)
    assert change.low < -50


def test_training_runs_are_left_out_of_all_shifts_at_once():
    # Every run loses 10 points, and one is 40 points better than the other at both shifts.
    first, last = (totals(baseline_sample_sr=[[60.0 - lost] * 3, [20.0 - lost] * 3]) for lost in (0.0, 10.0))
    report = compare_shifts([0.0, 1.0], [first, last])
    assert bounds(report.discriminating[1].change) == pytest.approx((10.0, 10.0, 10.0))
    # One run: no interval, and no verdict without one.
    first, last = (
        totals(seeds=1, baseline_argmax_sr=[[60.0 - lost] * 3], baseline_sample_sr=[[60.0 - lost] * 3])
        for lost in (0.0, 10.0)
    )
    loss = compare_shifts([0.0, 1.0], [first, last]).discriminating[1]
    assert (loss.change.mean, loss.change.has_bounds, loss.holds) == (10.0, False, False)


def test_nothing_is_compared_with_zero():
    with pytest.raises(InputError, match=r"frontier_sr is 0 at shift 0: nothing to compare with; give more --episodes"):
        compare_shifts([0.0, 1.0], [totals(frontier_sr=[0, 0, 0]), totals()])


def test_changes_of_categories_do_not_cancel():
    # The first is in all three scenes, the second in two: they change by 3 and by -18, in the mean of scenes by
    # (3 * 3 + 2 * 18) / 5 = 9. The mean of all goals falls by 27 / 5 only.
    before = [[50, 80], [60, np.nan], [70, 60]]
    after = [[56, 60], [60, np.nan], [73, 44]]
    report = compare_shifts([0.0, 1.0], [totals(categories=before), totals(categories=after)])
    assert report.categories is not None
    detected, succeeds = report.categories
    assert (detected.measure, detected.change.mean, detected.holds) == ("goal_detected", pytest.approx(9.0), False)
    assert (succeeds.measure, succeeds.change.mean, succeeds.holds) == ("done_succeeds", 0.0, True)


@pytest.mark.parametrize(("lost", "wrong", "holds"), [(1.9, 1.9, True), (2.1, 2.1, False), (-5.0, -5.0, True)])
def test_agents_without_experience_must_lose_little(lost, wrong, holds):
    first = totals(without_argmax_sr=[[80.0] * 3] * 2, without_argmax_wrong=[[3.0] * 3] * 2)
    last = totals(without_argmax_sr=[[80.0 - lost] * 3] * 2, without_argmax_wrong=[[3.0 + wrong] * 3] * 2)
    report = compare_shifts([0.0, 1.0], [first, last])
    assert report.without is not None
    changes = {change.measure: change for change in report.without}
    assert changes["without_argmax_sr"].change.mean == pytest.approx(lost)
    assert changes["without_argmax_wrong"].change.mean == pytest.approx(wrong)  # a wrong Done more is a loss
    assert changes["without_argmax_sr"].holds == changes["without_argmax_wrong"].holds == holds
    # Without such agents there is nothing to say.
    others = [
        results._replace(values={k: v for k, v in results.values.items() if k not in NO_EXPERIENCE_MEASURES})
        for results in (first, last)
    ]
    assert compare_shifts([0.0, 1.0], others).without is None
