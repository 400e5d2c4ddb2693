"""What the networks see of a packed row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.scenes import CATEGORIES
from support.tiny_world import BANK

from jaxnav.policies.features import NUM_FEATURES, unpack_features
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat

K, VIEW = len(CATEGORIES), 11


def packed_row():
    """Category 0 far ahead on the left, category 1 not detected though its bytes are not 0, category 2 right here."""
    detections = np.array([[[255, 255, 1, 51], [0, 99, 7, 200], [51, 0, 128, 255]]], np.uint8)
    view = np.zeros((1, VIEW, VIEW), np.uint8)
    view[0, 0, 0], view[0, 10, 10] = VIEW_FREE, VIEW_BLOCKED
    return jnp.asarray(RowFormat(K).pack(detections, view)[0])


def test_features_of_a_row_packed_by_hand():
    seen = unpack_features(packed_row(), jnp.int32(2), RowFormat(K))
    half = np.sqrt(0.5)
    # Category 0: confidence 255 / 255 = 1; ahead 255 / 51 = 5 m -> 1; right (1 - 128) / 25.4 = -5 m -> -1; distance
    # sqrt(2); sine -1 / sqrt(2), cosine 1 / sqrt(2); size 51 / 127.5 = 0.4. It is not the goal.
    np.testing.assert_allclose(seen.table[0], [1, 1, 1, -1, np.sqrt(2), -half, half, 0.4, 0], rtol=1e-6)
    # Category 1 is not detected: all zero, whatever its bytes.
    np.testing.assert_array_equal(seen.table[1], np.zeros(NUM_FEATURES))
    # Category 2: confidence 51 / 255 = 0.2; right here, so no bearing; size 255 / 127.5 = 2. It is the goal.
    np.testing.assert_allclose(seen.table[2], [1, 0.2, 0, 0, 0, 0, 0, 2, 1], rtol=1e-6)
    np.testing.assert_array_equal(seen.visible, [1, 0, 1])
    np.testing.assert_array_equal(seen.goal, [0, 0, 1])
    # The view: 121 flags of standable cells, then 121 of the others. Only the first and the last cell are known.
    assert np.flatnonzero(seen.view).tolist() == [0, 121 + 120]


def test_a_goal_that_is_not_detected_has_its_flag_alone():
    table = unpack_features(packed_row(), jnp.int32(1), RowFormat(K)).table
    np.testing.assert_array_equal(table[1], [0] * (NUM_FEATURES - 1) + [1])
    np.testing.assert_array_equal(table[:, -1], [0, 1, 0])


@pytest.mark.slow
def test_features_of_every_row_of_a_bank_are_finite_and_of_order_one():
    seen = unpack_features(jnp.asarray(BANK.rows), jnp.zeros(len(BANK.rows), jnp.int32), RowFormat(K))
    assert (np.abs(np.concatenate(jax.tree.map(np.ravel, list(seen)))) <= 2).all()
    np.testing.assert_array_equal(seen.visible, RowFormat(K).presence(BANK.rows))
