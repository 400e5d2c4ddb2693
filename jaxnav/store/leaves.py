"""What the arrays of a tree are, and whether they are the same."""

import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils


def describe(tree: Any) -> dict[str, str]:
    """Describe the arrays of a tree: `['kernel']: float32[3,4]`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): f"{x.dtype}[{','.join(map(str, x.shape))}]" for path, x in leaves}


def digests(state: Any) -> dict[str, str]:
    """Return the start of the SHA-256 of every leaf.

    16 hexadecimal digits; equal on any number of devices, all of whose processes have to call.
    """
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): hashlib.sha256(_bytes(leaf)).hexdigest()[:16] for path, leaf in leaves}


def _bytes(leaf: jax.Array) -> bytes:
    data = jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
    if data.is_fully_replicated:  # also over processes: no exchange
        return np.asarray(data).tobytes()
    if not data.is_fully_addressable:
        data = multihost_utils.process_allgather(data, tiled=True)
    return np.asarray(data).tobytes()
