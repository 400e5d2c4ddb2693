"""What the networks see of a packed row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.scenes import CATEGORIES
from support.tiny_world import BANK

from jaxnav.policies.features import NUM_FEATURES, unpack_features
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat

NUM_CATEGORIES = len(CATEGORIES)
#: Cells along each side of the view.
VIEW_SIZE = 11


def packed_row():
    """Row with three categories.

    Category 0 is far ahead on the left, category 1 is not detected though its bytes are not 0, and category 2 is in the
    agent's own cell.
    """
    detections = np.array([[[255, 255, 1, 51], [0, 99, 7, 200], [51, 0, 128, 255]]], np.uint8)
    view = np.zeros((1, VIEW_SIZE, VIEW_SIZE), np.uint8)
    view[0, 0, 0] = VIEW_FREE
    view[0, 10, 10] = VIEW_BLOCKED
    return jnp.asarray(RowFormat(NUM_CATEGORIES).pack(detections, view)[0])


def test_features_of_a_row_packed_by_hand():
    features = unpack_features(packed_row(), jnp.int32(2), RowFormat(NUM_CATEGORIES))
    half = np.sqrt(0.5)
    # Category 0: confidence 255 / 255 = 1; ahead 255 / 51 = 5 m -> 1; right (1 - 128) / 25.4 = -5 m -> -1; distance
    # sqrt(2); sine -1 / sqrt(2), cosine 1 / sqrt(2); size 51 / 127.5 = 0.4. It is not the goal.
    np.testing.assert_allclose(features.table[0], [1, 1, 1, -1, np.sqrt(2), -half, half, 0.4, 0], rtol=1e-6)
    # Category 1 is not detected: all zero, whatever its bytes.
    np.testing.assert_array_equal(features.table[1], np.zeros(NUM_FEATURES))
    # Category 2: confidence 51 / 255 = 0.2; in the agent's own cell, so no bearing; size 255 / 127.5 = 2; the goal.
    np.testing.assert_allclose(features.table[2], [1, 0.2, 0, 0, 0, 0, 0, 2, 1], rtol=1e-6)
    np.testing.assert_array_equal(features.visible, [1, 0, 1])
    np.testing.assert_array_equal(features.goal, [0, 0, 1])
    # The view: 121 flags of standable cells, then 121 of the others. Only the first and the last cell are known.
    assert np.flatnonzero(features.view).tolist() == [0, 121 + 120]


def test_a_goal_that_is_not_detected_has_its_flag_alone():
    table = unpack_features(packed_row(), jnp.int32(1), RowFormat(NUM_CATEGORIES)).table
    np.testing.assert_array_equal(table[1], [0] * (NUM_FEATURES - 1) + [1])
    np.testing.assert_array_equal(table[:, -1], [0, 1, 0])


@pytest.mark.slow
def test_features_of_every_row_of_a_bank_are_finite_and_of_order_one():
    features = unpack_features(jnp.asarray(BANK.rows), jnp.zeros(len(BANK.rows), jnp.int32), RowFormat(NUM_CATEGORIES))
    assert (np.abs(np.concatenate(jax.tree.map(np.ravel, list(features)))) <= 2).all()
    np.testing.assert_array_equal(features.visible, RowFormat(NUM_CATEGORIES).presence(BANK.rows))
