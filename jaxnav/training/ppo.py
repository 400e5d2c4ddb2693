"""Recurrent PPO on one page: collect a rollout, estimate advantages, compute the loss, update.

`Learner.train` is the function to jit: a `lax.scan` over `Learner.update`. One update is

    rollout = collect_rollout(...)                    # T steps in B environments, same-step auto-reset
    advantages = compute_advantages(...)              # once per update
    for epoch in epochs:
        for minibatch in split_minibatches(...):      # whole trajectories of T steps in B / M environments
            replay = replay_rollout(...)              # current parameters on the stored inputs
            gradient = grad(ppo_loss(replay, ...))
            apply_gradient(...)

Replay starts from the stored memory (`PolicyState`: recurrent state, previous action, ...) of the rollout's first step,
and unrolls it again under the current parameters. There is no value clipping.

Extensions of plain PPO:

* *Pathways*: the action depends on three inputs: scene and goal (the *direct* pathways), and the method's *experience*
  features (the mediator; *experience* never means collected transitions here). The *counterfactual branch* is the same
  network with both direct pathways zero, at the same memory or at a memory of its own, to which they have been zero
  since the start of the episode. `CounterfactualTraining` says how this branch is trained: not at all, by zeroing the
  direct pathways at random while acting (a coin), or by distillation.
* *Experience dropout*: policies may act without experience, for whole episodes or single steps.
* *Guidance*: a cross-entropy to the next action of a shortest path, along the policy's own rollouts.
* *Macro-actions*: a choice of the policy may last for several actions. Choices sampled meanwhile are ignored
  (`is_decision_step` is False): they do not enter the policy loss, and advantages are those of macro-steps.
* *Stages*: each stage has its own loss, frozen parameters and schedules, and begins with a fresh Adam. Episodes
  continue across a stage boundary.
* *Fast weights* are changes of layers that a method adapts within an episode.
* *Devices* may share the environments of a minibatch; gradients are then averaged over the devices.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec

from jaxnav.causal import do
from jaxnav.env.objectnav import EnvParams, Observation
from jaxnav.numerics.device_means import ENV_AXIS, masked_mean, mean_and_std, mean_over_devices
from jaxnav.numerics.recurrence import UnrolledGRU, gru_step, unroll_gru
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.agent_loop import Agent, AgentLoop, decide_counterfactually, embed_and_decide, policy_memory
from jaxnav.policies.method import Knowledge, Method, Stage
from jaxnav.policies.methods.imitation import expert_actions, imitation_loss
from jaxnav.policies.network import Params, Policy, init_params
from jaxnav.policies.pathways import (
    NO_ACTION,
    Decision,
    EncodedPathways,
    PolicyInputs,
    PolicyState,
    mask_direct_pathways,
    mask_experience,
)
from jaxnav.training.config import CounterfactualTraining, PPOConfig

Metrics = dict[str, jax.Array]
#: Metrics that are means over the episodes that ended.
EPISODE_MEANS = ("success", "return", "length", "truncated")
#: Parameters and optimizer state.
TrainCarry = tuple[Params, Any]

# Tags of the keys that are folded from a seed's key, from an update's key, and from a step's key.
_INIT, _START, _UPDATES = range(3)
_ROLLOUT, _SHUFFLE, _RESTART = range(3)
_DIRECT_MASK, _ACTION, _ENV, _EXPERIENCE_DROPOUT = range(4)
#: Tag for drawing experience dropout when all episodes are started. `AgentLoop.start` splits the same key, and
#: `split(key, B)[i]` equals `fold_in(key, i)`, so this tag must exceed every environment index.
_START_DROPOUT = 2**31 - 1


class PPOScalars(struct.PyTreeNode):
    """Settings that may change without a new compilation, float32 [] each.

    Attributes:
      learning_rate: `PPOConfig.learning_rate` times the factor of the stage.
      gamma, gae_lambda: settings of `PPOConfig` of these names.
      clip_range: `PPOConfig.clip`.
      entropy_weight, final_entropy_weight: `PPOConfig.entropy` and `final_entropy`.
      value_weight: `PPOConfig.value`.
      distil_weight: `PPOConfig.distil`.
      guidance_weight, final_guidance_weight: `PPOConfig.guidance` and `final_guidance`; None without guidance.
      experience_prob: `PPOConfig.experience`.
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
    guidance_weight: jax.Array | None
    final_guidance_weight: jax.Array | None
    experience_prob: jax.Array
    first_update: jax.Array
    num_updates: jax.Array

    def at_update(self, update: jax.Array) -> "PPOScalars":
        """Settings of one update; those with a schedule have the value of this update.

        Schedules are linear within the stage: the learning rate falls to 0, entropy and guidance go to their final
        weights. One call of `Learner.train` may run fewer updates than the stage has.

        Args:
          update: int32 [], updates since the start of training.
        """
        progress = (update.astype(jnp.float32) - self.first_update) / self.num_updates
        entropy_change = self.final_entropy_weight - self.entropy_weight
        scheduled = self.replace(
            learning_rate=self.learning_rate * (1.0 - progress),
            entropy_weight=self.entropy_weight + progress * entropy_change,
        )
        if self.guidance_weight is None or self.final_guidance_weight is None:
            return scheduled
        guidance_change = self.final_guidance_weight - self.guidance_weight
        return scheduled.replace(guidance_weight=self.guidance_weight + progress * guidance_change)


# 1. Collect


