"""Statistics of the gap: SciPy, twins, room types, noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu
from support.study_results import episodes_in

from jaxnav.study.curves import Curve
from jaxnav.study.gap_statistics import auc_by_step, mean_by_step, weighted_auc
from jaxnav.study.tracking import FROZEN, UPDATED, GapTraces

# AUC

VALUES = st.lists(st.integers(-3, 3), min_size=1, max_size=20).map(np.array)


def auc(positive, negative) -> float:
    """Return the AUC where all weights are 1."""
    return weighted_auc(positive, negative, np.ones((len(positive), 1)), np.ones((len(negative), 1)))[0]


def test_auc_by_hand():
    # Against 2: lost, even, even; against 0: all three won. (0.5 + 0.5 + 3) / 6.
    assert auc(np.array([1, 2, 2]), np.array([2, 0])) == pytest.approx(4 / 6)


@given(VALUES, VALUES)
def test_auc_is_the_statistic_of_mann_and_whitney(positive, negative):
    expected = mannwhitneyu(positive, negative).statistic / (len(positive) * len(negative))
    assert auc(positive, negative) == pytest.approx(expected)
    assert auc(negative, positive) == pytest.approx(1 - expected)


# By step


def traces_of(gap, scene, room=None, names=None, running=None) -> GapTraces:
    """Return traces of one setting from these gaps."""
    gap = np.asarray(gap, np.float32)
    return GapTraces(
        gap=np.stack([gap, gap])[None],
        running=np.ones(gap.shape, bool) if running is None else np.array(running),
        episodes=episodes_in(scene, room=room, names=names),
    )


def first_step(curve: Curve) -> list[float]:
    """Return mean, low and high at step 0."""
    interval = curve.line(0, UPDATED).at(0)
    return [interval.mean, interval.low, interval.high]


def rng(seed=0):
    return np.random.default_rng(seed)


def test_twins_are_drawn_together():
    # Scene i has a gap of i / 20 unshifted, a little more shifted: a twin wins against itself, so with n scenes, each
    # drawn c_i times, AUC = (1 + sum c_i^2 / n^2) / 2 >= (1 + 1 / n) / 2. Separate draws would often give less.
    scenes = np.arange(20)
    unshifted = traces_of(scenes[None, :, None] / 20, scenes)
    names = unshifted.episodes.scenes[::-1]  # here in another order
    shifted = traces_of((scenes[::-1] / 20 + 0.01)[None, :, None], scenes, names=names)
    mean, low, high = first_step(auc_by_step(shifted, unshifted, rng()))
    assert mean == pytest.approx(0.525)
    assert 0.525 <= low < high < 0.6
    stranger = traces_of(scenes[None, :, None] / 20 + 0.01, scenes, names=tuple(f"other{i:02}" for i in scenes))
    assert first_step(auc_by_step(stranger, unshifted, rng()))[1] < 0.4


def test_room_types_keep_their_shares_and_policies_are_drawn():
    # One scene of each room type: every draw has both, and one policy is always drawn.
    alone = traces_of([[[0.2], [0.6]]], [0, 1], room=[0, 1])
    assert first_step(mean_by_step(alone, rng())) == pytest.approx([0.4, 0.4, 0.4])
    # Two policies: both from the first in a quarter of the draws, both from the second in another.
    assert first_step(mean_by_step(traces_of([[[0.2]], [[0.8]]], [0]), rng())) == pytest.approx([0.5, 0.2, 0.8])
    # The same policies act at both shifts: the first shows the shift, the second does not.
    shifted, unshifted = traces_of([[[0.9]], [[0.3]]], [0]), traces_of([[[0.5]], [[0.3]]], [0])
    mean, low, high = first_step(auc_by_step(shifted, unshifted, rng()))
    # 0.9 > 0.5 and 0.3, 0.3 < 0.5, 0.3 = 0.3: 2.5 of 4. Alone: 1 and 0.5.
    assert [mean, low, high] == pytest.approx([0.625, 0.5, 1])


def test_only_running_episodes_count():
    running = [[[True, True, False], [True, False, False]]]
    shifted = traces_of([[[0.5, 0.5, 9], [0.1, 9, 9]]], [0, 1], running=running)
    unshifted = traces_of([[[0.3, 0.6, 0.0], [0.3, 0.4, 0.0]]], [0, 1])
    means = mean_by_step(shifted, rng())
    assert means.mean[0, FROZEN, :2] == pytest.approx([0.3, 0.5])
    course = auc_by_step(shifted, unshifted, rng())
    assert course.mean[0, UPDATED, :2] == pytest.approx([0.5, 0.5])
    for curve in (means, course):
        for leaf in (curve.mean, curve.low, curve.high):
            assert np.isnan(leaf[..., 2]).all()


def test_the_interval_of_noise_covers_a_half_and_that_of_a_shift_does_not():
    draw, scene = rng(7), np.repeat(np.arange(20), 5)
    noise, other = draw.random((2, 3, 100, 1))
    _, low, high = first_step(auc_by_step(traces_of(noise, scene), traces_of(other, scene), rng()))
    assert 0.3 < low < 0.5 < high < 0.7
    # Uniform against uniform + 0.4: 1 - 0.6^2 / 2 = 0.82, s.e. about 0.02.
    mean, low, _ = first_step(auc_by_step(traces_of(noise + 0.4, scene), traces_of(other, scene), rng()))
    assert mean == pytest.approx(0.82, abs=0.06)
    assert low > 0.7
