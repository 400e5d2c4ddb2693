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
    trainable: Callable[[tuple[str, ...]], bool] | None = None,
) -> tuple[Params, Any]:
    """Take one step of the optimizer.

    Args:
      config: of the optimizer.
      weights: parameters.
      optimizer: its state.
      gradient: by the parameters.
      rate: float32 [], learning rate.
      trainable: whether the parameter at a path of names moves; None for all.

    Returns:
      Parameters and state after the step.
    """
    gradient = _restricted(gradient, trainable)
    with jax.numpy_dtype_promotion("standard"):  # optax counts in int32 beside float32
        step, optimizer = make_optimizer(config).update(gradient, optimizer, weights)
    step = _restricted(step, trainable)  # what was trained before still has momentum
    return jax.tree.map(lambda w, s: w - rate * s, weights, step), optimizer


def _restricted(tree: Any, trainable: Callable[[tuple[str, ...]], bool] | None) -> Any:
    """Zero the leaves that are not trained."""
    if trainable is None:
        return tree

    def keep(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        return leaf if trainable(tuple(str(entry.key) for entry in path)) else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(keep, tree)
