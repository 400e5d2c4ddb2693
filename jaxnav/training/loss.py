"""Advantages and losses of recurrent PPO; no loop over updates, no optimiser."""

import jax
import jax.numpy as jnp

from jaxnav.env.types import EnvParams, Observation
from jaxnav.numerics.recurrence import gru, unroll
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory
from jaxnav.policies.policy import Policy
from jaxnav.training.collect import Transition, zero_direct
from jaxnav.training.config import PPOScalars


def advantages(
    reward: jax.Array, value: jax.Array, following: jax.Array, ended: jax.Array, gamma: jax.Array, lambda_: jax.Array
) -> jax.Array:
    """Generalised advantage estimates (Schulman et al., 2016), float32 [T, B].

    Args:
      reward: float32 [T, B].
      value: float32 [T, B], of the state before each step.
      following: float32 [T, B], value of the state after it within the same episode: 0 after a termination, that of
        the cut state after a truncation.
      ended: bool [T, B], the episode ended with this step, either way.
      gamma: float32 [], discount.
      lambda_: float32 [].
    """
    delta = reward + gamma * following - value
    decay = gamma * lambda_ * (1.0 - ended.astype(jnp.float32))

    def back(advantage: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta, decay = inputs
        advantage = delta + decay * advantage
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)[1]


def replay(policy: Policy, transitions: Transition, memory: Memory, params: EnvParams) -> tuple[Decision, Decision]:
    """Decide again along a rollout.

    Args:
      policy: the policy, with the parameters to differentiate by.
      transitions: [T, B].
      memory: at the start of the rollout, [B].
      params: the environment's; observations are gathered from its tables.

    Returns:
      The decisions [T, B] and, with both direct pathways zeroed but the same experience and (fixed) memory, the
      counterfactual ones.
    """
    observation = Observation(row=params.tables.rows[transitions.pose], goal=transitions.goal)
    pathways = policy.pathways(observation, transitions.weights)
    ended = transitions.terminated | transitions.truncated
    following = jnp.where(ended, NO_ACTION, transitions.action)
    mediated = policy.mediated_input(pathways, jnp.concatenate([memory.action[None], following[:-1]]))
    direct = policy.direct_input(zero_direct(pathways, transitions.direct))
    run = unroll(policy.recurrent_kernel, policy.drive(direct + mediated), ended, memory.hidden)
    alone = gru(policy.drive(mediated), run.projected, run.before)
    return policy.act(run.after, pathways.gate), policy.act(alone, pathways.gate)


def ppo_loss(
    policy: Policy,
    transitions: Transition,
    memory: Memory,
    advantage: jax.Array,
    params: EnvParams,
    scalars: PPOScalars,
    distil: bool,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped PPO loss over [T, B], and where `distil` holds the counterfactual branch's.

    The latter teaches the branch without its direct pathways to act like the factual policy as well as experience and
    memory allow: KL(pi || counterfactual), the target fixed.

    Returns:
      The loss float32 [] and its parts by name.
    """
    decisions, counterfactual = replay(policy, transitions, memory, params)
    log_pi = jax.nn.log_softmax(decisions.logits)
    log_prob = jnp.take_along_axis(log_pi, transitions.action[..., None], axis=-1)[..., 0]
    ratio = jnp.exp(log_prob - transitions.log_prob)
    target = advantage + transitions.value
    scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    clipped = jnp.clip(ratio, 1.0 - scalars.clip, 1.0 + scalars.clip)
    policy_loss = -jnp.minimum(ratio * scaled, clipped * scaled).mean()
    value_loss = 0.5 * jnp.square(decisions.value - target).mean()
    entropy = -(jnp.exp(log_pi) * log_pi).sum(axis=-1).mean()
    loss = policy_loss + scalars.value * value_loss - scalars.entropy * entropy
    parts = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
    if distil:
        fixed = jax.lax.stop_gradient(log_pi)
        divergence = (jnp.exp(fixed) * (fixed - jax.nn.log_softmax(counterfactual.logits))).sum(axis=-1).mean()
        loss = loss + scalars.distil * divergence
        parts["distil_loss"] = divergence
    return loss, parts
