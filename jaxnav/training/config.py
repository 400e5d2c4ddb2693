"""Settings of PPO, and the schedule of training stages.

`PPOConfig` holds what a user can set. `PPOScalars` is its traced part, whose values may change without a new
compilation. `stage_index_at` returns the stage of a method to which a part of training belongs.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnav.policies.method import Stage

#: Training of the branch that counterfactual decisions use: not at all (the paper's text), by zeroing both direct
#: pathways with probability 1/2 (the released code), or by matching the factual policy along the rollout.
CounterfactualTraining = Literal["none", "coin", "distil"]


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of recurrent PPO.

    Attributes:
      num_envs: parallel episodes of each seed.
      rollout: steps of each episode between two updates; at most the shortest step limit.
      epochs: passes over a rollout.
      minibatches: minibatches of a pass, split over episodes.
      learning_rate: initial learning rate of Adam; decays linearly to 0 within each stage of training.
      gamma: discount.
      gae_lambda: lambda of generalised advantage estimation.
      clip: clip range of the probability ratio.
      entropy: weight of the entropy bonus at the start of a stage.
      final_entropy: weight of the entropy bonus at the end of a stage; linear in between.
      value: weight of the value loss.
      max_grad_norm: global norm to which gradients are clipped.
      distil: weight of the distillation loss of the counterfactual branch.
      alone: with streams, share of the last stage without imitation in which only the direct stream acts and learns;
        the stage begins with it.
      experience: probability that an episode uses the stream of experience, in the rest of that stage.
      experience_drawn: draw this once per `episode`, or anew at each `step`.
      experience_rate: factor on the learning rate in the rest of that stage, because the added stream disturbs a policy
        that has already learned.
    """

    num_envs: int = 256
    rollout: int = 15
    epochs: int = 1
    minibatches: int = 8
    learning_rate: float = 4e-3
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.01
    final_entropy: float = 0.0
    value: float = 0.5
    max_grad_norm: float = 0.5
    distil: float = 0.5
    alone: float = 0.5
    experience: float = 0.8
    experience_drawn: Literal["episode", "step"] = "episode"
    experience_rate: float = 0.5

    def num_updates(self, total_steps: int) -> int:
        """Number of updates in `total_steps` environment steps of a seed, rounded up."""
        return -(-total_steps // (self.num_envs * self.rollout))

    def stage_scalars(
        self, stages: Sequence[Stage], stage_by_chunk: Sequence[int], chunk_size: int
    ) -> list["PPOScalars"]:
        """Traced settings of every training stage.

        Args:
          stages: stages of training, in order.
          stage_by_chunk: index of the stage of every chunk, in order.
          chunk_size: updates in a chunk.
        """
        scalars_by_stage = []
        for index, stage in enumerate(stages):
            first_update = chunk_size * stage_by_chunk.index(index)
            num_updates = chunk_size * stage_by_chunk.count(index)
            scalars_by_stage.append(self.scalars(num_updates, first_update, stage.lr_scale))
        return scalars_by_stage

    def scalars(self, num_updates: int, first_update: int = 0, lr_scale: float = 1.0) -> "PPOScalars":
        """Traced settings of one training stage.

        Args:
          num_updates: updates in the stage.
          first_update: updates before the stage.
          lr_scale: factor on the learning rate.
        """
        return PPOScalars(
            learning_rate=jnp.float32(self.learning_rate) * lr_scale,
            gamma=jnp.float32(self.gamma),
            gae_lambda=jnp.float32(self.gae_lambda),
            clip_range=jnp.float32(self.clip),
            entropy_weight=jnp.float32(self.entropy),
            final_entropy_weight=jnp.float32(self.final_entropy),
            value_weight=jnp.float32(self.value),
            distil_weight=jnp.float32(self.distil),
            experience_prob=jnp.float32(self.experience),
            first_update=jnp.float32(first_update),
            num_updates=jnp.float32(num_updates),
        )


class PPOScalars(struct.PyTreeNode):
    """Settings that may change without a new compilation, float32 [] each.

    All fields but the last two hold the setting of `PPOConfig` with the same first word.

    Attributes:
      first_update: updates before the stage.
      num_updates: updates in the stage.
    """

    learning_rate: jax.Array
    gamma: jax.Array
    gae_lambda: jax.Array
    clip_range: jax.Array
    entropy_weight: jax.Array
    final_entropy_weight: jax.Array
    value_weight: jax.Array
    distil_weight: jax.Array
    experience_prob: jax.Array
    first_update: jax.Array
    num_updates: jax.Array


def stage_index_at(stages: tuple[Stage, ...], progress: float) -> int:
    """Index of the stage that training is in.

    Args:
      stages: stages of a method, in order.
      progress: share of all updates that are done, in [0, 1).
    """
    stage_ends = np.cumsum([stage.share for stage in stages]) - 1e-9  # sums of shares are rounded
    return min(int(np.searchsorted(stage_ends, progress, side="right")), len(stages) - 1)
