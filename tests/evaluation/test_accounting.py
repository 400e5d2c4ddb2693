"""Shares of a lead, by hand and by simulation."""

import numpy as np
import pytest

from jaxnav.evaluation.report import remaining_share
from jaxnav.evaluation.statistics import scene_clusters

SCENES, NUM_EPISODES, SEEDS = 12, 10, 4
FLOOR_PLANS = np.repeat(np.arange(SCENES), NUM_EPISODES)
CLUSTERS = scene_clusters(FLOOR_PLANS, np.zeros(len(FLOOR_PLANS), int))


def draw_results(generator, success, spread=0.05):
    """Success of 4 policies in 120 episodes, with seeds and scenes that differ."""
    seed_effects, scene_effects = (
        generator.normal(0, spread, (SEEDS, 1)),
        generator.normal(0, spread, SCENES)[FLOOR_PLANS],
    )
    return success + seed_effects + scene_effects + generator.normal(0, 0.1, (SEEDS, len(FLOOR_PLANS)))


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0, 1.5])
def test_remaining_share_of_a_fixed_share_is_exact(share):
    generator = np.random.default_rng(0)
    agent = draw_results(generator, 0.9)
    without = np.broadcast_to(
        draw_results(generator, 0.6)[:1], agent.shape
    )  # equal seeds, so that leaving one out is no change
    interval = remaining_share(without, agent, without + share * (agent - without), CLUSTERS)
    # (w + s (a - w) - w) / (a - w) = s under all weights, so nothing varies.
    np.testing.assert_allclose((interval.mean, interval.low, interval.high), 100 * share, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.5])
def test_remaining_share_of_the_same_runs_leaves_out_both_at_once(share):
    generator = np.random.default_rng(3)
    agent = draw_results(generator, 0.9)
    without = agent - 0.3 - draw_results(generator, 0.0)  # a lead of its own in every run
    removed = without + share * (agent - without)
    interval = remaining_share(without, agent, removed, CLUSTERS, same_runs=True)
    # Each run keeps the same share of its own lead, whichever run is left out.
    np.testing.assert_allclose((interval.mean, interval.low, interval.high), 100 * share, atol=1e-9)
    # As separate runs, numerator and denominator would leave out runs with different leads.
    separate = remaining_share(without, agent, removed, CLUSTERS)
    assert separate.high - separate.low > 1.0


def test_remaining_share_interval_covers_the_true_share():
    generator, num_covered = np.random.default_rng(1), 0
    for _ in range(200):
        # A cost: -0.3 with experience, -0.1 with removal; a third of it is left.
        without, agent, removed = (draw_results(generator, success) for success in (0.9, 0.6, 0.8))
        interval = remaining_share(without, agent, removed, CLUSTERS)
        num_covered += interval.low <= 100 / 3 <= interval.high
    assert num_covered >= 184  # 92 % of 200; the 95 % interval of 95 % is 184 to 195


def test_remaining_share_of_an_unclear_lead_is_nan():
    generator = np.random.default_rng(2)
    without, agent = draw_results(generator, 0.6), draw_results(generator, 0.6)
    assert np.isnan(remaining_share(without, agent, agent, CLUSTERS).mean)
