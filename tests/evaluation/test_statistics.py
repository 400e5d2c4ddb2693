import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import paired_difference, summary

ONE_STRATUM = np.zeros(1000, int)


def rng(seed=0):
    return np.random.default_rng(seed)


def half_width(result):
    return (result.ci95[1] - result.ci95[0]) / 2


def test_equal_results_have_no_spread():
    result = summary(np.full((3, 40), 0.7), np.arange(40) % 4, rng())
    assert result.mean == pytest.approx(0.7)
    assert result.std == pytest.approx(0, abs=1e-12)
    assert result.ci95 == pytest.approx((0.7, 0.7))


def test_mean_and_std_over_seed_means():
    # Seed means 1, 2 and 6: mean 3, sample variance (4 + 1 + 9) / 2 = 7.
    values = np.array([[0.0, 2.0], [2.0, 2.0], [5.0, 7.0]])
    result = summary(values, np.zeros(2, int), rng())
    assert result.mean == pytest.approx(3)
    assert result.std == pytest.approx(np.sqrt(7))


def test_bernoulli_mean_matches_the_normal_approximation():
    # One seed, one stratum, 300 successes of 1000: 0.3 +- 1.96 * sqrt(0.3 * 0.7 / 1000) = 0.3 +- 0.0284.
    # A bootstrap quantile from 2000 resamples wanders by about 0.06 standard errors = 0.0009; 0.004 is over 4 of them.
    values = (np.arange(1000) < 300)[None]
    result = summary(values, ONE_STRATUM, rng())
    assert result.std == 0.0
    assert result.ci95 == pytest.approx((0.2716, 0.3284), abs=0.004)


def test_strata_take_out_the_variance_between_room_types():
    # 100 easy episodes (90 successes) and 100 hard ones (10 successes). Stratified: the variance of the mean is
    # (0.9 * 0.1 / 100 + 0.1 * 0.9 / 100) / 4 = 0.00045; unstratified: 0.5 * 0.5 / 200 = 0.00125.
    values = np.r_[np.arange(100) < 90, np.arange(100) < 10][None]
    stratified = summary(values, np.repeat([0, 1], 100), rng())
    pooled = summary(values, np.zeros(200, int), rng())
    assert half_width(stratified) == pytest.approx(1.96 * np.sqrt(0.00045), rel=0.1)
    assert half_width(pooled) == pytest.approx(1.96 * np.sqrt(0.00125), rel=0.1)


def test_strata_may_have_any_labels_sizes_and_order():
    # Each stratum is constant, so every resample has the same mean: (2 * 1 + 1 * 4 + 3 * 5) / 6 = 3.5.
    result = summary(np.array([[1.0, 4.0, 5.0, 5.0, 1.0, 5.0]]), np.array([9, -1, 7, 7, 9, 7]), rng())
    assert result.ci95 == pytest.approx((3.5, 3.5))


def test_seeds_are_resampled():
    # Seed means 0 and 1: resampled means 0, 1/2, 1 with probabilities 1/4, 1/2, 1/4, so both tails exceed 2.5 %.
    values = np.repeat([[0.0], [1.0]], 50, axis=1)
    result = summary(values, np.zeros(50, int), rng())
    assert result.std == pytest.approx(np.sqrt(0.5))
    assert result.ci95 == pytest.approx((0, 1))


def test_all_seeds_share_the_episode_draw():
    # Nine seeds with identical results say no more than one; a draw for each seed would divide the width by 3.
    values = (np.arange(1000) < 500)[None]
    repeated = summary(np.repeat(values, 9, axis=0), ONE_STRATUM, rng())
    assert half_width(repeated) == pytest.approx(1.96 * np.sqrt(0.25 / 1000), rel=0.1)


def test_interval_covers_the_truth_as_often_as_it_says():
    # Success where 0.4 + seed effect (sd 0.05) + episode difficulty (sd 1) + noise (sd 1) > 0. Over all seeds and
    # episodes the sum is normal with variance 1 + 1 + 0.0025, so the true rate is Phi(0.4 / sqrt(2.0025)).
    truth = norm.cdf(0.4 / np.sqrt(2.0025))
    generator, covered = rng(1), 0
    for _ in range(200):
        seed, episode, noise = (generator.normal(size=shape) for shape in [(3, 1), (1, 200), (3, 200)])
        low, high = summary(0.4 + 0.05 * seed + episode + noise > 0, np.arange(200) % 4, generator, 400).ci95
        covered += low <= truth <= high
    assert 0.88 <= covered / 200 <= 0.99


def test_same_generator_state_same_result():
    values = rng(3).random((3, 60))
    strata = np.arange(60) % 4
    assert summary(values, strata, rng(5)) == summary(values, strata, rng(5))
    assert summary(values, strata, rng(5)).ci95 != summary(values, strata, rng(6)).ci95


