"""Imitation of shortest paths, for stages of training."""

from typing import Any

import jax
import jax.numpy as jnp


def expert_actions(replayed: Any) -> jax.Array:
    """Return what a shortest path does along a rollout, int32 [T, B].

    Args:
      replayed: a `jaxnav.training.loss.Replay`, in a stage that imitates.
    """
    transitions = replayed.transitions
    return replayed.params.tables.expert[transitions.pose, transitions.goal].astype(jnp.int32)


def imitation_loss(logits: jax.Array, expert: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the cross-entropy to the expert's actions.

    Args:
      logits: float32 [..., A].
      expert: int32 [...]; steps with `NUM_ACTIONS`, from where there is no way, count as no loss.

    Returns:
      The loss float32 [], and by name the loss and the share of steps at which the likeliest action is the expert's.
    """
    one_hot = jax.nn.one_hot(expert, logits.shape[-1], dtype=jnp.float32)
    loss = -(one_hot * jax.nn.log_softmax(logits)).sum(axis=-1).mean()
    agreement = (logits.argmax(axis=-1) == expert).astype(jnp.float32).mean()
    return loss, {"imitation_loss": loss, "imitation_agreement": agreement}
