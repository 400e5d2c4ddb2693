"""What can be set about learning."""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.policies.methods import Stage


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Configure recurrent PPO.

    Attributes:
      num_envs: parallel episodes of each seed.
      rollout: steps of every episode between two updates; at most the shortest step limit.
      epochs: passes over a rollout.
      minibatches: parts of a pass, split over episodes.
      learning_rate: of Adam at the start; falls linearly to 0, in each stage of training anew.
      gamma: discount.
      gae_lambda: of generalised advantage estimation.
      clip: of the probability ratio.
      entropy: weight of the entropy bonus at the start,
      final_entropy: at the end; linear in between.
      value: weight of the value loss.
      max_grad_norm: global norm to which gradients are clipped.
      distil: weight of the counterfactual branch's loss where it is distilled.
      alone: share of the updates of the last stage that does not imitate, the first of them, in which the direct stream
        acts and learns alone, where there are streams.
      experience: probability that an episode after that has the stream of experience.
      experience_drawn: whether that is drawn once in an episode or at every step anew.
      experience_rate: factor on the learning rate after that, for what is added disturbs a policy that has learned.
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
        """Return the updates that environment steps of a seed take.

        They are rounded up.
        """
        return -(-total_steps // (self.num_envs * self.rollout))

    def scalars(self, num_updates: int, begin: int = 0, rate: float = 1.0) -> "PPOScalars":
        """Return the traced part, for a stage of so many updates.

        `rate` is a factor on the learning rate.
        """
        names = PPOScalars.__dataclass_fields__.keys() - {"begin", "num_updates"}
        settings = {name: jnp.float32(getattr(self, name)) for name in names}
        settings["learning_rate"] *= rate
        return PPOScalars(**settings, begin=jnp.float32(begin), num_updates=jnp.float32(num_updates))


class PPOScalars(struct.PyTreeNode):
    """Hold the settings that may change without compiling anew.

    float32 [] each, see `PPOConfig`; `begin` are the updates before the stage, `num_updates` those in it.
    """

    learning_rate: jax.Array
    gamma: jax.Array
    gae_lambda: jax.Array
    clip: jax.Array
    entropy: jax.Array
    final_entropy: jax.Array
    value: jax.Array
    distil: jax.Array
    experience: jax.Array
    begin: jax.Array
    num_updates: jax.Array


#: How the branch that a counterfactual decision uses is trained: not at all (the paper's text), by zeroing both direct
#: pathways with a fair coin (the released code), or by matching the factual policy beside the rollout.
Counterfactual = Literal["none", "coin", "distil"]


def stage_at(stages: tuple[Stage, ...], share: float) -> int:
    """Return the stage after a share of all updates.

    Args:
      stages: of a method, in order.
      share: of the updates that are done, in [0, 1).
    """
    end = 0.0
    for number, stage in enumerate(stages):
        end += stage.share
        if share < end - 1e-9:
            return number
    return len(stages) - 1