class Transition(NamedTuple):
    """One step of B environments.

    Stores poses and goals instead of observations; `replay_rollout` gathers the observations from the scene tables.

    Attributes:
      pose, goal: int32 [B].
      layout_weights: float32 [B, K], the layout's weights for the goal (column of w, eq. 7).
      reading: output of the method's tracker, leaves [B, ...]; None without one.
      surroundings: uint8 [B, M], map cells around the agent; None without a spatial memory.
      use_direct: bool [B], False where the coin zeroed both direct pathways; None without a coin.
      use_experience: float32 [B], 0 where experience was dropped, otherwise 1; None without experience dropout.
      is_decision_step: bool [B], False where a macro-action was running and the choice was ignored; None if choices are
        actions.
      choice: int32 [B], index sampled from the policy's logits: an action, or a macro-action.
      action: int32 [B], action passed to the environment.
      log_prob, value, reward: float32 [B].
      terminated, truncated, success: bool [B].
      episode_length: int32 [B], actions of the episode so far.
    """

    pose: jax.Array
    goal: jax.Array
    layout_weights: jax.Array
    reading: Any
    surroundings: jax.Array | None
    use_direct: jax.Array | None
    use_experience: jax.Array | None
    is_decision_step: jax.Array | None
    choice: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array
    episode_length: jax.Array

    @property
    def ended(self) -> jax.Array:
        """True where the episode ended with the step, bool [B]."""
        return self.terminated | self.truncated


class Rollout(NamedTuple):
    """T steps of B environments.

    Attributes:
      transitions: leaves [T, B, ...].
      initial_memory: the policy's memories before the first step, leaves [B, ...].
      next_value: float32 [T, B], bootstrap value of each step: V(s_{t+1}); 0 after a termination, V(final state) after
        a truncation.
    """

    transitions: Transition
    initial_memory: PolicyState
    next_value: jax.Array


class TruncatedAgents(NamedTuple):
    """The agent of each environment at the end of its truncated episode, for its value after the rollout.

    Each environment is truncated at most once in a rollout, because T is at most the shortest step limit (see
    `PPOConfig.rollout`).

    Attributes:
      agent: the agents [B]; they have not perceived their last view yet.
      has_moved: bool [B], whether the last action changed the cell.
      rollout_step: int32 [B], step of the rollout; -1 where no episode was truncated.
    """

    agent: Agent
    has_moved: jax.Array
    rollout_step: jax.Array


def collect_rollout(
    agent_loop: AgentLoop,
    policy: Policy,
    agent: Agent,
    key: jax.Array,
    env_params: EnvParams,
    knowledge: Knowledge,
    *,
    num_steps: int,
    use_coin: bool = False,
    experience_prob: jax.Array | float = 1.0,
    redraw_every_step: bool = False,
) -> tuple[Agent, Rollout]:
    """Act for `num_steps` steps with sampled actions and same-step auto-reset.

    Args:
      agent_loop: runs policy and environment.
      policy: policy with bound parameters.
      agent: B running episodes: environment states, perception and policy memories.
      key: PRNG key [].
      env_params: parameters of the environment.
      knowledge: layout priors and statistics from before training.
      num_steps: T.
      use_coin: zero both direct pathways with probability 1/2 at every step.
      experience_prob: probability that an episode has experience, for policies with experience dropout.
      redraw_every_step: redraw the experience dropout at every step, not only where an episode begins.

    Returns:
      The agents after the rollout, and the rollout. Values after a truncation and after the last step always use both
      direct pathways; within an episode the bootstrap value is that of the next step, with its coin.
    """
    num_envs = agent.state.pose.shape[0]

    def act_once(
        carry: tuple[Agent, TruncatedAgents], time_and_key: tuple[jax.Array, jax.Array]
    ) -> tuple[Any, Transition]:
        agent, truncated_agents = carry
        rollout_step, step_key = time_and_key
        direct_key = jax.random.fold_in(step_key, _DIRECT_MASK)
        action_key = jax.random.fold_in(step_key, _ACTION)
        env_keys = jax.random.split(jax.random.fold_in(step_key, _ENV), num_envs)
        dropout_key = jax.random.fold_in(step_key, _EXPERIENCE_DROPOUT)

        # Decide and sample.
        use_direct = jax.random.bernoulli(direct_key, 0.5, (num_envs,)) if use_coin else None
        inputs = agent_loop.policy_inputs(agent, knowledge, env_params)
        decision = embed_and_decide(policy, inputs, policy_memory(agent), use_direct)
        choice = jax.random.categorical(action_key, decision.logits)
        log_probs = jax.nn.log_softmax(decision.logits)
        log_prob = jnp.take_along_axis(log_probs, choice[:, None], axis=-1)[:, 0]

        # Act. `result.agent` is the agent after the action and before a reset: its memory has advanced, but its new
        # view is not perceived yet. `next_agent` has perceived it, or the first view of a new episode.
        next_agent, result = agent_loop.step(
            agent, choice, knowledge, env_params, policy=policy, decision=decision, reset_keys=env_keys
        )

        # Draw the experience dropout of new episodes.
        should_redraw = redraw_every_step | result.ended
        next_memory = sample_experience_dropout(policy_memory(next_agent), should_redraw, dropout_key, experience_prob)
        next_agent = next_agent._replace(memory=next_memory)

        # Keep the agents of truncated episodes.
        latest_agents = TruncatedAgents(result.agent, result.moved, jnp.broadcast_to(rollout_step, (num_envs,)))
        truncated_agents = tree_where(result.truncated, latest_agents, truncated_agents)

        transition = Transition(
            pose=agent.state.pose,
            goal=agent.state.goal,
            layout_weights=inputs.layout_weights,
            reading=inputs.reading,
            surroundings=inputs.surroundings,
            use_direct=use_direct,
            use_experience=decision.use_experience,
            is_decision_step=agent_loop.is_decision_step(agent),
            choice=choice,
            # The action sent to the environment, as the memory keeps it; equals `choice` if choices are actions.
            action=policy_memory(result.agent).action,
            log_prob=log_prob,
            value=decision.value,
            reward=result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            success=result.success,
            episode_length=result.agent.state.time,
        )
        return (next_agent, truncated_agents), transition

    initial_memory = policy_memory(agent)
    no_truncation = TruncatedAgents(agent, jnp.zeros(num_envs, bool), jnp.full((num_envs,), -1))
    scan_inputs = jnp.arange(num_steps), jax.random.split(key, num_steps)
    (agent, truncated_agents), transitions = jax.lax.scan(act_once, (agent, no_truncation), scan_inputs)

    # Bootstrap values: of truncated agents, once their last view is perceived, and of the agents after the rollout.
    # Environments without a truncation compute a value that is not used (their step is -1).
    def estimate_value(agent: Agent) -> jax.Array:
        inputs = agent_loop.policy_inputs(agent, knowledge, env_params)
        decision = embed_and_decide(policy, inputs, policy_memory(agent))
        return decision.value

    truncated_action = policy_memory(truncated_agents.agent).action
    perceived_agent = agent_loop.perceive(
        truncated_agents.agent, truncated_action, truncated_agents.has_moved, knowledge, env_params
    )
    truncated_value = estimate_value(perceived_agent)
    final_value = estimate_value(agent)
    next_value = _bootstrap_values(transitions, truncated_agents.rollout_step, truncated_value, final_value)
    return agent, Rollout(transitions, initial_memory, next_value)


