"""A policy's step as a program: exported with `jax.export`, run without this package."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.export
import jax.numpy as jnp

from jaxnav.env.types import Observation
from jaxnav.errors import InputError
from jaxnav.runs.policy import EpisodeMemory, LoadedPolicy
from jaxnav.scenes.tables.observation_row import RowFormat

#: What programs are compiled for.
PLATFORMS = ("cpu", "cuda", "tpu")
#: A memory as named arrays.
Named = Mapping[str, jax.Array]


def step(policy: LoadedPolicy, inputs: Mapping[str, Any], epsilon: jax.Array) -> dict[str, Any]:
    """Take one step of one episode, with named arrays.

    Args:
      policy: that acts.
      inputs: arrays as of `input_shapes`, without the leading axis.
      epsilon: float32 [], threshold of sTDE.

    Returns:
      `action` int32 [], the best one; `logits` and `factual` float32 [C]; where the policy uses the layout
      `counterfactual` float32 [C], `gap` float32 [] and `weights` float32 [K], w x g of eq. 7; `memory`.
    """
    row_format = RowFormat(policy.spec.num_categories)
    observation = Observation(row_format.pack(inputs["detections"], inputs["view"]), inputs["goal"])
    began = policy.begin(inputs["room"])
    earlier = _unnamed(inputs["memory"], began)
    earlier = earlier._replace(memory=earlier.memory._replace(action=inputs["action"]), room=inputs["room"])
    memory = jax.tree.map(functools.partial(jnp.where, inputs["first"]), began, earlier)
    odometry = {"heading": inputs["heading"], "moved": inputs["moved"] & ~inputs["first"], "horizon": inputs["horizon"]}
    made = policy.decide(observation, memory, epsilon, **odometry)
    action, memory = policy.follow(made, jnp.argmax(made.logits).astype(jnp.int32), memory.room)
    found = {"action": action, "logits": made.logits, "factual": made.factual, "memory": _named(memory)}
    if made.counterfactual is not None:
        found |= {"counterfactual": made.counterfactual, "gap": made.gap, "weights": made.weights}
    return found


def input_shapes(policy: LoadedPolicy, batch: Any) -> dict[str, Any]:
    """Return the shapes and dtypes of a step's inputs.

    Args:
      policy: that acts.
      batch: number of episodes B, may be symbolic.

    Returns:
      detections: uint8 [B, K, 4], confidence, ahead, right and apparent size; see `RowFormat`.
      view: uint8 [B, V, V], 0 unknown, 1 free, 2 blocked; row 0 is nearest to the agent, column 0 leftmost.
      goal: int32 [B], index of a category.
      action: int32 [B], the action that was taken last.
      heading: int32 [B], clockwise.
      moved: bool [B], whether the last action changed the cell.
      horizon: int32 [B], index of the camera's.
      room: int32 [B], index of the room type's prior.
      first: bool [B], whether an episode begins: `action`, `moved` and `memory` are not read.
      memory: what the step before returned, by name.
    """
    row_format = RowFormat(policy.spec.num_categories)
    memory = jax.eval_shape(policy.begin, jax.ShapeDtypeStruct((), jnp.int32))
    number, flag = jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), jnp.bool_)
    shapes = {
        "detections": jax.ShapeDtypeStruct((row_format.num_categories, 4), jnp.uint8),
        "view": jax.ShapeDtypeStruct((row_format.view, row_format.view), jnp.uint8),
        **dict.fromkeys(("goal", "action", "heading", "horizon", "room"), number),
        **dict.fromkeys(("moved", "first"), flag),
        "memory": _named(memory),
    }
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((batch, *leaf.shape), leaf.dtype), shapes)


def program(policy: LoadedPolicy) -> bytes:
    """Export `step`, for any number of episodes side by side.

    `jax.export.deserialize(program).call(inputs, epsilon)` runs it where JAX and flatbuffers are installed.

    Raises:
      InputError: flatbuffers, which writes the program, is missing.
    """
    (batch,) = jax.export.symbolic_shape("episodes")

    def steps(inputs: Mapping[str, Any], epsilon: jax.Array) -> dict[str, Any]:
        return jax.vmap(functools.partial(step, policy), (0, None))(inputs, epsilon)

    shapes = input_shapes(policy, batch), jax.ShapeDtypeStruct((), jnp.float32)
    exported = jax.export.export(jax.jit(steps), platforms=PLATFORMS)(*shapes)
    try:
        return bytes(exported.serialize())
    except ImportError as error:
        raise InputError("stablehlo: needs flatbuffers; install it by: pip install 'jaxnav[export]'") from error


def _named(memory: EpisodeMemory) -> dict[str, Any]:
    """Return the arrays of a memory by name."""
    leaves, _ = jax.tree.flatten_with_path(memory)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _unnamed(named: Named, like: EpisodeMemory) -> EpisodeMemory:
    """Return the memory of named arrays, in the structure of another."""
    return jax.tree.unflatten(jax.tree.structure(like), [named[name] for name in _named(like)])
