"""The packed byte row, by NumPy and by JAX."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.scenes.tables.observation_row import RowFormat, turn_offsets


@pytest.mark.parametrize(("num_categories", "num_bytes"), [(22, 128), (37, 192)])
def test_row_format_unpacks_what_it_packed(num_categories, num_bytes):
    # 22: 88 + 31 = 119 bytes (121 cells of 2 bits are 30.25 bytes); 37: 148 + 31 = 179; whole lines of 32.
    row_format = RowFormat(num_categories)
    draws = np.random.default_rng(0)
    num_poses = 50
    detections = draws.integers(0, 256, (num_poses, num_categories, 4), np.uint8)
    detections[draws.random((num_poses, num_categories)) < 0.5] = 0
    view = draws.integers(0, 3, (num_poses, 11, 11), np.uint8)

    # The size is as worked out above.
    rows = row_format.pack(detections, view)
    assert (rows.shape, rows.dtype) == ((num_poses, row_format.num_bytes), np.uint8)
    assert row_format.num_bytes == num_bytes

    # NumPy and JAX unpack equal values.
    for packed_rows in (rows, jnp.asarray(rows)):
        np.testing.assert_array_equal(row_format.detections(packed_rows), detections)
        np.testing.assert_array_equal(row_format.presence(packed_rows), detections[..., 0] > 0)
        np.testing.assert_array_equal(row_format.view_cells(packed_rows), view.reshape(num_poses, -1))
        np.testing.assert_array_equal(row_format.view_cells(packed_rows[0]), view[0].reshape(-1))


@pytest.mark.parametrize(("num_categories", "num_bytes"), [(22, 160), (16, 128)])
def test_counts_stand_behind_the_view_and_leave_the_other_bytes_in_place(num_categories, num_bytes):
    # 22: 119 + 22 = 141 bytes; 16: 64 + 31 + 16 = 111; whole lines of 32.
    row_format = RowFormat(num_categories, has_counts=True)
    plain_format = RowFormat(num_categories)
    draws = np.random.default_rng(1)
    detections = draws.integers(0, 256, (20, num_categories, 4), np.uint8)
    view = draws.integers(0, 3, (20, 11, 11), np.uint8)
    counts = draws.integers(0, 256, (20, num_categories), np.uint8)

    rows = row_format.pack(detections, view, counts)
    assert rows.shape == (20, num_bytes) == (20, row_format.num_bytes)
    num_filled = 4 * num_categories + 31
    np.testing.assert_array_equal(rows[:, :num_filled], plain_format.pack(detections, view)[:, :num_filled])
    for packed_rows in (rows, jnp.asarray(rows)):
        np.testing.assert_array_equal(row_format.counts(packed_rows), counts)
        # A format without counts reads the same rows.
        for reader in (row_format, plain_format):
            np.testing.assert_array_equal(reader.detections(packed_rows), detections)
            np.testing.assert_array_equal(reader.view_cells(packed_rows), view.reshape(20, -1))


def test_row_format_refuses_counts_that_its_rows_do_not_hold():
    detections = np.zeros((3, 4), np.uint8)
    view = np.zeros((11, 11), np.uint8)
    counts = np.zeros(3, np.uint8)
    for row_format, given_counts in ((RowFormat(3), counts), (RowFormat(3, has_counts=True), None)):
        with pytest.raises(ValueError, match="give instance counts exactly for rows that hold them"):
            row_format.pack(detections, view, given_counts)
    with pytest.raises(ValueError, match="these rows hold no instance counts; compile the scenes with"):
        RowFormat(3).counts(RowFormat(3).pack(detections, view))


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_offsets_turn_clockwise_with_the_heading(array):
    # 2 ahead and 1 to the right, as (x, z): facing +z (1, 2), facing +x (2, -1), facing -z (-1, -2).
    ahead = array(np.full(3, 2.0, np.float32))
    right = array(np.ones(3, np.float32))
    forward = array(np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]], np.float32))
    np.testing.assert_array_equal(turn_offsets(ahead, right, forward), [[1.0, 2.0], [2.0, -1.0], [-1.0, -2.0]])