def sample_experience_dropout(
    memory: PolicyState, should_redraw: jax.Array | bool, key: jax.Array, experience_prob: jax.Array | float
) -> PolicyState:
    """Draw whether episodes have experience; the remaining ones keep their flag.

    Args:
      memory: the policy's memories, leaves [B, ...]; returned unchanged for policies without experience dropout, whose
        `use_experience` is None.
      should_redraw: bool [] or [B], episodes to draw for.
      key: PRNG key [].
      experience_prob: probability of having experience.
    """
    if memory.use_experience is None:
        return memory
    new_flag = jax.random.bernoulli(key, experience_prob, memory.use_experience.shape).astype(jnp.float32)
    return memory._replace(use_experience=jnp.where(should_redraw, new_flag, memory.use_experience))


def _bootstrap_values(
    transitions: Transition, truncation_step: jax.Array, truncated_value: jax.Array, final_value: jax.Array
) -> jax.Array:
    """Bootstrap value of each step, float32 [T, B]; see `Rollout.next_value`.

    Args:
      transitions: leaves [T, B].
      truncation_step: int32 [B], step of the rollout with a truncation; -1 without one.
      truncated_value, final_value: float32 [B], values after a truncation and after the rollout.
    """
    # Within an episode: the value of the next step.
    next_value = jnp.concatenate([transitions.value[1:], final_value[None]])
    # After a truncation: the value of the final state. After a termination: 0.
    is_truncation = jnp.arange(len(next_value))[:, None] == truncation_step[None, :]
    next_value = jnp.where(is_truncation, truncated_value[None, :], next_value)
    return jnp.where(transitions.terminated, 0.0, next_value)


# 2. Advantages


def compute_advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    ended: jax.Array,
    gamma: jax.Array,
    gae_lambda: jax.Array,
    is_decision_step: jax.Array | None = None,
) -> jax.Array:
    """Generalised advantage estimates, float32 [T, B] (Schulman et al., 2016).

    Within a macro-action lambda is 1, so that the sum of deltas telescopes to sum_k gamma^k r_k + gamma^n V' - V: the
    estimate over macro-steps of n actions.

    Args:
      reward: float32 [T, B].
      value: float32 [T, B], of the state before each step.
      next_value: float32 [T, B], see `Rollout.next_value`.
      ended: bool [T, B], the episode terminated or was truncated with this step.
      gamma: float32 [], discount.
      gae_lambda: float32 [].
      is_decision_step: bool [T, B], see `Transition`; None if every step is one. At other steps the estimate covers the
        remainder of the macro-action.
    """
    chex.assert_equal_shape([reward, value, next_value, ended])

    # TD errors, [T, B].
    delta = reward + gamma * next_value - value

    # Lambda is 1 until the next decision step. The last entry has no effect, because A_T = 0.
    step_lambda = gae_lambda
    if is_decision_step is not None:
        next_is_decision_step = jnp.concatenate([is_decision_step[1:], jnp.ones_like(is_decision_step[:1])])
        step_lambda = jnp.where(next_is_decision_step, gae_lambda, 1.0)

    # A_t = delta_t + decay_t A_{t+1}, backwards; no credit crosses the end of an episode.
    decay = gamma * step_lambda * (1.0 - ended.astype(jnp.float32))

    def backward(next_advantage: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, decay_t = inputs
        advantage = delta_t + decay_t * next_advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)
    return advantages


# 3. Replay and loss


class Replay(NamedTuple):
    """Decisions of a rollout under the parameters to differentiate; arrays have leaves [T, B, ...].

    Policy and environment are included for the losses of methods (`Method.auxiliary`, `Stage.loss`).

    Attributes:
      policy: policy bound to the parameters under differentiation.
      transitions: the rollout's transitions.
      encoded: output of `policy.encode`, before masking and before the experience attends to the memory.
      factual: decisions as in the rollout.
      counterfactual: decisions with both direct pathways zero, and the same experience. The recurrent state is that of
        the factual decisions, which no gradient enters, or a state of its own.
      env_params: parameters of the environment.
    """

    policy: Policy
    transitions: Transition
    encoded: EncodedPathways
    factual: Decision
    counterfactual: Decision
    env_params: EnvParams


