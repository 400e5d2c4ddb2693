"""Collect: the only scan over environment steps in training."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.causal import do
from jaxnav.env.types import EnvParams
from jaxnav.policies.acting import Acting, Agent, carried, select
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.pathways import Decision, Memory, Pathways
from jaxnav.policies.perception import View
from jaxnav.policies.policy import Policy


class Transition(NamedTuple):
    """Hold one step of B episodes.

    Poses and goals stand for observations, which are gathered again when needed.

    Attributes:
      pose, goal: int32 [B].
      weights: float32 [B, K], the layout's weights for the goal.
      reading: what the method's tracker read, leaves [B, ...]; None without one.
      surroundings: uint8 [B, M], what the spatial memory read; None without one.
      direct: bool [B], False where both direct pathways were zeroed; None if they never are.
      experienced: float32 [B], 0 where experience was zeroed, otherwise 1; None if it never is.
      due: bool [B], whether the choice counted; None where every choice does.
      choice: int32 [B], what the policy chose.
      action: int32 [B], what was done.
      log_prob, value, reward: float32 [B].
      terminated, truncated, success: bool [B].
      length: int32 [B], actions of the episode so far.
    """

    pose: jax.Array
    goal: jax.Array
    weights: jax.Array
    reading: Any
    surroundings: jax.Array | None
    direct: jax.Array | None
    experienced: jax.Array | None
    due: jax.Array | None
    choice: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array
    length: jax.Array

    @property
    def ended(self) -> jax.Array:
        """Return which episodes ended with the step, bool [B]."""
        return self.terminated | self.truncated


class Rollout(NamedTuple):
    """Hold what was collected.

    Attributes:
      transitions: leaves [T, B, ...].
      memory: at the start, leaves [B, ...].
      next_value: float32 [T, B], value of the state after each step that the return goes on with: 0 after Done, the
        value of the last state at a step limit.
    """

    transitions: Transition
    memory: Memory
    next_value: jax.Array


class Truncation(NamedTuple):
    """Hold the last state of a truncated episode.

    At most one per slot and rollout, as a rollout is no longer than the shortest step limit.

    Attributes:
      agent: the last view not yet taken in.
      moved: bool [B], whether the last action changed the cell.
      time: int32 [B], step of the rollout; -1 where no episode was truncated.
    """

    agent: Agent
    moved: jax.Array
    time: jax.Array


def zero_direct(pathways: Pathways, direct: jax.Array | None) -> Pathways:
    """Zero the direct pathways where `direct` is False.

    Args:
      pathways: leaves [..., ...].
      direct: bool [...]; None keeps all.
    """
    if direct is None:
        return pathways
    scene, goal = (jnp.where(direct[..., None], field, 0.0) for field in (pathways.scene, pathways.goal))
    return do(pathways, scene=scene, goal=goal)


def draw_coins(memory: Memory, begins: jax.Array | bool, key: jax.Array, share: jax.Array | float) -> Memory:
    """Draw which episodes have the stream of experience.

    Args:
      memory: leaves [B, ...]; without such a stream it stays as it is.
      begins: bool [B] or [], episodes to draw for.
      key: consumed.
      share: probability of experience.
    """
    if memory.experienced is None:
        return memory
    coins = jax.random.bernoulli(key, share, memory.experienced.shape).astype(jnp.float32)
    return memory._replace(experienced=jnp.where(begins, coins, memory.experienced))


def collect(
    acting: Acting,
    policy: Policy,
    agent: Agent,
    key: jax.Array,
    length: int,
    coin: bool,
    params: EnvParams,
    knowledge: Knowledge,
    experience: jax.Array | float = 1.0,
    every_step: bool = False,
) -> tuple[Agent, Rollout]:
    """Act for some steps with sampled actions and same-step auto-reset.

    Args:
      acting: how to act.
      policy: the policy.
      agent: the episodes to go on with, [B].
      key: consumed.
      length: T, steps.
      coin: zero both direct pathways with probability 1/2 at every step.
      params: the environment's.
      knowledge: what was learned before training.
      experience: probability that an episode which begins has the stream of experience.
      every_step: draw that at every step, not only where an episode begins.

    Returns:
      The episodes after the rollout, and the rollout. The values of truncated states and of the state after the
      rollout are decided with both direct pathways, also with the coin.
    """
    num_envs = agent.state.pose.shape[0]

    def decide(agent: Agent, direct: jax.Array | None = None) -> tuple[View, Decision]:
        view = acting.view(agent, knowledge, params)
        pathways = zero_direct(policy.pathways(*view, carried(agent)), direct)
        return view, policy.decide(pathways, carried(agent))

    def step(carry: tuple[Agent, Truncation], inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Transition]:
        agent, truncation = carry
        time, key = inputs
        coin_key, action_key, env_key, experience_key = (jax.random.fold_in(key, purpose) for purpose in range(4))
        direct = jax.random.bernoulli(coin_key, 0.5, (num_envs,)) if coin else None
        view, decision = decide(agent, direct)
        choice = jax.random.categorical(action_key, decision.logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(decision.logits), choice[:, None], axis=-1)[:, 0]
        keys = jax.random.split(env_key, num_envs)
        after, taken = acting.step(agent, choice, knowledge, params, policy=policy, decision=decision, keys=keys)
        after = after._replace(memory=draw_coins(carried(after), every_step | taken.ended, experience_key, experience))
        transition = Transition(
            pose=agent.state.pose,
            goal=agent.state.goal,
            weights=view.weights,
            reading=view.reading,
            surroundings=view.surroundings,
            direct=direct,
            experienced=decision.experienced,
            due=acting.due(agent),
            choice=choice,
            action=carried(taken.agent).action,
            log_prob=log_prob,
            value=decision.value,
            reward=taken.reward,
            terminated=taken.terminated,
            truncated=taken.truncated,
            success=taken.success,
            length=taken.agent.state.time,
        )
        latest = Truncation(taken.agent, taken.moved, jnp.broadcast_to(time, (num_envs,)))
        return (after, select(taken.truncated, latest, truncation)), transition

    nothing = Truncation(agent, jnp.zeros(num_envs, bool), jnp.full((num_envs,), -1))
    memory, inputs = carried(agent), (jnp.arange(length), jax.random.split(key, length))
    (agent, truncation), transitions = jax.lax.scan(step, (agent, nothing), inputs)

    last = truncation.agent
    last = acting.perceive(last, carried(last).action, truncation.moved, knowledge, params)
    values = decide(last)[1].value, decide(agent)[1].value
    return agent, Rollout(transitions, memory, _next_values(transitions, truncation.time, *values))


def _next_values(
    transitions: Transition, truncated_at: jax.Array, after_truncation: jax.Array, after_rollout: jax.Array
) -> jax.Array:
    """Return the next values of every step, float32 [T, B].

    Args:
      transitions: leaves [T, B].
      truncated_at: int32 [B], step of a truncation; -1 without one.
      after_truncation, after_rollout: float32 [B], values of the states there.
    """
    next_value = jnp.concatenate([transitions.value[1:], after_rollout[None]])
    at_truncation = jnp.arange(len(next_value))[:, None] == truncated_at[None, :]
    next_value = jnp.where(at_truncation, after_truncation[None, :], next_value)
    return jnp.where(transitions.terminated, 0.0, next_value)
