"""Statistics of the gap: SciPy, twins, room types, noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu
from support.intervals import around, bounds, left_out
from support.study_results import episodes_in

from jaxnav.study.gap_traces import FROZEN, UPDATED, GapTraces, auc_by_step, mean_by_step, weighted_auc
from jaxnav.study.records import Curve

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


def first_step(curve: Curve) -> tuple[float, float, float]:
    """Return mean, low and high at step 0."""
    return bounds(curve.select(0, UPDATED).interval_at(0))


def plain_auc(shifted: GapTraces, unshifted: GapTraces, step: int, scene: int | None, run: int | None) -> float:
    """Return the AUC at a step without a scene and a run."""
    sides = []
    for side in (shifted, unshifted):
        remains = (
            [f"room{scene:02}" != side.episodes.scenes[i] for i in side.episodes.scene] if scene is not None else True
        )
        runs = (np.arange(len(side.running)) != run)[:, None]
        sides.append(side.gap[0, UPDATED, ..., step][side.running[..., step] & remains & runs])
    return mannwhitneyu(*sides).statistic / np.prod([len(side) for side in sides])


def test_the_interval_is_that_of_a_plain_loop():
    # Six scenes in other orders, with more episodes at one shift, of which some end.
    draw, runs, scenes = np.random.default_rng(2), 3, 6
    unshifted_scene, shifted_scene = np.repeat(np.arange(scenes), 4), np.tile(np.arange(scenes), 5)
    unshifted = traces_of(
        draw.integers(0, 9, (runs, 24, 2)) / 10, unshifted_scene, running=draw.random((runs, 24, 2)) < 0.8
    )
    names = unshifted.episodes.scenes[::-1]
    shifted = traces_of(draw.integers(2, 9, (runs, 30, 2)) / 10, shifted_scene, names=names)
    course, means = auc_by_step(shifted, unshifted), mean_by_step(unshifted)
    for step in (0, 1):
        expected = left_out(lambda s, r, step=step: plain_auc(shifted, unshifted, step, s, r), scenes, runs)
        assert bounds(course.select(0, UPDATED).interval_at(step)) == pytest.approx(expected)

        def mean(scene, run, step=step):
            is_used = unshifted.running[..., step] & (unshifted_scene != scene) & (np.arange(runs) != run)[:, None]
            return unshifted.gap[0, FROZEN, ..., step][is_used].mean(dtype=float)

        expected = left_out(mean, scenes, runs)
        assert bounds(means.select(0, FROZEN).interval_at(step)) == pytest.approx(expected, rel=1e-5)


def test_twins_are_left_out_together():
    # Scene i has a gap of i / 20 unshifted, a little more shifted. Of n scenes, each wins against itself and all below
    # it: AUC = (1 + 1 / n) / 2. Without a scene and its twin that is (1 + 1 / 19) / 2 whichever it is, so scenes have a
    # variance of 19 / 20 x 20 x (0.5 / 19 - 0.5 / 20)^2, the runs none.
    scenes = np.arange(20)
    unshifted = traces_of(np.tile(scenes[:, None] / 20, (2, 1, 1)), scenes)
    names = unshifted.episodes.scenes[::-1]  # here in another order
    shifted = traces_of(np.tile(scenes[::-1, None] / 20 + 0.01, (2, 1, 1)), scenes, names=names)
    variance = 19 * (0.5 / 19 - 0.5 / 20) ** 2
    assert first_step(auc_by_step(shifted, unshifted)) == pytest.approx(around(0.525, variance, 19))
    # Scenes of a floor plan are twins, too; strangers are not.
    for kind, together in (("{}-replaced-1", True), ("other{:02}", False)):
        names = tuple(kind.format(f"room{i:02}") if together else kind.format(i) for i in scenes)
        other = traces_of(np.tile(scenes[:, None] / 20 + 0.01, (2, 1, 1)), scenes, names=names)
        mean, low, _ = first_step(auc_by_step(other, unshifted))
        assert mean == pytest.approx(0.525)
        assert (low > 0.5) == together


def test_room_types_keep_their_shares():
    # Kitchens at 0.1 and 0.3, bedrooms at 0.6, 0.7 and 0.8, alike in two runs: sample variances 0.02 and 0.01, so
    # (2 / 5)^2 0.02 / 2 + (3 / 5)^2 0.01 / 3 = 0.0028 of the mean. In one stratum it would be 0.085 / 5.
    gaps = np.tile(np.array([0.1, 0.3, 0.6, 0.7, 0.8])[:, None], (2, 1, 1))
    for room, variance, degrees in (([1, 1, 0, 0, 0], 0.0028, 3), ([1, 1, 1, 1, 1], 0.085 / 5, 4)):
        result = first_step(mean_by_step(traces_of(gaps, range(5), room=room)))
        assert result == pytest.approx(around(0.5, variance, degrees), rel=1e-5)


def test_a_policy_is_left_out_of_both_shifts_at_once():
    # Three scenes that are alike. The first policy shows the shift, the second does not.
    shifted, unshifted = (
        traces_of(np.repeat(gaps, 3, axis=1)[..., None], range(3)) for gaps in ([[0.9], [0.3]], [[0.5], [0.3]])
    )
    # 0.9 > 0.5 and 0.3, 0.3 < 0.5, 0.3 = 0.3: 2.5 of 4. The second alone 0.5, the first 1: by run
    # 1 / 2 x (0.125^2 + 0.375^2), with one degree of freedom.
    variance = 0.5 * (0.125**2 + 0.375**2)
    assert first_step(auc_by_step(shifted, unshifted)) == pytest.approx(around(0.625, variance, 1))
    # Policies that are alike say the same.
    alike = traces_of(np.repeat([[0.9], [0.9]], 3, axis=1)[..., None], range(3))
    assert first_step(mean_by_step(alike)) == pytest.approx([0.9, 0.9, 0.9])


def test_only_running_episodes_count():
    # At step 1 one episode of one run goes on: its scene and run cannot be left out. At step 2 none does.
    running = [[[True, True, False], [True, False, False], [True, False, False]]] * 2
    running[1] = [[True, False, False]] * 3
    shifted = traces_of([[[0.5, 0.5, 9], [0.1, 9, 9], [0.3, 9, 9]]] * 2, range(3), running=running)
    unshifted = traces_of([[[0.3, 0.6, 0.0], [0.3, 0.4, 0.0], [0.3, 0.5, 0.0]]] * 2, range(3))
    means, course = mean_by_step(shifted), auc_by_step(shifted, unshifted)
    assert means.mean[0, FROZEN, :2] == pytest.approx([0.3, 0.5])
    assert course.mean[0, UPDATED, :2] == pytest.approx([0.5, 0.5])
    for curve in (means, course):
        assert np.isfinite(curve.low[..., 0]).all()
        assert np.isnan(curve.low[..., 1:]).all()
        assert np.isnan(curve.high[..., 1:]).all()
        assert np.isnan(curve.mean[..., 2]).all()


def test_the_interval_of_noise_covers_a_half_and_that_of_a_shift_does_not():
    draw, scene = np.random.default_rng(7), np.repeat(np.arange(20), 5)
    noise, other = draw.random((2, 3, 100, 1))
    _, low, high = first_step(auc_by_step(traces_of(noise, scene), traces_of(other, scene)))
    assert 0.3 < low < 0.5 < high < 0.7
    # Uniform against uniform + 0.4: 1 - 0.6^2 / 2 = 0.82, s.e. about 0.02.
    mean, low, _ = first_step(auc_by_step(traces_of(noise + 0.4, scene), traces_of(other, scene)))
    assert mean == pytest.approx(0.82, abs=0.06)
    assert low > 0.7
