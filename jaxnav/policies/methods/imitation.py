"""The cross-entropy to shortest paths, for guidance (`jaxnav.training.ppo.ppo_loss`) and for imitation stages.

With guidance, or with a stage that has `uses_expert`, the scene tables have `SceneTables.expert`, the first action of a
shortest path from every pose to every goal. `expert_actions` looks up these actions along a rollout, and
`imitation_loss` is the cross-entropy to them.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.numerics.device_means import masked_mean


def expert_actions(replay: Any) -> jax.Array:
    """Return the first action of a shortest path at every step of a rollout, int32 [T, B].

    Args:
      replay: a `jaxnav.training.ppo.Replay`, of a training with guidance or of a stage that uses an expert.
    """
    transitions = replay.transitions
    return replay.env_params.tables.expert[transitions.pose, transitions.goal].astype(jnp.int32)


def imitation_loss(logits: jax.Array, expert: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the cross-entropy to the actions of the expert.

    Args:
      logits: float32 [..., A].
      expert: int32 [...], actions of the expert; `NUM_ACTIONS`, which stands for no path to the goal, adds nothing to
        the loss.

    Returns:
      The loss float32 [], and by name the loss and the share of steps with an action of the expert at which it is the
      likeliest; 0 without such steps.
    """
    # The one-hot row of `NUM_ACTIONS` is zero.
    expert_one_hot = jax.nn.one_hot(expert, logits.shape[-1], dtype=jnp.float32)
    loss = -(expert_one_hot * jax.nn.log_softmax(logits)).sum(axis=-1).mean()
    has_expert = expert < logits.shape[-1]
    agreement = masked_mean((logits.argmax(axis=-1) == expert).astype(jnp.float32), has_expert)
    return loss, {"imitation_loss": loss, "imitation_agreement": agreement}
