"""The anonymous agent: decisions depend on the view and the goal's detection, and on no category."""

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
#: Bytes of detections: confidence, ahead, right and size.
BOOK_DETECTION = (204, 102, 128, 38)
CHAIR_DETECTION = (150, 51, 140, 60)
NO_DETECTION = (0, 0, 0, 0)


@functools.cache
def compile_decision(method_name):
    """Compiled first decision of a policy with random parameters."""
    spec = dataclasses.replace(tiny.SPEC, method=find_method(method_name), method_sizes=())
    policy = bind(spec, tiny.random_params(0, spec))

    @jax.jit
    def decide(observation):
        return policy.decide(policy.pathways(PolicyInputs(observation, jnp.ones(3))), policy.initial_memory()).logits

    return decide


def first_logits(method_name, detections, goal, view_code=0):
    """Logits for the detections of book, chair and fridge; all cells of the view have one code."""
    view = np.full((1, 11, 11), view_code, np.uint8)
    row = ROW_FORMAT.pack(np.array([detections], np.uint8), view)[0]
    return compile_decision(method_name)(Observation(row=jnp.asarray(row), goal=jnp.int32(goal)))


def test_category_of_the_goal_does_not_matter():
    """Equal detections, of the book or of the chair as the goal, give bit-identical logits."""
    book_logits = first_logits("anonymous", [BOOK_DETECTION, NO_DETECTION, NO_DETECTION], BOOK)
    chair_logits = first_logits("anonymous", [NO_DETECTION, BOOK_DETECTION, NO_DETECTION], CHAIR)
    np.testing.assert_array_equal(book_logits, chair_logits)

    # Undetected goals.
    fridge_logits = first_logits("anonymous", [NO_DETECTION] * 3, FRIDGE)
    np.testing.assert_array_equal(fridge_logits, first_logits("anonymous", [NO_DETECTION] * 3, BOOK))


def test_detections_of_other_categories_do_not_matter():
    logits = first_logits("anonymous", [BOOK_DETECTION, NO_DETECTION, NO_DETECTION], BOOK)
    logits_with_others = first_logits("anonymous", [BOOK_DETECTION, CHAIR_DETECTION, CHAIR_DETECTION], BOOK)
    np.testing.assert_array_equal(logits, logits_with_others)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rgb", "org"])
def test_goal_category_and_other_detections_matter_to_other_agents(method):
    """The negative control."""
    logits = first_logits(method, [BOOK_DETECTION, NO_DETECTION, NO_DETECTION], BOOK)
    chair_logits = first_logits(method, [NO_DETECTION, BOOK_DETECTION, NO_DETECTION], CHAIR)
    logits_with_chair = first_logits(method, [BOOK_DETECTION, CHAIR_DETECTION, NO_DETECTION], BOOK)
    assert np.abs(logits - chair_logits).max() > 1e-3
    assert np.abs(logits - logits_with_chair).max() > 1e-3


def test_view_and_detection_of_the_goal_matter():
    detections = [BOOK_DETECTION, NO_DETECTION, NO_DETECTION]
    logits = first_logits("anonymous", detections, BOOK)
    undetected_logits = first_logits("anonymous", [NO_DETECTION] * 3, BOOK)
    other_detection_logits = first_logits("anonymous", [CHAIR_DETECTION, NO_DETECTION, NO_DETECTION], BOOK)
    other_view_logits = first_logits("anonymous", detections, BOOK, view_code=1)
    assert np.abs(logits - undetected_logits).max() > 1e-3
    assert np.abs(logits - other_detection_logits).max() > 1e-3
    assert np.abs(logits - other_view_logits).max() > 1e-3


def test_networks_of_the_anonymous_agent_have_one_category():
    spec = dataclasses.replace(tiny.SPEC, method=find_method("anonymous"), method_sizes=())
    params = tiny.random_params(0, spec)
    chex.assert_shape(params["appearance"]["embedding"], (1, tiny.SIZES.appearance))
    chex.assert_shape(params["sought"]["embedding"], (1, tiny.SIZES.appearance))
    assert "method" not in params
    num_params = sum(leaf.size for leaf in jax.tree.leaves(params))
    num_org_params = sum(leaf.size for leaf in jax.tree.leaves(tiny.random_params(0)))
    assert num_params < num_org_params