def replay_rollout(policy: Policy, transitions: Transition, memory: PolicyState, env_params: EnvParams) -> Replay:
    """Evaluate a policy again on a stored rollout.

    Args:
      policy: policy bound to the parameters to differentiate.
      transitions: leaves [T, B, ...].
      memory: memories before the first step, leaves [B, ...].
      env_params: parameters of the environment; observations are gathered from its tables.
    """
    # Gather the observations, and embed them for all steps at once.
    observation = Observation(row=env_params.tables.rows[transitions.pose], goal=transitions.goal)
    inputs = PolicyInputs(
        observation=observation,
        layout_weights=transitions.layout_weights,
        reading=transitions.reading,
        surroundings=transitions.surroundings,
    )
    encoded = policy.encode(inputs)

    # An adaptation changes the layers within the rollout, so the whole policy is scanned over time. Otherwise all that
    # does not depend on the memory runs in parallel over time.
    replay_decisions = _replay_in_parallel if policy.adaptation is None else _replay_step_by_step
    factual_decision, counterfactual_decision = replay_decisions(policy, encoded, transitions, memory)
    return Replay(
        policy=policy,
        transitions=transitions,
        encoded=encoded,
        factual=factual_decision,
        counterfactual=counterfactual_decision,
        env_params=env_params,
    )


def _replay_in_parallel(
    policy: Policy, encoded: EncodedPathways, transitions: Transition, memory: PolicyState
) -> tuple[Decision, Decision]:
    """Apply inputs and heads for all T steps in parallel; the GRU, and experience that reads its state, step by step.

    Returns:
      Factual and counterfactual decisions, leaves [T, B, ...].
    """
    # previous_action[t] = action[t - 1]: from the initial memory at t = 0, NO_ACTION where an episode begins.
    next_previous_action = jnp.where(transitions.ended, NO_ACTION, transitions.action)
    previous_action = jnp.concatenate([memory.action[None], next_previous_action[:-1]])

    # Mask the direct pathways as while acting; experience does not read them.
    encoded = mask_direct_pathways(encoded, transitions.use_direct)
    direct_input = policy.direct_input(encoded)

    # Factual: unroll the GRU through time. `policy.decide` is not called here, so the experience is masked by hand.
    if policy.experience.reads_memory:
        unrolled_core = _unroll_with_attention(
            policy, encoded, direct_input, previous_action, transitions, memory.hidden
        )
        # Experience of all steps at once, from constant memories: for the counterfactual branch and the heads.
        memory_before = PolicyState(hidden=unrolled_core.hidden_before, action=previous_action)
        pathways = mask_experience(policy.attend(encoded, memory_before), transitions.use_experience)
        mediated_input = policy.mediated_input(pathways, previous_action)
    else:
        pathways = mask_experience(policy.attend(encoded, None), transitions.use_experience)
        mediated_input = policy.mediated_input(pathways, previous_action)
        factual_gates = policy.input_gates(direct_input + mediated_input)
        unrolled_core = unroll_gru(policy.recurrent_kernel, factual_gates, transitions.ended, memory.hidden)
    factual_decision = policy.apply_heads(unrolled_core.hidden_after, pathways)

    # Counterfactual: the mediated input only.
    counterfactual_pathways = do(pathways, scene=0.0, goal=0.0)
    counterfactual_gates = policy.input_gates(mediated_input)
    if memory.counterfactual_hidden is None:
        # One GRU step at each time, from the factual hidden state before it. The unrolled core treats that state as a
        # constant, so no gradient enters it.
        counterfactual_hidden = gru_step(counterfactual_gates, unrolled_core.hidden_gates, unrolled_core.hidden_before)
    else:
        # Unroll the GRU a second time, along the memory of the branch itself.
        counterfactual_hidden = unroll_gru(
            policy.recurrent_kernel, counterfactual_gates, transitions.ended, memory.counterfactual_hidden
        ).hidden_after
    return factual_decision, policy.apply_heads(counterfactual_hidden, counterfactual_pathways)


def _unroll_with_attention(
    policy: Policy,
    encoded: EncodedPathways,
    direct_input: jax.Array,
    previous_action: jax.Array,
    transitions: Transition,
    hidden: jax.Array,
) -> UnrolledGRU:
    """Unroll the GRU of a policy whose experience attends from the recurrent state.

    Args:
      policy: policy whose method reads the memory.
      encoded: outputs of `policy.encode`, leaves [T, B, ...].
      direct_input: float32 [T, B, H], the projected direct pathways; [T, B, 2 H] with two streams, as all states.
      previous_action: int32 [T, B].
      transitions: leaves [T, B, ...].
      hidden: float32 [B, H], recurrent state before the first step.

    Returns:
      The states along the rollout, with gradients as those of `unroll_gru`.
    """

    def step(hidden_before: jax.Array, inputs: Any) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        step_encoded, direct, action, use_experience, ended = inputs
        # The experience attends from the state before the step, then the GRU advances.
        memory_before = PolicyState(hidden=hidden_before, action=action)
        attended = mask_experience(policy.attend(step_encoded, memory_before), use_experience)
        input_gates = policy.input_gates(direct + policy.mediated_input(attended, action))
        hidden_after = gru_step(input_gates, policy.hidden_gates(hidden_before), hidden_before)

        # An ended episode starts again from zeros.
        next_hidden = jnp.where(ended[:, None], 0.0, hidden_after)
        return next_hidden, (hidden_after, hidden_before)

    scan_inputs = encoded, direct_input, previous_action, transitions.use_experience, transitions.ended
    _, (hidden_after, hidden_before) = jax.lax.scan(step, hidden, scan_inputs)
    hidden_before = jax.lax.stop_gradient(hidden_before)
    return UnrolledGRU(hidden_after, hidden_before, policy.hidden_gates(hidden_before))


