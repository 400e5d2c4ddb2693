"""What the layout shift changes: worked means, paired intervals."""

import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.study.dial import Totals, compare
from jaxnav.study.instrument_report import MEASURES, Measure
from jaxnav.study.intervals import Interval

ROOMS, NAMES = ("kitchen", "kitchen", "bedroom"), ("a", "b", "c")


def totals(names=NAMES, rooms=ROOMS, **values) -> Totals:
    """Return totals of two episodes in each scene.

    A measure is given by its mean in each scene, [N] or by seed [S, N]; else it is 1.
    """
    means: dict[Measure, np.ndarray] = {
        name: np.atleast_2d(np.array(values.get(name, [1.0] * len(names)), float)) for name in MEASURES
    }
    weights = np.full(len(names), 2.0)
    return Totals({name: 2.0 * mean for name, mean in means.items()}, dict.fromkeys(MEASURES, weights), rooms, names)


def test_means_and_changes_are_as_worked():
    first = totals(best_length=[10, 20, 30], random_sr=[1, 2, 3], baseline_argmax_sr=[[60, 40, 20], [80, 60, 40]])
    last = totals(best_length=[12, 20, 31], random_sr=[1, 2, 3.4], baseline_argmax_sr=[[50, 30, 10], [70, 50, 30]])
    report = compare([0.0, 1.0], [first, last], seed=0)
    assert [(column.shift, column.episodes, column.scenes) for column in report.shifts] == [(0.0, 6, 3), (1.0, 6, 3)]
    # L*: 60 / 3 and 63 / 3, 5 % more; Random: 2 and 6.4 / 3, 6.7 % more.
    lengths = [column.measures["best_length"] for column in report.shifts]
    assert [length.mean for length in lengths] == pytest.approx([20.0, 21.0])
    matched = {change.measure: change for change in report.matched}
    assert matched["best_length"].change.mean == pytest.approx(5.0)
    assert matched["random_sr"].change.mean == pytest.approx(100 * 0.4 / 6)
    assert [change.holds for change in report.matched] == [True, False, True]
    # The kitchens are drawn with replacement, the bedroom always: L* of two kitchens is 10, 15 or 20 on average.
    assert lengths[0].low == pytest.approx((10 + 10 + 30) / 3)
    assert lengths[0].high == pytest.approx((20 + 20 + 30) / 3)
    # All scenes and seeds lose 10 points: however they are drawn, and however they differ.
    argmax, sample = report.discriminating
    assert (argmax.measure, argmax.start, argmax.end, argmax.holds) == ("baseline_argmax_sr", 0.0, 1.0, True)
    assert (argmax.change.mean, argmax.change.low, argmax.change.high) == pytest.approx((10.0, 10.0, 10.0))
    assert sample.change == Interval(0.0, 0.0, 0.0)
    assert not sample.holds


@pytest.mark.parametrize(
    ("seeds", "holds"), [([[7.9] * 3] * 2, False), ([[8.1] * 3] * 2, True), ([[20.0] * 3, [-1.0] * 3], False)]
)
def test_a_loss_must_be_large_and_sure(seeds, holds):
    report = compare([0.0, 1.0], [totals(baseline_argmax_sr=seeds), totals(baseline_argmax_sr=np.zeros((2, 3)))], 0)
    assert report.discriminating[0].holds == holds


def test_scenes_that_are_missing_at_a_shift_are_left_out_there():
    first, last = totals(best_length=[10, 20, 30]), totals(("c", "a"), ("bedroom", "kitchen"), best_length=[30, 10])
    report = compare([0.0, 1.0], [first, last], seed=0)
    assert [column.scenes for column in report.shifts] == [3, 2]
    assert [column.measures["best_length"].mean for column in report.shifts] == [20.0, 20.0]


def test_nothing_is_compared_with_zero():
    with pytest.raises(InputError, match=r"frontier_sr is 0 at shift 0: nothing to compare with; give more --episodes"):
        compare([0.0, 1.0], [totals(frontier_sr=[0, 0, 0]), totals()], seed=0)
