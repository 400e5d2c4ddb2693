"""What must hold of an export's arrays, whoever wrote it."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.policies.policy import init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.store.manifest import describe, differences


def check_arrays(where: Path, tensors: Mapping[str, Any], spec: PolicySpec) -> None:
    """Refuse arrays of other shapes or dtypes, or not finite.

    Args:
      where: the export, for messages.
      tensors: its arrays, as `load_params` gives them.
      spec: what it says that the policy is built from.

    Raises:
      InputError: names the arrays.
    """
    expected = {name: tree for name, tree in _expected(spec).items() if name in tensors or name != "signs"}
    held = {name: tensors.get(name, {}) for name in expected}
    if different := differences(describe(held), describe(expected)):
        raise InputError(
            f"{where}: its arrays do not fit its spec (there != expected): {'; '.join(different)}; train the run anew"
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path(tensors):
        if not np.isfinite(leaf).all():
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise InputError(f"{where}: {name} holds numbers that are not finite; train the run anew")


@functools.lru_cache(maxsize=16)
def _expected(spec: PolicySpec) -> dict[str, Any]:
    """Return shapes and dtypes of the arrays, but for what the method learned."""
    pairs = jax.ShapeDtypeStruct((NUM_PRIORS, spec.num_categories, spec.num_categories), jnp.float32)
    return {
        "policy": jax.eval_shape(functools.partial(init_params, spec), jax.random.key(0)),
        "layout": {"prior": pairs, "counts": pairs},
        "signs": {"odds": pairs, "chance": pairs},
    }