def _replay_step_by_step(
    policy: Policy, encoded: EncodedPathways, transitions: Transition, memory: PolicyState
) -> tuple[Decision, Decision]:
    """Scan the whole policy over time, for policies that adapt within an episode.

    Returns:
      Factual and counterfactual decisions, leaves [T, B, ...].
    """
    fresh_memory = policy.initial_memory(memory.action.shape)

    def replay_step(memory: PolicyState, inputs: tuple[EncodedPathways, Transition]) -> tuple[PolicyState, Any]:
        step_encoded, transition = inputs
        # `policy.decide` masks the experience by the flag of the memory, drawn in the rollout.
        memory = memory._replace(use_experience=transition.use_experience)
        factual_pathways = mask_direct_pathways(policy.attend(step_encoded, memory), transition.use_direct)
        # The counterfactual branch is advanced below, with gradients of its own.
        factual_decision = policy.decide(factual_pathways, memory._replace(counterfactual_hidden=None))

        # No gradient of the counterfactual branch enters the factual memory, but a state of its own has gradients.
        fixed_memory = jax.lax.stop_gradient(memory)._replace(counterfactual_hidden=memory.counterfactual_hidden)
        counterfactual_decision = decide_counterfactually(
            policy, policy.attend(step_encoded, fixed_memory), fixed_memory
        )

        # New episodes start from fresh memory.
        next_memory = factual_decision.next_state(transition.action)
        if memory.counterfactual_hidden is not None:
            next_memory = next_memory._replace(counterfactual_hidden=counterfactual_decision.hidden)
        next_memory = tree_where(transition.ended, fresh_memory, next_memory)
        return next_memory, (factual_decision, counterfactual_decision)

    _, decisions = jax.lax.scan(replay_step, memory, (encoded, transitions))
    return decisions


def ppo_loss(
    replay: Replay, advantages: jax.Array, scalars: PPOScalars, use_distillation: bool, method: Method
) -> tuple[jax.Array, Metrics]:
    """Clipped PPO loss of a minibatch [T, B], plus distillation, guidance and the method's auxiliary loss.

    Distillation adds KL(stop_gradient(pi) || counterfactual). Policy terms average over decision steps only; the value
    loss uses all steps, because a rollout may end (and bootstrap) within a macro-action.

    Args:
      replay: decisions under the parameters to differentiate.
      advantages: float32 [T, B].
      scalars: weights of the loss terms, and the clip range.
      use_distillation: whether the counterfactual branch is distilled.
      method: method, whose auxiliary loss is added if it has one.

    Returns:
      The loss float32 [] and its terms by name.
    """
    transitions = replay.transitions
    is_decision_step = transitions.is_decision_step
    log_probs = jax.nn.log_softmax(replay.factual.logits)
    log_prob = jnp.take_along_axis(log_probs, transitions.choice[..., None], axis=-1)[..., 0]

    # Policy: clipped surrogate; advantages are normalised per minibatch, over all devices.
    advantage_mean, advantage_std = mean_and_std(advantages, is_decision_step)
    normalised_advantages = (advantages - advantage_mean) / (advantage_std + 1e-8)
    ratio = jnp.exp(log_prob - transitions.log_prob)
    clipped_ratio = jnp.clip(ratio, 1.0 - scalars.clip_range, 1.0 + scalars.clip_range)
    surrogate = jnp.minimum(ratio * normalised_advantages, clipped_ratio * normalised_advantages)
    policy_loss = -masked_mean(surrogate, is_decision_step)

    # Value (squared error to the lambda-return) and entropy.
    value_target = advantages + transitions.value
    value_loss = 0.5 * jnp.square(replay.factual.value - value_target).mean()
    entropy = -masked_mean((jnp.exp(log_probs) * log_probs).sum(axis=-1), is_decision_step)
    loss = policy_loss + scalars.value_weight * value_loss - scalars.entropy_weight * entropy
    loss_terms = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}

    # Distillation of the counterfactual branch, KL(pi || pi_counterfactual); no gradient enters pi.
    if use_distillation:
        divergence = optax.losses.kl_divergence_with_log_targets(
            jax.nn.log_softmax(replay.counterfactual.logits), jax.lax.stop_gradient(log_probs)
        )
        distil_loss = masked_mean(divergence, is_decision_step)
        loss = loss + scalars.distil_weight * distil_loss
        loss_terms["distil_loss"] = distil_loss

    # Guidance: cross-entropy to the next action of a shortest path.
    if scalars.guidance_weight is not None:
        guidance_loss, guidance_terms = imitation_loss(replay.factual.logits, expert_actions(replay))
        loss = loss + scalars.guidance_weight * guidance_loss
        loss_terms = loss_terms | guidance_terms

    # Auxiliary loss of the method.
    if method.auxiliary is not None:
        auxiliary_loss, auxiliary_terms = method.auxiliary(replay)
        loss = loss + auxiliary_loss
        loss_terms = loss_terms | auxiliary_terms
    return loss, loss_terms


