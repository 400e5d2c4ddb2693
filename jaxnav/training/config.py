"""Settings of PPO, and the schedule of training stages.

`PPOConfig` holds the options of PPO, and `stage_index_at` finds the training stage at a given progress. Commands show
these options in their help, so importing this module must not import JAX.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from jaxnav.policies.method import Stage
    from jaxnav.training.ppo import PPOScalars

#: Training of the branch that counterfactual decisions use: not at all (the paper's text), by zeroing both direct
#: pathways with probability 1/2 (the released code), or by matching the factual policy along the rollout.
CounterfactualTraining = Literal["none", "coin", "distil"]


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of recurrent PPO, the training algorithm.

    Attributes:
      num_envs: number of episodes that each policy plays in parallel, at least 1.
      rollout: number of steps in each of these episodes between two updates, at least 1 and at most the shortest step
        limit of training. The gradient goes back in time over these steps.
      epochs: number of passes over a rollout in one update, at least 1.
      minibatches: number of minibatches in one pass, at least 1. Episodes are divided among them, so `num_envs` must be
        a multiple.
      learning_rate: initial learning rate of Adam, above 0. The rate decays linearly to 0 within each training stage.
      gamma: discount of future rewards, from 0 to 1.
      gae_lambda: lambda of generalised advantage estimation, from 0 to 1.
      clip: clip range of the probability ratio, above 0.
      entropy: weight of the entropy bonus at the start of a training stage, at least 0.
      final_entropy: weight of the entropy bonus at the end of a training stage, at least 0; linear in between.
      value: weight of the value loss, at least 0.
      guidance: weight of the guidance at the start of a training stage, at least 0. Guidance is a further term of the
        loss: the cross-entropy to the next action of a shortest path, at every step of the policy's own episodes. Only
        training needs the shortest paths. The default depends on the world, and is 0 for methods that do not choose
        actions.
      final_guidance: weight of the guidance at the end of a training stage, at least 0; linear in between. By default,
        the weight does not change.
      max_grad_norm: global norm to which gradients are clipped, above 0.
      distil: weight of the loss with which `--counterfactual distil` trains the counterfactual logits, at least 0.
      alone: only with `--decision streams`: share of the training in which the direct stream (the network without
        experience) acts and learns alone, before the experience stream is added, from 0 to below 1. Imitation does not
        count.
      experience: probability, above 0, that a training episode has experience; in all other episodes the policy acts
        and learns without experience. With `--decision fused`, at most 1, and the default is 1. Below 1, the policy
        also learns to act without experience, which `jaxnav eval --removal cde` needs. With `--decision streams`, below
        1, and the default is 0.8: the probability that the experience stream takes part once it has been added (after
        the share `ppo.alone`).
      experience_drawn: draw whether there is experience (see `ppo.experience`) once per `episode` or at each `step`.
      experience_rate: only with `--decision streams`: factor on the learning rate once the experience stream has been
        added (after the share `ppo.alone`), above 0. The added stream disturbs a policy that has already learned, so
        the usual factor is below 1.
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
    guidance: float | None = None
    final_guidance: float | None = None
    max_grad_norm: float = 0.5
    distil: float = 0.5
    alone: float = 0.5
    experience: float | None = None
    experience_drawn: Literal["episode", "step"] = "episode"
    experience_rate: float = 0.5

    @property
    def has_guidance(self) -> bool:
        """True if the loss has a term of shortest paths."""
        return bool(self.guidance or self.final_guidance)

    @property
    def experience_prob(self) -> float:
        """Probability that a training episode has experience; 1 unless `experience` is set (see `check_config`)."""
        return 1.0 if self.experience is None else self.experience

    def num_updates(self, total_steps: int) -> int:
        """Number of updates in `total_steps` environment steps of a seed, rounded up."""
        return -(-total_steps // (self.num_envs * self.rollout))

    def stage_scalars(
        self, stages: Sequence["Stage"], stage_by_chunk: Sequence[int], chunk_size: int
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
        import jax.numpy as jnp

        from jaxnav.training.ppo import PPOScalars

        # Without guidance, the tables have no shortest paths, and the loss has no such term.
        guidance_weight, final_guidance_weight = None, None
        if self.has_guidance:
            guidance_weight = jnp.float32(self.guidance or 0.0)
            final_guidance_weight = guidance_weight
            if self.final_guidance is not None:
                final_guidance_weight = jnp.float32(self.final_guidance)
        return PPOScalars(
            learning_rate=jnp.float32(self.learning_rate) * lr_scale,
            gamma=jnp.float32(self.gamma),
            gae_lambda=jnp.float32(self.gae_lambda),
            clip_range=jnp.float32(self.clip),
            entropy_weight=jnp.float32(self.entropy),
            final_entropy_weight=jnp.float32(self.final_entropy),
            value_weight=jnp.float32(self.value),
            distil_weight=jnp.float32(self.distil),
            guidance_weight=guidance_weight,
            final_guidance_weight=final_guidance_weight,
            experience_prob=jnp.float32(self.experience_prob),
            first_update=jnp.float32(first_update),
            num_updates=jnp.float32(num_updates),
        )


def stage_index_at(stages: tuple["Stage", ...], progress: float) -> int:
    """Index of the stage that training is in.

    Args:
      stages: stages of a method, in order.
      progress: share of all updates that are done, in [0, 1).
    """
    stage_ends = np.cumsum([stage.share for stage in stages]) - 1e-9  # sums of shares are rounded
    return min(int(np.searchsorted(stage_ends, progress, side="right")), len(stages) - 1)
