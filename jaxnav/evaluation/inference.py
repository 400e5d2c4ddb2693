"""How a policy is used at inference: sTDE, what it is compared with, and its controls."""

import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.causal import do
from jaxnav.policies.pathways import Memory, Pathways
from jaxnav.policies.policy import Policy


class Branch(enum.IntEnum):
    """Where the logits that are taken out come from.

    The policy's counterfactual decision; zeros (nothing but a change of temperature); or normal noise, the
    same throughout an episode, with the standard deviation of the counterfactual logits.
    """

    COUNTERFACTUAL = 0
    ZEROS = 1
    NOISE = 2


class Inference(struct.PyTreeNode):
    """How one set of parameters is used; leaves [] (or [C] for a grid of C).

    The weight of the counterfactual logits is `always + relu(gap - epsilon)`: sTDE has always = 0, hard TDE always = 1
    and epsilon = inf, and no de-biasing always = 0 and epsilon = inf. The last three are controls.

    Attributes:
      params: int32, index of the parameters.
      epsilon: float32.
      always: float32.
      residual: bool, combine in the residual form rather than in the paper's.
      layout: bool, multiply the layout's weights in; otherwise they are ones.
      greedy: bool, take the best action rather than sample.
      uniform: bool, ignore the policy and act at random.
      intervention: float32, scene and goal are set to uniform random numbers below this; 0 in sTDE.
      shuffled: bool, take the weight of the next running episode of the list at the same time.
      branch: int32, the logits that are taken out: a `Branch`.
    """

    params: jax.Array
    epsilon: jax.Array
    always: jax.Array
    residual: jax.Array
    layout: jax.Array
    greedy: jax.Array
    uniform: jax.Array
    intervention: jax.Array
    shuffled: jax.Array
    branch: jax.Array


def counterfactual_logits(
    cell: Inference, policy: Policy, pathways: Pathways, memory: Memory, keys: jax.Array, step_keys: jax.Array
) -> jax.Array:
    """The logits to take out of E decisions, float32 [E, A].

    The counterfactual decision shares experience and memory with the factual one; its own memory is dropped.

    Args:
      cell: how to infer.
      policy: with the cell's parameters.
      pathways, memory: of the factual decisions, [E].
      keys, step_keys: [E], of the episodes, and of their present step; folded further.
    """

    def draw(keys: jax.Array, purpose: int, like: jax.Array, how: Callable[..., jax.Array]) -> jax.Array:
        own = jax.vmap(jax.random.fold_in, (0, None))(keys, purpose)
        return jax.vmap(lambda key: how(key, like.shape[1:]))(own)

    def value(purpose: int, field: jax.Array) -> jax.Array:
        return jax.lax.cond(
            cell.intervention > 0,
            lambda: cell.intervention * draw(step_keys, purpose, field, jax.random.uniform),
            lambda: jnp.zeros_like(field),
        )

    changed = do(pathways, scene=value(0, pathways.scene), goal=value(1, pathways.goal))
    logits = policy.decide(changed, memory).logits
    branches = (
        lambda: logits,
        lambda: jnp.zeros_like(logits),
        lambda: (
            logits.std(axis=-1, keepdims=True) * draw(keys, 2**30, logits, jax.random.normal)
        ),  # no time is that late
    )
    return jax.lax.switch(cell.branch, branches)
