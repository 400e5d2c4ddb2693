"""The only scan over environment steps in training: parallel episodes with auto-reset."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.causal import do
from jaxnav.env.types import EnvParams
from jaxnav.policies.acting import Acting, Agent, select
from jaxnav.policies.pathways import Decision, Memory, Pathways
from jaxnav.policies.policy import Policy


class Transition(NamedTuple):
    """One step of B episodes; poses and goals stand for observations, which are gathered again when needed.

    Attributes:
      pose, goal: int32 [B].
      weights: float32 [B, K], the layout's weights for the goal.
      direct: bool [B], False where both direct pathways were zeroed; None if they never are.
      action: int32 [B].
      log_prob, value, reward: float32 [B].
      terminated, truncated, success: bool [B].
      length: int32 [B], actions of the episode so far.
    """

    pose: jax.Array
    goal: jax.Array
    weights: jax.Array
    direct: jax.Array | None
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array
    length: jax.Array


def zero_direct(pathways: Pathways, direct: jax.Array | None) -> Pathways:
    """Keep the direct pathways where `direct` bool [...] holds, zero them elsewhere; None keeps all."""
    if direct is None:
        return pathways
    scene, goal = (jnp.where(direct[..., None], field, 0.0) for field in (pathways.scene, pathways.goal))
    return do(pathways, scene=scene, goal=goal)


class Cut(NamedTuple):
    """The last state of an episode that hit its step limit, for the value that its return is bootstrapped with.

    At most one per episode slot and rollout, as a rollout is no longer than the shortest step limit.

    Attributes:
      agent: the episode as it was cut, its belief not yet updated with its last observation.
      time: int32 [B], step of the rollout at which it was cut; -1 where it was not.
    """

    agent: Agent
    time: jax.Array


def rollout(
    acting: Acting,
    policy: Policy,
    agent: Agent,
    key: jax.Array,
    length: int,
    coin: bool,
    params: EnvParams,
    priors: jax.Array,
) -> tuple[Agent, Transition, jax.Array]:
    """Act for some steps with sampled actions and same-step auto-reset.

    Args:
      acting: how to act.
      policy: the policy.
      agent: the episodes to go on with, [B].
      key: consumed.
      length: T, steps.
      coin: zero both direct pathways with probability 1/2 at every step.
      params: the environment's.
      priors: float32 [rooms, K, K], the layout prior of each room type.

    Returns:
      The episodes after the rollout, the transitions [T, B, ...], and float32 [T, B] the value of the state after each
      step that the return goes on with: 0 after Done, the value of the cut state at a step limit. The values of cut
      states and of the state after the rollout are decided with both direct pathways, also with the coin.
    """
    num_envs = agent.state.pose.shape[0]

    def decide(agent: Agent, direct: jax.Array | None = None) -> tuple[jax.Array, Decision]:
        observation, weights = acting.observe(agent, params)
        pathways = zero_direct(policy.pathways(observation, weights), direct)
        return weights, policy.decide(pathways, agent.memory)

    def step(carry: tuple[Agent, Cut], inputs: tuple[jax.Array, jax.Array]) -> tuple[tuple[Agent, Cut], Transition]:
        agent, cut = carry
        time, key = inputs
        coin_key, action_key, env_key = (jax.random.fold_in(key, purpose) for purpose in range(3))
        direct = jax.random.bernoulli(coin_key, 0.5, (num_envs,)) if coin else None
        weights, decision = decide(agent, direct)
        action = jax.random.categorical(action_key, decision.logits)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(decision.logits), action[:, None], axis=-1)[:, 0]

        keys = jax.random.split(env_key, num_envs)
        _, state, reward, terminated, truncated, info = jax.vmap(acting.env.step, (0, 0, 0, None))(
            keys, agent.state, action, params
        )
        transition = Transition(
            pose=agent.state.pose,
            goal=agent.state.goal,
            weights=weights,
            direct=direct,
            action=action,
            log_prob=log_prob,
            value=decision.value,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            success=info["success"],
            length=info["length"],
        )
        memory = Memory(hidden=decision.hidden, action=action)
        last = Agent(state=info["final_state"], layout=agent.layout, memory=memory)
        cut = select(truncated, Cut(agent=last, time=jnp.broadcast_to(time, (num_envs,))), cut)
        ended = terminated | truncated
        fresh = (acting.first_belief(state, params, priors), policy.initial_memory((num_envs,)))
        layout, memory = select(ended, fresh, (agent.layout, memory))
        layout = acting.believe(layout, state, params, priors)
        return (Agent(state=state, layout=layout, memory=memory), cut), transition

    nothing = Cut(agent=agent, time=jnp.full((num_envs,), -1))
    inputs = (jnp.arange(length), jax.random.split(key, length))
    (agent, cut), transitions = jax.lax.scan(step, (agent, nothing), inputs)

    layout = acting.believe(cut.agent.layout, cut.agent.state, params, priors)
    _, after_cut = decide(cut.agent._replace(layout=layout))
    _, after_last = decide(agent)
    following = jnp.concatenate([transitions.value[1:], after_last.value[None]])
    at_cut = jnp.arange(length)[:, None] == cut.time[None, :]
    following = jnp.where(at_cut, after_cut.value[None, :], following)
    return agent, transitions, jnp.where(transitions.terminated, 0.0, following)
