"""The packed byte row, by NumPy and by JAX."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.scenes.tables.observation_row import RowFormat


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
