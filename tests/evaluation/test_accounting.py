"""The remaining share of a lead is exact in closed forms, and its interval covers the true share in simulation."""

import numpy as np
import pytest
from support.intervals import bounds

from jaxnav.evaluation.report import remaining_share
from jaxnav.evaluation.statistics import scene_clusters

NUM_SCENES = 12
EPISODES_PER_SCENE = 10
NUM_SEEDS = 4
FLOOR_PLANS = np.repeat(np.arange(NUM_SCENES), EPISODES_PER_SCENE)
CLUSTERS = scene_clusters(FLOOR_PLANS, np.zeros(len(FLOOR_PLANS), int))


def draw_results(generator, success, spread=0.05):
    """Success of 4 policies in 120 episodes, with effects of seeds and scenes."""
    seed_effects = generator.normal(0, spread, (NUM_SEEDS, 1))
    scene_effects = generator.normal(0, spread, NUM_SCENES)[FLOOR_PLANS]
    return success + seed_effects + scene_effects + generator.normal(0, 0.1, (NUM_SEEDS, len(FLOOR_PLANS)))


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0, 1.5])
def test_remaining_share_of_a_fixed_share_is_exact(share):
    generator = np.random.default_rng(0)
    agent = draw_results(generator, 0.9)
    # The layout-blind agent has equal seeds, so leaving a seed out changes nothing.
    layout_blind = np.broadcast_to(draw_results(generator, 0.6)[:1], agent.shape)
    interval = remaining_share(layout_blind, agent, layout_blind + share * (agent - layout_blind), CLUSTERS)
    # With agent a, layout-blind agent b and share s: (b + s (a - b) - b) / (a - b) = s under all weights.
    np.testing.assert_allclose(bounds(interval), 100 * share, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.5])
def test_remaining_share_of_equal_runs_leaves_a_run_out_of_both_agents(share):
    generator = np.random.default_rng(3)
    agent = draw_results(generator, 0.9)
    layout_blind = agent - 0.3 - draw_results(generator, 0.0)  # the lead differs between runs
    removed = layout_blind + share * (agent - layout_blind)
    interval = remaining_share(layout_blind, agent, removed, CLUSTERS, same_runs=True)
    # Each run keeps an equal share of its lead, so the share does not depend on the run that is left out.
    np.testing.assert_allclose(bounds(interval), 100 * share, atol=1e-9)
    # With separate runs, numerator and denominator leave out runs with different leads.
    separate_interval = remaining_share(layout_blind, agent, removed, CLUSTERS)
    assert separate_interval.high - separate_interval.low > 1.0


def test_remaining_share_interval_covers_the_true_share():
    generator = np.random.default_rng(1)
    num_covered = 0
    for _ in range(200):
        # Experience costs 0.3 of success, and after removal 0.1: a third of the cost remains.
        layout_blind = draw_results(generator, 0.9)
        agent = draw_results(generator, 0.6)
        removed = draw_results(generator, 0.8)
        interval = remaining_share(layout_blind, agent, removed, CLUSTERS)
        num_covered += interval.low <= 100 / 3 <= interval.high
    assert num_covered >= 184  # 92 % of 200; the 95 % interval of 95 % is 184 to 195


def test_remaining_share_of_an_unclear_lead_is_nan():
    generator = np.random.default_rng(2)
    layout_blind = draw_results(generator, 0.6)
    agent = draw_results(generator, 0.6)
    assert np.isnan(remaining_share(layout_blind, agent, agent, CLUSTERS).mean)
