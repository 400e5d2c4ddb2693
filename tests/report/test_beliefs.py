"""Tests of the heat maps of the belief: they equal those of the pictures of a search and cover the home."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, corridor_scene

from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.removal import InferenceTrace
from jaxnav.policies.methods.belief import BELIEF, MAP_SQUARES, learn_belief_setup
from jaxnav.policies.network import init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.report.beliefs import SQUARE_SIZE, BeliefTracer, find_squares
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import scene_extent
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import MOVE_AHEAD, Task
from jaxnav.viz.episode import PlayedEpisode
from jaxnav.viz.search import MapProjection, take_snapshot

CORRIDOR = corridor_scene(24)
BANK = compile_bank([CORRIDOR], Task(CATEGORIES, detector=PERFECT_DETECTOR))
NUM_STEPS = 8


@pytest.fixture(scope="module")
def episode():
    """A walk along the corridor in search of a chair, which the belief expects near the book.

    The removed share of this experience differs from step to step.
    """
    # Policies of the method `belief` with a hand-made relation between chair and book.
    spec = PolicySpec(BELIEF, len(CATEGORIES))
    params = init_params(spec, jax.random.key(0))
    params["method"]["relations"] = params["method"]["relations"].at[CHAIR, 0, BOOK].set(2.0)
    setup = learn_belief_setup([BANK], np.zeros(0))
    knowledge = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, setup))
    policies = tiny.make_untrained_policies(spec, knowledge, BANK.task)
    policies = policies._replace(params=jax.tree.map(lambda leaf: leaf[None], params), arms=("layout",))

    # Each step moves one cell ahead, and the target is a square of the map.
    poses = tiny.POSES_PER_CELL * np.arange(3, 3 + NUM_STEPS)
    choices = np.zeros((NUM_STEPS, MAP_SQUARES**2), np.float32)
    choices[:, 30] = 1.0

    # The weight of the removal rises from step to step.
    zeros = np.zeros(NUM_STEPS, np.float32)
    removal_weight = np.linspace(0.2, 0.9, NUM_STEPS).astype(np.float32)
    layout_weights = np.ones((NUM_STEPS, len(CATEGORIES)), np.float32)
    inferred: Any = InferenceTrace._make((layout_weights, zeros, removal_weight, choices, choices, choices))

    places = cell_centres(CORRIDOR, standable_cells(CORRIDOR.reach))
    return PlayedEpisode(
        trace=EpisodeTrace(poses, np.full(NUM_STEPS, MOVE_AHEAD), inferred, success=False),
        scene=CORRIDOR,
        places=places[poses // tiny.POSES_PER_CELL],
        rows=BANK.rows[poses],
        task=BANK.task,
        goal=CHAIR,
        best_length=1,
        epsilon=0.0,
        title="test",
        policies=policies,
    )


@pytest.mark.slow
def test_beliefs_are_those_of_the_pictures_of_a_search(episode):
    steps, beliefs = BeliefTracer(episode.policies).compute(episode.trace, BANK, CHAIR)
    assert steps.tolist() == [0, 5]
    for step, belief in zip(steps, beliefs, strict=True):
        _, after_removal = take_snapshot(episode, int(step)).beliefs.values()
        np.testing.assert_allclose(belief, after_removal, rtol=1e-5)
    assert beliefs[1].max() > 1.5 * beliefs[1].min()


def test_only_searches_by_belief_have_beliefs(episode):
    assert BeliefTracer.supports(episode.policies)
    assert not BeliefTracer.supports(tiny.make_untrained_policies())


@pytest.mark.slow
def test_squares_lie_where_the_map_has_them(episode):
    snapshot = take_snapshot(episode, 0)
    projection = MapProjection(episode, snapshot)
    grid = find_squares(CORRIDOR, episode.places[0], MAP_SQUARES)
    for row in range(len(grid.rows)):
        for column in range(len(grid.columns)):
            # The first cell of the square lies a quarter of its side from its corner.
            corner = grid.low_corner + SQUARE_SIZE * np.array([column, row])
            first_cell = 2 * np.array([grid.rows[row], grid.columns[column]])
            np.testing.assert_allclose(projection.to_world(first_cell), corner + SQUARE_SIZE / 4, atol=1e-6)


def test_squares_cover_the_home():
    low, high = scene_extent(CORRIDOR)
    grid = find_squares(CORRIDOR, np.array([0.5, 1.0]), MAP_SQUARES)
    end = grid.low_corner + SQUARE_SIZE * np.array([len(grid.columns), len(grid.rows)])
    assert (grid.low_corner <= low).all()
    assert (high <= end).all()
    assert (end - high < SQUARE_SIZE).all()
