"""Apply: one step of the optimizer."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxnav.policies.policy import Params
from jaxnav.training.config import PPOConfig


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam behind a clip by the global norm.

    A step whose gradient is not finite is skipped and counted.
    """
    chain = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    return optax.apply_if_finite(chain, max_consecutive_errors=2**30)


def renewed(config: PPOConfig, optimizer: Any, weights: Params, when: jax.Array) -> Any:
    """Start an optimizer anew where a stage begins, bool [].

    Adam takes too large steps for parameters that begin to learn late: it believes their moments to be as old as the
    others'. What it counts of skipped steps goes on.
    """
    fresh: Any = make_optimizer(config).init(weights)
    inner = jax.tree.map(lambda new, old: jnp.where(when, new, old), fresh.inner_state, optimizer.inner_state)
    return optimizer._replace(inner_state=inner)


def apply_gradient(
    config: PPOConfig,
    weights: Params,
    optimizer: Any,
    gradient: Params,
    rate: jax.Array,
    rates: Callable[[tuple[str, ...]], float] | None = None,
) -> tuple[Params, Any]:
    """Take one step of the optimizer.

    Args:
      config: of the optimizer.
      weights: parameters.
      optimizer: its state.
      gradient: by the parameters.
      rate: float32 [], learning rate.
      rates: factor on `rate` of the parameter at a path of names, 0 for one that does not move; None for 1.

    Returns:
      Parameters and state after the step.
    """
    gradient = _scaled(gradient, rates and (lambda path: rates(path) > 0))
    with jax.numpy_dtype_promotion("standard"):  # optax counts in int32 beside float32
        step, optimizer = make_optimizer(config).update(gradient, optimizer, weights)
    step = _scaled(step, rates)  # what was trained before still has momentum
    return jax.tree.map(lambda w, s: w - rate * s, weights, step), optimizer


def _scaled(tree: Any, factors: Callable[[tuple[str, ...]], float] | None) -> Any:
    """Multiply the leaves by factors of their paths.

    A factor of 0 gives zeros, whatever the leaf.
    """
    if factors is None:
        return tree

    def scale(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        factor = float(factors(tuple(str(entry.key) for entry in path)))
        return factor * leaf if factor else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(scale, tree)