@settings(deadline=None, max_examples=30)
@given(
    st.lists(st.integers(-50, 50), min_size=24, max_size=24),
    st.floats(0.1, 100),
    st.floats(-10, 10),
    st.integers(0, 99),
)
def test_summary_follows_a_change_of_units(cells, scale, shift, seed):
    values, strata = np.reshape(cells, (3, 8)) / 10, np.arange(8) % 2
    before, after = summary(values, strata, rng(seed), 50), summary(values * scale + shift, strata, rng(seed), 50)
    assert after.mean == pytest.approx(before.mean * scale + shift, abs=1e-9)
    assert after.std == pytest.approx(before.std * scale, abs=1e-9)
    assert after.ci95 == pytest.approx(tuple(bound * scale + shift for bound in before.ci95), abs=1e-9)
    assert values.min() - 1e-9 <= before.ci95[0] <= before.ci95[1] <= values.max() + 1e-9


@settings(deadline=None, max_examples=30)
@given(st.lists(st.booleans(), min_size=32, max_size=32), st.booleans())
def test_difference_of_an_arm_with_itself_is_centred_on_zero(outcomes, same_seeds):
    values = np.reshape(outcomes, (2, 16))
    result = paired_difference(values, values, np.arange(16) % 3, rng(), 50, same_seeds)
    assert result.mean == 0.0
    assert result.ci95[0] <= 1e-12
    assert result.ci95[1] >= -1e-12
    if same_seeds:
        assert result.ci95 == (0.0, 0.0)


def test_pairing_cancels_episode_difficulty():
    # Episode difficulty splits the 1000 episodes in halves; b wins 40 of the lost ones. Differences: 40 ones, 960
    # zeros, so the half-width is 1.96 * sqrt(0.04 * 0.96 / 1000) = 0.0121. Negative control, arms on separate
    # draws: variances 0.5 * 0.5 / 1000 + 0.54 * 0.46 / 1000, half-width 1.96 * 0.0223 = 0.0437.
    a, b = (np.arange(1000) < 500)[None], (np.arange(1000) < 540)[None]
    for same_seeds in (False, True):
        paired = paired_difference(a, b, ONE_STRATUM, rng(), same_seeds=same_seeds)
        assert paired.mean == pytest.approx(0.04)
        assert half_width(paired) == pytest.approx(0.0121, rel=0.1)
    unpaired = np.hypot(half_width(summary(a, ONE_STRATUM, rng(1))), half_width(summary(b, ONE_STRATUM, rng(2))))
    assert unpaired == pytest.approx(0.0437, rel=0.1)


def test_difference_is_second_minus_first():
    a, b = np.zeros((2, 6)), np.full((2, 6), 2.0)
    assert paired_difference(a, b, np.zeros(6, int), rng()).ci95 == pytest.approx((2, 2))
    assert paired_difference(b, a, np.zeros(6, int), rng()).ci95 == pytest.approx((-2, -2))


def test_seeds_are_drawn_together_only_for_the_same_network():
    # Seed means 0 and 1 in a, 0.1 higher in b. The same networks always gain 0.1. Arms trained apart: the means of
    # two drawn seeds are 0, 1/2 or 1 in each arm, so b - a is -0.9 or 1.1 with probability 1/4 * 1/4 = 6.25 % > 2.5 %.
    a = np.repeat([[0.0], [1.0]], 20, axis=1)
    strata = np.zeros(20, int)
    same = paired_difference(a, a + 0.1, strata, rng(), same_seeds=True)
    assert same.ci95 == pytest.approx((0.1, 0.1))
    assert same.std == pytest.approx(0, abs=1e-12)
    apart = paired_difference(a, a + 0.1, strata, rng())
    assert apart.ci95 == pytest.approx((-0.9, 1.1))
    assert apart.std == pytest.approx(1)  # sqrt(1/2 + 1/2)


@pytest.mark.parametrize(
    ("values", "strata", "resamples", "message"),
    [
        (np.array([[0.0, np.nan]]), np.zeros(2, int), 10, "NaN"),
        (np.array([[0.0, np.inf]]), np.zeros(2, int), 10, "infinite"),
        (np.zeros(4), np.zeros(4, int), 10, r"\[seeds, episodes\]"),
        (np.zeros((0, 4)), np.zeros(4, int), 10, "at least one"),
        (np.zeros((3, 0)), np.zeros(0, int), 10, "at least one"),
        (np.zeros((3, 4)), np.zeros(3, int), 10, "strata"),
        (np.zeros((3, 4)), np.zeros(4, int), 0, "resamples"),
    ],
)
def test_bad_input_is_refused(values, strata, resamples, message):
    with pytest.raises(InputError, match=message):
        summary(values, strata, rng(), resamples)
    with pytest.raises(InputError, match=message):
        paired_difference(values, values, strata, rng(), resamples)


def test_arms_of_unequal_shape_are_refused():
    with pytest.raises(InputError, match="differ in shape"):
        paired_difference(np.zeros((2, 4)), np.zeros((3, 4)), np.zeros(4, int), rng())