# 4. Gradient steps


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Clip by the global norm, then Adam without a learning rate; steps with a non-finite gradient are skipped.

    `apply_gradient` multiplies by the learning rate. Skipped steps are counted in the state, without an upper limit.
    """
    chain = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    # All parameters are one vector here: array by array, these were 0.3 of all operations of a training program.
    return optax.flatten(optax.apply_if_finite(chain, max_consecutive_errors=2**30))


def reset_optimizer_if(config: PPOConfig, opt_state: Any, policy_params: Params, condition: jax.Array) -> Any:
    """Reset Adam's moments and step count where `condition`, bool [], holds; the count of skipped steps is kept.

    Adam's bias correction has one step count for all parameters. A parameter unfrozen late would have zero moments but
    an old count, so its first steps would be about three times too large.
    """
    new_state: Any = make_optimizer(config).init(policy_params)
    return opt_state._replace(inner_state=tree_where(condition, new_state.inner_state, opt_state.inner_state))


def apply_gradient(
    config: PPOConfig,
    policy_params: Params,
    opt_state: optax.OptState,
    gradient: Params,
    learning_rate: jax.Array,
    lr_scale_by_path: Callable[[tuple[str, ...]], float] | None = None,
) -> tuple[Params, Any]:
    """Take one step of the optimizer.

    Args:
      config: settings of the optimizer.
      policy_params: parameters before the step.
      opt_state: state of the optimizer before the step.
      gradient: gradient of the loss, a tree like `policy_params`.
      learning_rate: float32 [].
      lr_scale_by_path: learning-rate factor by parameter path; 0 freezes a parameter. None for 1 everywhere.

    Returns:
      Parameters and optimizer state after the step.
    """
    # Zero the gradient of frozen parameters, so that the norm to clip by excludes them.
    if lr_scale_by_path is not None:
        gradient = _scale_by_path(gradient, lambda path: float(lr_scale_by_path(path) > 0))

    with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 counts with float32
        param_updates, opt_state = make_optimizer(config).update(gradient, opt_state, policy_params)

    # Scale Adam's step, not the gradient: Adam is invariant to the scale of gradients, and momentum would still move
    # frozen parameters. The chain has no negative learning rate, so the step is subtracted.
    if lr_scale_by_path is not None:
        param_updates = _scale_by_path(param_updates, lr_scale_by_path)
    policy_params = jax.tree.map(lambda param, step: param - learning_rate * step, policy_params, param_updates)
    return policy_params, opt_state


def _scale_by_path(tree: Any, scale: Callable[[tuple[str, ...]], float]) -> Any:
    """Multiply leaves by the factor of their path; a factor of 0 gives zeros even for NaN leaves."""

    def scale_leaf(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        factor = float(scale(tuple(str(entry.key) for entry in path)))
        return factor * leaf if factor else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(scale_leaf, tree)


def assign_minibatches(key: jax.Array, num_envs: int, num_minibatches: int) -> jax.Array:
    """Assign each environment to a minibatch at random.

    Environments form consecutive blocks of `num_minibatches`, and each block gives one environment to every minibatch,
    so that no data moves between devices. Example: for 4 environments, 2 minibatches and the result [[1, 0], [0, 1]],
    minibatch 0 holds environments 1 and 2, minibatch 1 holds environments 0 and 3.

    Returns:
      int32 [B / M, M]; minibatch m takes environment `M * b + order[b, m]` of every block b.
    """
    offsets = jnp.broadcast_to(jnp.arange(num_minibatches), (num_envs // num_minibatches, num_minibatches))
    return jax.random.permutation(key, offsets, axis=1, independent=True)


def split_minibatches(tree: Any, order: jax.Array, axis: int) -> Any:
    """Split leaves [..., B, ...] into minibatches [M, ..., B / M, ...].

    Args:
      tree: leaves with B environments along `axis`.
      order: int32 [B / M, M], from `assign_minibatches`.
      axis: axis of the environments.
    """

    def split_leaf(leaf: jax.Array) -> jax.Array:
        # [..., B, ...] -> [..., B / M, M, ...]
        blocks = leaf.reshape(*leaf.shape[:axis], *order.shape, *leaf.shape[axis + 1 :])
        # Permute within blocks: unlike a gather over B, this stays on the device.
        other_axes = [*range(axis), *range(axis + 2, blocks.ndim)]
        shuffled = jnp.take_along_axis(blocks, jnp.expand_dims(order, other_axes), axis + 1)
        # The minibatch axis comes first.
        return jnp.moveaxis(shuffled, axis + 1, 0)

    return jax.tree.map(split_leaf, tree)


# 5. The learner: one training seed

#: Transitions [T, B / M, ...], initial memory [B / M, ...] and advantages [T, B / M] in B / M environments.
Minibatch = tuple[Transition, PolicyState, jax.Array]


class BestPolicy(struct.PyTreeNode):
    """The policy of a seed with the best validation so far.

    Attributes:
      params: parameters of the policy.
      score: float32 [], validation score; -1 before the first validation.
      update: int32 [], number of updates before that validation.
    """

    params: Params
    score: jax.Array
    update: jax.Array


class LearnerState(struct.PyTreeNode):
    """State of one training seed.

    Attributes:
      params: parameters of the policy.
      best: the policy with the best validation, which is exported.
      opt_state: state of the optimizer.
      agent: B running episodes, including the environment states.
      key: typed PRNG key []; update u uses `fold_in(key, u)`.
      update: int32 [], number of updates done.
    """

    params: Params
    best: BestPolicy
    opt_state: Any
    agent: Agent
    key: jax.Array
    update: jax.Array


@dataclasses.dataclass(frozen=True)
class Learner:
    """PPO for one training stage; holds the static configuration.

    Attributes:
      agent_loop: runs policy and environment.
      config: sizes and static settings; the fields of `PPOScalars` are read from the traced argument of `train`.
      counterfactual: training of the counterfactual branch, see `CounterfactualTraining`.
      stage: loss, schedules and frozen parameters of this part of training.
    """

    agent_loop: AgentLoop
    config: PPOConfig
    counterfactual: CounterfactualTraining
    stage: Stage = Stage()

    def init(
        self, key: jax.Array, env_params: EnvParams, knowledge: Knowledge, experience_prob: jax.Array | None = None
    ) -> LearnerState:
        """Initial state of one training seed.

        Args:
          key: typed PRNG key [] of the seed.
          env_params: parameters of the training environment.
          knowledge: knowledge from before training.
          experience_prob: float32 [], probability that an episode has experience; None for that of `config`.
        """
        init_key = jax.random.fold_in(key, _INIT)
        start_key = jax.random.fold_in(key, _START)
        update_key = jax.random.fold_in(key, _UPDATES)

        assert self.agent_loop.spec is not None
        policy_params = init_params(self.agent_loop.spec, init_key)
        return LearnerState(
            params=policy_params,
            best=BestPolicy(params=policy_params, score=jnp.float32(-1.0), update=jnp.int32(0)),
            opt_state=make_optimizer(self.config).init(policy_params),
            agent=self._start_episodes(policy_params, start_key, env_params, knowledge, experience_prob),
            key=update_key,
            update=jnp.int32(0),
        )

    def restart_episodes(
        self,
        state: LearnerState,
        env_params: EnvParams,
        knowledge: Knowledge,
        experience_prob: jax.Array | None = None,
    ) -> LearnerState:
        """Start new episodes in the scenes of `env_params`; parameters and optimizer state are kept."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, state.update), _RESTART)
        return state.replace(agent=self._start_episodes(state.params, key, env_params, knowledge, experience_prob))

    def keep_if_best(self, state: LearnerState, score: jax.Array) -> LearnerState:
        """Keep the current policy as the best one unless an earlier score, float32 [], is higher."""
        current = BestPolicy(state.params, score, state.update)
        return state.replace(best=tree_where(score >= state.best.score, current, state.best))

    def train(
        self,
        state: LearnerState,
        scalars: PPOScalars,
        env_params: EnvParams,
        knowledge: Knowledge,
        num_updates: int,
    ) -> tuple[LearnerState, Metrics]:
        """Run `num_updates` updates.

        Returns:
          The state after the updates and float32 [] metrics: the losses' means over the updates, `success`, `return`
          (undiscounted, without shaping), `length` and `truncated` averaged over the `episodes` that ended (0 without
          any), and the number of `skipped_steps` of the optimizer whose gradient was not finite.
        """

        def update_once(state: LearnerState, _: None) -> tuple[LearnerState, Metrics]:
            return self.update(state, scalars, env_params, knowledge)

        # The first call of a stage starts with a fresh optimizer.
        is_stage_start = state.update.astype(jnp.float32) == scalars.first_update
        opt_state = reset_optimizer_if(self.config, state.opt_state, state.params, is_stage_start)
        state, metrics = jax.lax.scan(update_once, state.replace(opt_state=opt_state), None, length=num_updates)

        # Sums over episodes become means per episode, losses means per update.
        totals = {name: value.sum() for name, value in metrics.items()}
        num_episodes = totals.pop("episodes")
        num_skipped = totals.pop("skipped_steps")
        summary = {}
        for name in EPISODE_MEANS:
            summary[name] = totals.pop(name) / jnp.maximum(num_episodes, 1.0)
        for name, value in totals.items():
            summary[name] = value / num_updates
        return state, summary | {"episodes": num_episodes, "skipped_steps": num_skipped}

    def update(
        self, state: LearnerState, scalars: PPOScalars, env_params: EnvParams, knowledge: Knowledge
    ) -> tuple[LearnerState, Metrics]:
        """One PPO update: rollout, advantages, epochs of minibatch steps."""
        update_key = jax.random.fold_in(state.key, state.update)
        rollout_key = jax.random.fold_in(update_key, _ROLLOUT)
        shuffle_key = jax.random.fold_in(update_key, _SHUFFLE)

        # 1. Rollout. A stage without adaptation does not read the fast weights, which may be large: the scan does not
        # carry them, and they are put back unchanged for the next stage that adapts.
        agent = state.agent
        fast_weights = policy_memory(agent).fast
        if not self.stage.adapts_online:
            agent = _with_fast_weights(agent, None)
        agent, rollout = collect_rollout(
            self._stage_agent_loop,
            self._stage_agent_loop.bind(state.params),
            agent,
            rollout_key,
            env_params,
            knowledge,
            num_steps=self.config.rollout,
            use_coin=self.counterfactual == "coin",
            experience_prob=self._experience_prob(scalars.experience_prob),
            redraw_every_step=self.config.experience_drawn == "step",
        )
        if not self.stage.adapts_online:
            agent = _with_fast_weights(agent, fast_weights)

        # 2. Advantages, once per update.
        transitions = rollout.transitions
        advantages = compute_advantages(
            transitions.reward,
            transitions.value,
            rollout.next_value,
            transitions.ended,
            scalars.gamma,
            scalars.gae_lambda,
            transitions.is_decision_step,
        )

        # 3. and 4. Gradient steps.
        scheduled_scalars = scalars.at_update(state.update)
        (policy_params, opt_state), losses = self._run_epochs(
            state, rollout, advantages, shuffle_key, scheduled_scalars, env_params
        )

        # Losses are means over the minibatches, statistics of episodes are sums.
        metrics = {name: value.mean() for name, value in losses.items()}
        metrics = metrics | _episode_sums(transitions, env_params)
        num_skipped = opt_state.total_notfinite - state.opt_state.total_notfinite
        metrics["skipped_steps"] = num_skipped.astype(jnp.float32)
        state = state.replace(params=policy_params, opt_state=opt_state, agent=agent, update=state.update + 1)
        return state, metrics

    def _run_epochs(
        self,
        state: LearnerState,
        rollout: Rollout,
        advantages: jax.Array,
        key: jax.Array,
        scalars: PPOScalars,
        env_params: EnvParams,
    ) -> tuple[tuple[Params, Any], Metrics]:
        """Take a gradient step for every minibatch of every epoch, with the scheduled settings of the update."""
        config = self.config

        # Each device computes loss and gradient on its share of the environments; their means over the devices are
        # those of the minibatch, also under masks (see `masked_mean`). The specs follow the arguments of
        # `_minibatch_loss`.
        replicated = PartitionSpec()
        split_over_envs = PartitionSpec(None, ENV_AXIS)  # [T, B, ...]
        minibatch_specs = split_over_envs, PartitionSpec(ENV_AXIS), split_over_envs
        loss_gradient = mean_over_devices(
            jax.grad(self._minibatch_loss, has_aux=True), replicated, minibatch_specs, replicated, replicated
        )

        def update_on_minibatch(carry: TrainCarry, minibatch: Minibatch) -> tuple[TrainCarry, Metrics]:
            policy_params, opt_state = carry
            gradient, losses = loss_gradient(policy_params, minibatch, env_params, scalars)
            carry = apply_gradient(
                config, policy_params, opt_state, gradient, scalars.learning_rate, self.stage.lr_scale_by_path
            )
            # One vector, as in the optimizer, which clips by this norm where no parameter is frozen.
            return carry, losses | {"gradient_norm": optax.tree.norm(ravel_pytree(gradient)[0])}

        def run_epoch(carry: TrainCarry, epoch_key: jax.Array) -> tuple[TrainCarry, Metrics]:
            order = assign_minibatches(epoch_key, config.num_envs, config.minibatches)
            transitions, minibatch_advantages = split_minibatches((rollout.transitions, advantages), order, axis=1)
            initial_memory = split_minibatches(rollout.initial_memory, order, axis=0)
            return jax.lax.scan(update_on_minibatch, carry, (transitions, initial_memory, minibatch_advantages))

        epoch_keys = jax.random.split(key, config.epochs)
        return jax.lax.scan(run_epoch, (state.params, state.opt_state), epoch_keys)

    def _minibatch_loss(
        self, policy_params: Params, minibatch: Minibatch, env_params: EnvParams, scalars: PPOScalars
    ) -> tuple[jax.Array, Metrics]:
        """Loss of the stage on a minibatch, float32 [], and its terms."""
        assert self.agent_loop.method is not None
        transitions, initial_memory, advantages = minibatch
        policy = self._stage_agent_loop.bind(policy_params)
        replay = replay_rollout(policy, transitions, initial_memory, env_params)
        loss_fn = self.stage.loss or ppo_loss
        use_distillation = self.counterfactual == "distil"
        return loss_fn(replay, advantages, scalars, use_distillation, self.agent_loop.method)

    def _start_episodes(
        self,
        policy_params: Params,
        key: jax.Array,
        env_params: EnvParams,
        knowledge: Knowledge,
        experience_prob: jax.Array | None,
    ) -> Agent:
        """Start an episode in every environment, and draw its experience dropout."""
        num_envs = self.config.num_envs
        dropout_prob = self._experience_prob(
            self.config.experience_prob if experience_prob is None else experience_prob
        )
        memory = self.agent_loop.bind(policy_params).initial_memory((num_envs,))
        dropout_key = jax.random.fold_in(key, _START_DROPOUT)
        memory = sample_experience_dropout(memory, True, dropout_key, dropout_prob)
        return self.agent_loop.start(key, num_envs, memory, knowledge, env_params)

    def _experience_prob(self, experience_prob: jax.Array | float) -> jax.Array | float:
        """Probability that an episode has experience: 0 in a stage of the direct stream alone."""
        return 0.0 if self.stage.direct_stream_only else experience_prob

    @property
    def _stage_agent_loop(self) -> AgentLoop:
        """The agent loop of the stage, with or without adaptation."""
        if self.stage.adapts_online:
            return self.agent_loop
        return dataclasses.replace(self.agent_loop, inner_steps=0)


def _with_fast_weights(agent: Agent, fast_weights: Any) -> Agent:
    """Replace the fast weights in the agents' memories."""
    return agent._replace(memory=policy_memory(agent)._replace(fast=fast_weights))


def _episode_sums(transitions: Transition, env_params: EnvParams) -> Metrics:
    """Sum the statistics of the episodes that ended, float32 [] each."""
    ended = transitions.ended
    statistics = ended, transitions.success, transitions.episode_length, transitions.truncated
    # One [4, T, B] array, so that devices need a single all-reduce.
    table = jnp.stack([values.astype(jnp.float32) for values in statistics])
    num_episodes, num_successes, total_length, num_truncated = jnp.where(ended, table, 0.0).sum(axis=(1, 2))

    # Every step but a successful Done costs the same, so the return (without shaping) follows from length and success.
    return_sum = env_params.success_reward * num_successes + env_params.step_reward * (total_length - num_successes)
    return {
        "episodes": num_episodes,
        "success": num_successes,
        "length": total_length,
        "truncated": num_truncated,
        "return": return_sum,
    }
