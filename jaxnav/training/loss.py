"""Loss: advantages and the losses of recurrent PPO."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.causal import do
from jaxnav.env.types import EnvParams, Observation
from jaxnav.numerics.recurrence import gru, unroll
from jaxnav.policies.acting import select
from jaxnav.policies.methods import Method
from jaxnav.policies.pathways import NO_ACTION, Decision, Memory, Pathways, zero_experience
from jaxnav.policies.policy import Policy
from jaxnav.training.collect import Transition, zero_direct
from jaxnav.training.config import PPOScalars
from jaxnav.training.shares import average, moments

Parts = dict[str, jax.Array]


def advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    ended: jax.Array,
    gamma: jax.Array,
    lambda_: jax.Array,
    due: jax.Array | None = None,
) -> jax.Array:
    """Return generalised advantage estimates, float32 [T, B].

    Source: Schulman et al., 2016. Between two choices lambda is 1: the values there cancel, and what is left is the
    estimate over macro-steps of n actions each with their discounted rewards and the discount gamma^n.

    Args:
      reward: float32 [T, B].
      value: float32 [T, B], of the state before each step.
      next_value: float32 [T, B], value of the state after it within the same episode: 0 after a termination, that of
        the last state after a truncation.
      ended: bool [T, B], the episode ended with this step, either way.
      gamma: float32 [], discount.
      lambda_: float32 [].
      due: bool [T, B], whether the choice counted; None where every choice does. Elsewhere the estimate is of
        what is left of the macro-step.
    """
    delta = reward + gamma * next_value - value
    if due is not None:
        lambda_ = jnp.where(jnp.concatenate([due[1:], jnp.ones_like(due[:1])]), lambda_, 1.0)
    decay = gamma * lambda_ * (1.0 - ended.astype(jnp.float32))

    def back(advantage: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta, decay = inputs
        advantage = delta + decay * advantage
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)[1]


class Replay(NamedTuple):
    """Hold decisions made again, leaves [T, B, ...].

    Attributes:
      policy: with the parameters to differentiate by.
      transitions: of the rollout.
      pathways: before any is zeroed, and before the experience attends.
      decisions: the factual ones.
      counterfactual: with both direct pathways zeroed, but the same experience and (fixed) memory.
      params: the environment's.
    """

    policy: Policy
    transitions: Transition
    pathways: Pathways
    decisions: Decision
    counterfactual: Decision
    params: EnvParams


def replay(policy: Policy, transitions: Transition, memory: Memory, params: EnvParams) -> Replay:
    """Decide again along a rollout.

    Args:
      policy: the policy, with the parameters to differentiate by.
      transitions: [T, B].
      memory: at the start of the rollout, [B].
      params: the environment's; observations are gathered from its tables.
    """
    observation = Observation(row=params.tables.rows[transitions.pose], goal=transitions.goal)
    pathways = policy.encode(observation, transitions.weights, transitions.reading, transitions.surroundings)
    again = _step_by_step if policy.recurrent else _in_parallel
    return Replay(policy, transitions, pathways, *again(policy, pathways, transitions, memory), params)


def _in_parallel(
    policy: Policy, pathways: Pathways, transitions: Transition, memory: Memory
) -> tuple[Decision, Decision]:
    """Decide again where only the recurrent core needs the memory."""
    pathways = zero_experience(pathways, transitions.experienced)
    factual, counterfactual = zero_direct(pathways, transitions.direct), do(pathways, scene=0.0, goal=0.0)
    previous = jnp.where(transitions.ended, NO_ACTION, transitions.action)
    mediated = policy.mediated_input(pathways, jnp.concatenate([memory.action[None], previous[:-1]]))
    drive = policy.drive(policy.direct_input(factual) + mediated)
    run = unroll(policy.recurrent_kernel, drive, transitions.ended, memory.hidden)
    alone = gru(policy.drive(mediated), run.projected, run.before)
    return policy.act(run.after, factual), policy.act(alone, counterfactual)


def _step_by_step(
    policy: Policy, pathways: Pathways, transitions: Transition, memory: Memory
) -> tuple[Decision, Decision]:
    """Decide again where experience or adaptation need the memory."""
    fresh = policy.initial_memory(memory.action.shape)

    def step(memory: Memory, inputs: tuple[Pathways, Any, Any, jax.Array, jax.Array]) -> tuple[Memory, Any]:
        encoded, direct, experienced, action, ended = inputs
        memory = memory._replace(experienced=experienced)
        decision = policy.decide(zero_direct(policy.attend(encoded, memory), direct), memory)
        fixed = jax.lax.stop_gradient(memory)
        counterfactual = policy.decide(do(policy.attend(encoded, fixed), scene=0.0, goal=0.0), fixed)
        return select(ended, fresh, decision.memory(action)), (decision, counterfactual)

    inputs = pathways, transitions.direct, transitions.experienced, transitions.action, transitions.ended
    return jax.lax.scan(step, memory, inputs)[1]


def ppo_loss(
    replayed: Replay, advantage: jax.Array, scalars: PPOScalars, distil: bool, method: Method
) -> tuple[jax.Array, Parts]:
    """Return the clipped PPO loss over [T, B].

    Where `distil` holds, the counterfactual branch learns to act like the factual policy as well as experience and
    memory allow: KL(pi || counterfactual), the target fixed. The method's auxiliary loss is added. Choices that did not
    count weigh nothing; values are learned everywhere, for a rollout may end between two choices.

    Args:
      replayed: the decisions made again.
      advantage: float32 [T, B].
      scalars: weights and the clip.
      distil: whether the counterfactual branch is trained.
      method: may bring an auxiliary loss.

    Returns:
      The loss float32 [] and its parts by name.
    """
    transitions, decisions = replayed.transitions, replayed.decisions
    log_pi = jax.nn.log_softmax(decisions.logits)
    log_prob = jnp.take_along_axis(log_pi, transitions.choice[..., None], axis=-1)[..., 0]
    ratio = jnp.exp(log_prob - transitions.log_prob)
    target = advantage + transitions.value
    due = transitions.due
    mean, deviation = moments(advantage, due)
    scaled = (advantage - mean) / (deviation + 1e-8)
    clipped = jnp.clip(ratio, 1.0 - scalars.clip, 1.0 + scalars.clip)
    policy_loss = -average(jnp.minimum(ratio * scaled, clipped * scaled), due)
    value_loss = 0.5 * jnp.square(decisions.value - target).mean()
    entropy = -average((jnp.exp(log_pi) * log_pi).sum(axis=-1), due)
    loss = policy_loss + scalars.value * value_loss - scalars.entropy * entropy
    parts = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
    if distil:
        divergence = _distillation(log_pi, replayed.counterfactual.logits, due)
        loss = loss + scalars.distil * divergence
        parts["distil_loss"] = divergence
    if method.auxiliary is not None:
        auxiliary, named = method.auxiliary(replayed)
        loss, parts = loss + auxiliary, parts | named
    return loss, parts


def _distillation(log_pi: jax.Array, counterfactual: jax.Array, due: jax.Array | None) -> jax.Array:
    """Return the mean KL(pi || counterfactual), pi fixed."""
    fixed = jax.lax.stop_gradient(log_pi)
    return average((jnp.exp(fixed) * (fixed - jax.nn.log_softmax(counterfactual))).sum(axis=-1), due)
