"""Exported policies: how they are written, and what must hold of their arrays."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.env.types import Observation
from jaxnav.errors import InputError
from jaxnav.layout import Setting
from jaxnav.policies.methods import Knowledge, Percept, find_method
from jaxnav.policies.perception import Perception
from jaxnav.policies.policy import Params, bind, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import RunConfig
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.store.export import export_params
from jaxnav.store.leaves import describe
from jaxnav.store.manifest import differences
from jaxnav.training.exploration import Exploration


def export_policy(
    folder: Path,
    config: RunConfig,
    params: dict[str, Any],
    knowledge: Knowledge,
    setting: Setting | None,
    explored: Exploration,
) -> None:
    """Export one policy and what acting with it takes.

    Args:
      folder: made if missing.
      config: of its run.
      params: of the policy.
      knowledge: what was learned before training.
      setting: of the layout estimator; None without the layout.
      explored: what the priors were made of.
    """
    policy = config.policy_spec(len(config.task.categories))
    spec = {
        "method": config.method,
        "categories": list(config.task.categories),
        "task": dataclasses.asdict(config.task),
        "sizes": dataclasses.asdict(config.sizes),
        "method_sizes": config.method_sizes,
        "decision": config.decision,
        "direct": config.direct,
        "done_gate": config.done_gate,
        "goal_row": config.goal_row,
        "spatial_memory": None if policy.spatial_memory is None else dataclasses.asdict(policy.spatial_memory),
        "layout": None if setting is None else dataclasses.asdict(setting),
        "prior_steps": int(explored.steps),
        "prior_poses": int(explored.poses),
    }
    layout = {"prior": np.asarray(knowledge.layout), "counts": np.asarray(explored.counts)}
    tensors = {"policy": jax.device_get(params), "layout": layout}
    if knowledge.method:
        tensors["knowledge"] = jax.device_get(knowledge.method)
    if knowledge.signs is not None:
        tensors["signs"] = jax.device_get(knowledge.signs._asdict())
    export_params(folder, tensors, spec)


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


def check_knowledge(params: Params, spec: PolicySpec, knowledge: Knowledge) -> None:
    """Refuse what a method learned if its policy cannot act by it.

    One step is traced, not computed.

    Raises:
      InputError: says what does not fit.
    """
    row_format, none = RowFormat(spec.num_categories), jnp.int32(0)
    perception = Perception(row_format, spec)

    def act(params: Params, knowledge: Knowledge) -> Any:
        policy, row = bind(spec, params), jnp.zeros(row_format.num_bytes, jnp.uint8)
        percept = Percept(row, heading=none, action=none, moved=jnp.bool_(False), horizon=none, goal=none)
        perceived = perception.update(perception.init(knowledge, none), percept, knowledge, none)
        view = perception.view(perceived, Observation(row, goal=none), knowledge)
        pathways = policy.pathways(*view, policy.initial_memory())
        return pathways, find_method(spec.method).control.act(none, perceived.note, knowledge)

    try:
        jax.eval_shape(act, params, knowledge)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        reason = str(error).split("\n", maxsplit=1)[0]
        raise InputError(
            f"what method {spec.method!r} learned before training does not fit it ({type(error).__name__}: {reason}); "
            "train the run anew"
        ) from error


@functools.lru_cache(maxsize=16)
def _expected(spec: PolicySpec) -> dict[str, Any]:
    """Return shapes and dtypes of the arrays, but for what the method learned."""
    pairs = jax.ShapeDtypeStruct((NUM_PRIORS, spec.num_categories, spec.num_categories), jnp.float32)
    return {
        "policy": jax.eval_shape(functools.partial(init_params, spec), jax.random.key(0)),
        "layout": {"prior": pairs, "counts": pairs},
        "signs": {"odds": pairs, "chance": pairs},
    }
