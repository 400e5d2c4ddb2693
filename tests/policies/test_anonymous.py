"""The anonymous agent knows the view and the goal's detection, and nothing else."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CHAIR, FRIDGE

from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import find_method
from jaxnav.policies.network import bind
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.scenes.tables.observation_row import RowFormat

ROW_FORMAT = RowFormat(3)
BOOK_SEEN, CHAIR_SEEN, NOTHING = (204, 102, 128, 38), (150, 51, 140, 60), (0, 0, 0, 0)


@functools.cache
def deciding(method):
    """Return a compiled first decision of a lively policy."""
    spec = dataclasses.replace(tiny.SPEC, method=find_method(method), method_sizes=())
    policy = bind(spec, tiny.random_params(0, spec))

    @jax.jit
    def decide(observation):
        return policy.decide(policy.pathways(PolicyInputs(observation, jnp.ones(3))), policy.initial_memory()).logits

    return decide


def logits(method, detections, goal, view=0):
    cells = np.full((1, 11, 11), view, np.uint8)
    row = ROW_FORMAT.pack(np.array([detections], np.uint8), cells)[0]
    return deciding(method)(Observation(row=jnp.asarray(row), goal=jnp.int32(goal)))


def test_which_goal_it_is_does_not_matter():
    """The same detection, of the book or of the chair as the goal, gives the same bits."""
    book = logits("anonymous", [BOOK_SEEN, NOTHING, NOTHING], BOOK)
    chair = logits("anonymous", [NOTHING, BOOK_SEEN, NOTHING], CHAIR)
    np.testing.assert_array_equal(book, chair)
    np.testing.assert_array_equal(logits("anonymous", [NOTHING] * 3, FRIDGE), logits("anonymous", [NOTHING] * 3, BOOK))


def test_what_else_is_detected_does_not_matter():
    alone = logits("anonymous", [BOOK_SEEN, NOTHING, NOTHING], BOOK)
    among = logits("anonymous", [BOOK_SEEN, CHAIR_SEEN, CHAIR_SEEN], BOOK)
    np.testing.assert_array_equal(alone, among)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rgb", "org"])
def test_for_other_agents_both_matter(method):
    """The negative control."""
    book = logits(method, [BOOK_SEEN, NOTHING, NOTHING], BOOK)
    assert np.abs(book - logits(method, [NOTHING, BOOK_SEEN, NOTHING], CHAIR)).max() > 1e-3
    assert np.abs(book - logits(method, [BOOK_SEEN, CHAIR_SEEN, NOTHING], BOOK)).max() > 1e-3


def test_the_view_and_the_goals_detection_do_matter():
    seen = logits("anonymous", [BOOK_SEEN, NOTHING, NOTHING], BOOK)
    assert np.abs(seen - logits("anonymous", [NOTHING] * 3, BOOK)).max() > 1e-3
    assert np.abs(seen - logits("anonymous", [CHAIR_SEEN, NOTHING, NOTHING], BOOK)).max() > 1e-3
    assert np.abs(seen - logits("anonymous", [BOOK_SEEN, NOTHING, NOTHING], BOOK, view=1)).max() > 1e-3


def test_its_networks_have_one_category():
    spec = dataclasses.replace(tiny.SPEC, method=find_method("anonymous"), method_sizes=())
    params = tiny.random_params(0, spec)
    chex.assert_shape(params["appearance"]["embedding"], (1, tiny.SIZES.appearance))
    chex.assert_shape(params["sought"]["embedding"], (1, tiny.SIZES.appearance))
    assert "method" not in params
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) < sum(
        leaf.size for leaf in jax.tree.leaves(tiny.random_params(0))
    )
