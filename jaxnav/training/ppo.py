"""Recurrent PPO on one page: collect a rollout, estimate advantages, compute the loss, update.

`Learner.train` is what gets compiled: a `lax.scan` over updates. Each update

1. collects a rollout of T steps in B slots, parallel environments with same-step auto-reset (`collect_rollout`),
2. estimates advantages (`compute_advantages`),
3. evaluates the policy again on the stored rollout with the parameters to differentiate by (`replay_rollout`),
4. takes a gradient step of `ppo_loss` for each minibatch of each epoch (`Learner`).

What is added to plain PPO:

* Three pathways lead to the action: the two *direct* ones, scene and goal, and *experience*, the method's mediator. The
  *counterfactual branch* is the same network at the same memory with both direct pathways zero. `Counterfactual` says
  how the branch is trained: not at all, by zeroing the direct pathways with a coin while acting, or by distillation.
* *Experience dropout*: policies of two streams may go without experience, for whole episodes or single steps.
* *Macro-actions*: a choice of the policy may last for several actions. Choices sampled meanwhile are ignored
  (`is_decision_step` False): they do not enter the policy loss, and advantages are those of macro-steps.
* *Stages*: each has its own loss, frozen parameters and schedules, and begins with a fresh Adam. *Fast weights* are
  those that a method adapts within an episode.
* Devices may share the slots of a minibatch; gradients are then averaged over them.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import PartitionSpec

from jaxnav.causal import do
from jaxnav.env.objectnav import EnvParams, Observation
from jaxnav.numerics.recurrence import gru_step, unroll_gru
from jaxnav.policies.agent_loop import Agent, AgentLoop, decide, mask_direct_pathways, policy_memory, select
from jaxnav.policies.method import Knowledge, Method, Stage
from jaxnav.policies.network import Params, Policy, init_params
from jaxnav.policies.pathways import NO_ACTION, Decision, Pathways, PolicyState, mask_experience
from jaxnav.training.config import Counterfactual, PPOConfig, PPOScalars
from jaxnav.training.shares import EPISODE_AXIS, masked_mean, mean_and_std, mean_over_devices

Metrics = dict[str, jax.Array]

# Tags of the keys that are folded from a seed's key, from an update's key, and from a step's key.
_INIT, _START, _UPDATES = range(3)
_ROLLOUT, _SHUFFLE, _RESTART = range(3)
_DIRECT_MASK, _ACTION, _ENV, _EXPERIENCE_DROPOUT = range(4)
#: Tag of the experience dropout at a start. `AgentLoop.start` splits the same key; this tag cannot collide with that.
_START_DROPOUT = 2**31 - 1


# 1. Collect


class Transition(NamedTuple):
    """One step of B slots.

    Poses and goals stand for observations, which are gathered from the scene tables again when needed.

    Attributes:
      pose, goal: int32 [B].
      weights: float32 [B, K], the layout's weights for the goal (eq. 7).
      reading: what the method's tracker read, leaves [B, ...]; None without one.
      surroundings: uint8 [B, M], what the spatial memory read; None without one.
      use_direct: bool [B], False where the coin zeroed both direct pathways; None without a coin.
      use_experience: float32 [B], 0 where experience was dropped, otherwise 1; None without experience dropout.
      is_decision_step: bool [B], False where a macro-action was running and the choice was ignored; None where choices
        are actions.
      choice: int32 [B], sampled from the policy.
      action: int32 [B], taken in the environment.
      log_prob, value, reward: float32 [B].
      terminated, truncated, success: bool [B].
      length: int32 [B], actions of the episode so far.
    """

    pose: jax.Array
    goal: jax.Array
    weights: jax.Array
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
    length: jax.Array

    @property
    def ended(self) -> jax.Array:
        """True where the episode ended with the step, bool [B]."""
        return self.terminated | self.truncated


class Rollout(NamedTuple):
    """T steps of B slots.

    Attributes:
      transitions: leaves [T, B, ...].
      memory: the policy's memories at the start, leaves [B, ...].
      next_value: float32 [T, B], value of the state after each step within the same episode: 0 after a termination,
        that of the last state after a truncation.
    """

    transitions: Transition
    memory: PolicyState
    next_value: jax.Array


class TruncatedState(NamedTuple):
    """The last state of the truncated episode of each slot; its value is estimated after the rollout.

    A slot has at most one in a rollout, as a rollout is no longer than the shortest step limit.

    Attributes:
      agent: the agents; their last view has not entered memory and beliefs yet.
      moved: bool [B], whether the last action changed the cell.
      time: int32 [B], step of the rollout; -1 where no episode was truncated.
    """

    agent: Agent
    moved: jax.Array
    time: jax.Array


def collect_rollout(
    agent_loop: AgentLoop,
    policy: Policy,
    agent: Agent,
    key: jax.Array,
    length: int,
    use_coin: bool,
    env_params: EnvParams,
    knowledge: Knowledge,
    experience_prob: jax.Array | float = 1.0,
    redraw_every_step: bool = False,
) -> tuple[Agent, Rollout]:
    """Act for some steps with sampled actions and same-step auto-reset.

    Args:
      agent_loop: runs policy and environment.
      policy: with bound parameters.
      agent: the episodes to go on with, [B].
      key: consumed.
      length: T, steps.
      use_coin: zero both direct pathways with probability 1/2 at every step.
      env_params: of the environment.
      knowledge: learned before training.
      experience_prob: probability that an episode has experience, for policies with experience dropout.
      redraw_every_step: redraw the experience dropout at every step, not only where an episode begins.

    Returns:
      The episodes after the rollout, and the rollout. Values of truncated states and of the state after the rollout are
      those with both direct pathways, whatever the coin.
    """
    num_envs = agent.state.pose.shape[0]

    def step(carry: tuple[Agent, TruncatedState], inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Transition]:
        agent, truncated_state = carry
        time, step_key = inputs
        direct_key = jax.random.fold_in(step_key, _DIRECT_MASK)
        action_key = jax.random.fold_in(step_key, _ACTION)
        env_keys = jax.random.split(jax.random.fold_in(step_key, _ENV), num_envs)
        dropout_key = jax.random.fold_in(step_key, _EXPERIENCE_DROPOUT)

        # Decide and sample.
        use_direct = jax.random.bernoulli(direct_key, 0.5, (num_envs,)) if use_coin else None
        view = agent_loop.view(agent, knowledge, env_params)
        _, decision = decide(policy, view, policy_memory(agent), use_direct)
        choice = jax.random.categorical(action_key, decision.logits)
        log_probs = jax.nn.log_softmax(decision.logits)
        log_prob = jnp.take_along_axis(log_probs, choice[:, None], axis=-1)[:, 0]

        # Act. `result.agent` is the agent before a reset, `next_agent` after it; new episodes draw their experience.
        next_agent, result = agent_loop.step(
            agent, choice, knowledge, env_params, policy=policy, decision=decision, keys=env_keys
        )
        redraw = redraw_every_step | result.ended
        next_memory = sample_experience_dropout(policy_memory(next_agent), redraw, dropout_key, experience_prob)
        next_agent = next_agent._replace(memory=next_memory)

        # Remember the last state of truncated episodes.
        latest_state = TruncatedState(result.agent, result.moved, jnp.broadcast_to(time, (num_envs,)))
        truncated_state = select(result.truncated, latest_state, truncated_state)

        transition = Transition(
            pose=agent.state.pose,
            goal=agent.state.goal,
            weights=view.weights,
            reading=view.reading,
            surroundings=view.surroundings,
            use_direct=use_direct,
            use_experience=decision.use_experience,
            is_decision_step=agent_loop.is_decision_step(agent),
            choice=choice,
            action=policy_memory(result.agent).action,
            log_prob=log_prob,
            value=decision.value,
            reward=result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            success=result.success,
            length=result.agent.state.time,
        )
        return (next_agent, truncated_state), transition

    start_memory = policy_memory(agent)
    no_truncation = TruncatedState(agent, jnp.zeros(num_envs, bool), jnp.full((num_envs,), -1))
    steps = jnp.arange(length), jax.random.split(key, length)
    (agent, truncated_state), transitions = jax.lax.scan(step, (agent, no_truncation), steps)

    # Values to bootstrap from: of truncated states, once their last view is perceived, and of the states after the
    # rollout. Slots without a truncation compute a value that is not used.
    def estimate_value(agent: Agent) -> jax.Array:
        _, decision = decide(policy, agent_loop.view(agent, knowledge, env_params), policy_memory(agent))
        return decision.value

    last_action = policy_memory(truncated_state.agent).action
    truncated_agent = agent_loop.perceive(
        truncated_state.agent, last_action, truncated_state.moved, knowledge, env_params
    )
    truncated_value = estimate_value(truncated_agent)
    final_value = estimate_value(agent)
    next_value = _next_values(transitions, truncated_state.time, truncated_value, final_value)
    return agent, Rollout(transitions, start_memory, next_value)


def sample_experience_dropout(
    memory: PolicyState, redraw: jax.Array | bool, key: jax.Array, experience_prob: jax.Array | float
) -> PolicyState:
    """Draw which episodes have experience, for policies with experience dropout; episodes not redrawn keep theirs.

    Args:
      memory: of the policy, leaves [B, ...]; returned as it is where `use_experience` is None.
      redraw: bool [] or [B], episodes to draw for.
      key: consumed.
      experience_prob: probability of having experience.
    """
    if memory.use_experience is None:
        return memory
    drawn = jax.random.bernoulli(key, experience_prob, memory.use_experience.shape).astype(jnp.float32)
    return memory._replace(use_experience=jnp.where(redraw, drawn, memory.use_experience))


def _next_values(
    transitions: Transition, truncated_at: jax.Array, truncated_value: jax.Array, final_value: jax.Array
) -> jax.Array:
    """Return the value of the state after each step, float32 [T, B]; see `Rollout.next_value`.

    Args:
      transitions: leaves [T, B].
      truncated_at: int32 [B], step of a truncation; -1 without one.
      truncated_value, final_value: float32 [B], values after a truncation and after the rollout.
    """
    next_value = jnp.concatenate([transitions.value[1:], final_value[None]])
    is_truncation = jnp.arange(len(next_value))[:, None] == truncated_at[None, :]
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
      ended: bool [T, B], the episode ended with this step, either way.
      gamma: float32 [], discount.
      gae_lambda: float32 [].
      is_decision_step: bool [T, B], see `Transition`. Elsewhere the estimate is that of the rest of the macro-step.
    """
    delta = reward + gamma * next_value - value
    if is_decision_step is not None:
        next_is_decision = jnp.concatenate([is_decision_step[1:], jnp.ones_like(is_decision_step[:1])])
        gae_lambda = jnp.where(next_is_decision, gae_lambda, 1.0)
    decay = gamma * gae_lambda * (1.0 - ended.astype(jnp.float32))

    def backward(next_advantage: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, decay_t = inputs
        advantage = delta_t + decay_t * next_advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)
    return advantages


# 3. Replay and loss


class Replay(NamedTuple):
    """The decisions of a rollout with the parameters to differentiate by, leaves [T, B, ...].

    Attributes:
      policy: with these parameters.
      transitions: of the rollout.
      pathways: before masking, and before the experience attends to the memory.
      factual: decisions as in the rollout.
      counterfactual: decisions with both direct pathways zero, and the same experience and memory; no gradient enters
        the memory.
      env_params: of the environment.
    """

    policy: Policy
    transitions: Transition
    pathways: Pathways
    factual: Decision
    counterfactual: Decision
    env_params: EnvParams


def replay_rollout(policy: Policy, transitions: Transition, memory: PolicyState, env_params: EnvParams) -> Replay:
    """Evaluate a policy again on a stored rollout.

    Args:
      policy: with the parameters to differentiate by.
      transitions: [T, B].
      memory: at the start of the rollout, [B].
      env_params: observations are gathered from its tables.
    """
    observation = Observation(row=env_params.tables.rows[transitions.pose], goal=transitions.goal)
    pathways = policy.encode(observation, transitions.weights, transitions.reading, transitions.surroundings)
    replay_decisions = _replay_step_by_step if policy.recurrent else _replay_in_parallel
    decisions, counterfactual = replay_decisions(policy, pathways, transitions, memory)
    return Replay(policy, transitions, pathways, decisions, counterfactual, env_params)


def _replay_in_parallel(
    policy: Policy, pathways: Pathways, transitions: Transition, memory: PolicyState
) -> tuple[Decision, Decision]:
    """Evaluate all steps at once but for the recurrent core, which alone needs the memory."""
    pathways = mask_experience(pathways, transitions.use_experience)
    factual = mask_direct_pathways(pathways, transitions.use_direct)
    counterfactual = do(pathways, scene=0.0, goal=0.0)

    # Previous actions: that of the memory first, none where an episode begins.
    last_action = jnp.where(transitions.ended, NO_ACTION, transitions.action)
    previous_action = jnp.concatenate([memory.action[None], last_action[:-1]])

    # The factual branch runs the core through time. At every step the counterfactual one takes the same hidden state
    # (a constant, see `UnrolledGRU`), without the direct input.
    mediated_input = policy.mediated_input(pathways, previous_action)
    input_gates = policy.input_gates(policy.direct_input(factual) + mediated_input)
    core = unroll_gru(policy.recurrent_kernel, input_gates, transitions.ended, memory.hidden)
    counterfactual_hidden = gru_step(policy.input_gates(mediated_input), core.hidden_gates, core.hidden_before)
    decisions = policy.apply_heads(core.hidden_after, factual)
    return decisions, policy.apply_heads(counterfactual_hidden, counterfactual)


def _replay_step_by_step(
    policy: Policy, pathways: Pathways, transitions: Transition, memory: PolicyState
) -> tuple[Decision, Decision]:
    """Evaluate step by step where experience or adaptation need the memory."""
    fresh_memory = policy.initial_memory(memory.action.shape)

    def step(memory: PolicyState, inputs: tuple[Pathways, Any, Any, jax.Array, jax.Array]) -> tuple[PolicyState, Any]:
        encoded, use_direct, use_experience, action, ended = inputs
        memory = memory._replace(use_experience=use_experience)  # as drawn in the rollout
        factual = mask_direct_pathways(policy.attend(encoded, memory), use_direct)
        decision = policy.decide(factual, memory)

        # No gradient of the counterfactual branch enters the memory.
        fixed_memory = jax.lax.stop_gradient(memory)
        counterfactual_pathways = do(policy.attend(encoded, fixed_memory), scene=0.0, goal=0.0)
        counterfactual = policy.decide(counterfactual_pathways, fixed_memory)
        return select(ended, fresh_memory, decision.next_state(action)), (decision, counterfactual)

    inputs = (
        pathways,
        transitions.use_direct,
        transitions.use_experience,
        transitions.action,
        transitions.ended,
    )
    _, decisions = jax.lax.scan(step, memory, inputs)
    return decisions


def ppo_loss(
    replay: Replay, advantages: jax.Array, scalars: PPOScalars, distil: bool, method: Method
) -> tuple[jax.Array, Metrics]:
    """The clipped PPO loss over [T, B], and what is trained beside it.

    With `distil` the loss adds KL(stop_gradient(pi) || counterfactual); a method may add an auxiliary loss. Ignored
    choices are masked out. Values are learned at every step, for a rollout may end within a macro-action.

    Args:
      replay: decisions with the parameters to differentiate by.
      advantages: float32 [T, B].
      scalars: weights and the clip.
      distil: whether the counterfactual branch is trained.
      method: may bring an auxiliary loss.

    Returns:
      The loss float32 [] and its parts by name.
    """
    transitions = replay.transitions
    is_decision_step = transitions.is_decision_step
    log_probs = jax.nn.log_softmax(replay.factual.logits)
    log_prob = jnp.take_along_axis(log_probs, transitions.choice[..., None], axis=-1)[..., 0]

    # Policy: the clipped surrogate with normalised advantages.
    ratio = jnp.exp(log_prob - transitions.log_prob)
    value_target = advantages + transitions.value
    mean, deviation = mean_and_std(advantages, is_decision_step)
    normalised_advantages = (advantages - mean) / (deviation + 1e-8)
    clipped_ratio = jnp.clip(ratio, 1.0 - scalars.clip, 1.0 + scalars.clip)
    surrogate = jnp.minimum(ratio * normalised_advantages, clipped_ratio * normalised_advantages)
    policy_loss = -masked_mean(surrogate, is_decision_step)

    # Value and entropy.
    value_loss = 0.5 * jnp.square(replay.factual.value - value_target).mean()
    entropy = -masked_mean((jnp.exp(log_probs) * log_probs).sum(axis=-1), is_decision_step)
    loss = policy_loss + scalars.value * value_loss - scalars.entropy * entropy
    parts = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}

    # The counterfactual branch, and whatever the method adds.
    if distil:
        distil_loss = _distillation_loss(log_probs, replay.counterfactual.logits, is_decision_step)
        loss = loss + scalars.distil * distil_loss
        parts["distil_loss"] = distil_loss
    if method.auxiliary is not None:
        auxiliary_loss, auxiliary_parts = method.auxiliary(replay)
        loss = loss + auxiliary_loss
        parts = parts | auxiliary_parts
    return loss, parts


def _distillation_loss(
    log_probs: jax.Array, counterfactual_logits: jax.Array, is_decision_step: jax.Array | None
) -> jax.Array:
    """Mean KL(pi || counterfactual), pi fixed."""
    target = jax.lax.stop_gradient(log_probs)
    divergence = (jnp.exp(target) * (target - jax.nn.log_softmax(counterfactual_logits))).sum(axis=-1)
    return masked_mean(divergence, is_decision_step)


# 4. Update


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam behind a clip by the global norm; a step whose gradient is not finite is skipped and counted."""
    chain = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
    return optax.apply_if_finite(chain, max_consecutive_errors=2**30)


def reset_optimizer_if(config: PPOConfig, optimizer: Any, policy_params: Params, condition: jax.Array) -> Any:
    """Reset the optimizer state where a condition, bool [], holds; the count of skipped steps goes on.

    Adam's bias correction uses one step count, so parameters that begin to learn late would take too large steps.
    """
    fresh: Any = make_optimizer(config).init(policy_params)
    inner_state = jax.tree.map(
        lambda new_leaf, old_leaf: jnp.where(condition, new_leaf, old_leaf), fresh.inner_state, optimizer.inner_state
    )
    return optimizer._replace(inner_state=inner_state)


def apply_gradient(
    config: PPOConfig,
    policy_params: Params,
    optimizer: Any,
    gradient: Params,
    learning_rate: jax.Array,
    lr_scale_by_path: Callable[[tuple[str, ...]], float] | None = None,
) -> tuple[Params, Any]:
    """Take one step of the optimizer.

    Args:
      config: of the optimizer.
      policy_params: parameters before the step.
      optimizer: its state.
      gradient: by the parameters.
      learning_rate: float32 [].
      lr_scale_by_path: factor on the learning rate of the parameter at a path of names, 0 for one that is frozen; None
        for 1.

    Returns:
      Parameters and optimizer state after the step.
    """
    # Frozen parameters neither move nor count in the gradient's norm.
    if lr_scale_by_path is not None:
        gradient = _scale_by_path(gradient, lambda path: float(lr_scale_by_path(path) > 0))

    with jax.numpy_dtype_promotion("standard"):  # optax counts in int32 beside float32
        updates, optimizer = make_optimizer(config).update(gradient, optimizer, policy_params)

    # Momentum can still move frozen parameters, and the factors apply to steps.
    if lr_scale_by_path is not None:
        updates = _scale_by_path(updates, lr_scale_by_path)
    policy_params = jax.tree.map(lambda param, update: param - learning_rate * update, policy_params, updates)
    return policy_params, optimizer


def _scale_by_path(tree: Any, scale: Callable[[tuple[str, ...]], float]) -> Any:
    """Multiply leaves by a factor of their path; a factor of 0 gives zeros, also of leaves that are not finite."""

    def scale_leaf(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        factor = float(scale(tuple(str(entry.key) for entry in path)))
        return factor * leaf if factor else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(scale_leaf, tree)


def draw_minibatches(key: jax.Array, num_envs: int, num_minibatches: int) -> jax.Array:
    """Draw the slots of each minibatch, one of every block of `num_minibatches` neighbours.

    No device then needs the slots of another.

    Returns:
      int32 [blocks, minibatches]; minibatch m takes the slot `num_minibatches * b + order[b, m]` of every block b.
    """
    offsets = jnp.broadcast_to(jnp.arange(num_minibatches), (num_envs // num_minibatches, num_minibatches))
    return jax.random.permutation(key, offsets, axis=1, independent=True)


def split_minibatches(tree: Any, order: jax.Array, axis: int) -> Any:
    """Split leaves [..., B, ...] into minibatches [M, ..., B / M, ...].

    Args:
      tree: leaves with the episodes along `axis`.
      order: as from `draw_minibatches`.
      axis: of the episodes.
    """

    def split_leaf(leaf: jax.Array) -> jax.Array:
        blocks = leaf.reshape(*leaf.shape[:axis], *order.shape, *leaf.shape[axis + 1 :])
        other_axes = [*range(axis), *range(axis + 2, blocks.ndim)]
        shuffled = jnp.take_along_axis(blocks, jnp.expand_dims(order, other_axes), axis + 1)
        return jnp.moveaxis(shuffled, axis + 1, 0)

    return jax.tree.map(split_leaf, tree)


class BestPolicy(struct.PyTreeNode):
    """The best policy of a seed so far.

    Attributes:
      params: of the policy.
      score: float32 [], see `Learner.keep`; -1 before anything was measured.
      update: int32 [], updates done when it was measured.
    """

    params: Params
    score: jax.Array
    update: jax.Array


class LearnerState(struct.PyTreeNode):
    """State of one training seed.

    Attributes:
      params: of the policy.
      best: the policy to export, where validation measures policies during training.
      optimizer: state of the optimizer.
      agent: the parallel episodes, [B].
      key: typed PRNG key []; update u uses `fold_in(key, u)`.
      update: int32 [], updates done.
    """

    params: Params
    best: BestPolicy
    optimizer: Any
    agent: Agent
    key: jax.Array
    update: jax.Array


@dataclasses.dataclass(frozen=True)
class Learner:
    """PPO for one stage of training: all that is static during a run.

    Attributes:
      agent_loop: runs policy and environment.
      config: sizes and static settings; the fields of `PPOScalars` are read from the traced argument of `train`.
      counterfactual: how the counterfactual branch is trained.
      stage: loss, schedules and frozen parameters of this part of training.
    """

    agent_loop: AgentLoop
    config: PPOConfig
    counterfactual: Counterfactual
    stage: Stage = Stage()

    def init(self, key: jax.Array, env_params: EnvParams, knowledge: Knowledge) -> LearnerState:
        """Start a seed; the key is consumed."""
        init_key = jax.random.fold_in(key, _INIT)
        start_key = jax.random.fold_in(key, _START)
        update_key = jax.random.fold_in(key, _UPDATES)

        assert self.agent_loop.spec is not None
        policy_params = init_params(self.agent_loop.spec, init_key)
        return LearnerState(
            params=policy_params,
            best=BestPolicy(params=policy_params, score=jnp.float32(-1.0), update=jnp.int32(0)),
            optimizer=make_optimizer(self.config).init(policy_params),
            agent=self._start_episodes(policy_params, start_key, env_params, knowledge),
            key=update_key,
            update=jnp.int32(0),
        )

    def restart(self, state: LearnerState, env_params: EnvParams, knowledge: Knowledge) -> LearnerState:
        """Start new episodes, in scenes other than before."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, state.update), _RESTART)
        return state.replace(agent=self._start_episodes(state.params, key, env_params, knowledge))

    def keep(self, state: LearnerState, score: jax.Array) -> LearnerState:
        """Keep the present policy as the best if none scored higher; the score is float32 []."""
        present = BestPolicy(state.params, score, state.update)
        is_better = score >= state.best.score
        best = jax.tree.map(lambda new_leaf, old_leaf: jnp.where(is_better, new_leaf, old_leaf), present, state.best)
        return state.replace(best=best)

    def train(
        self,
        state: LearnerState,
        scalars: PPOScalars,
        env_params: EnvParams,
        knowledge: Knowledge,
        num_updates: int,
    ) -> tuple[LearnerState, Metrics]:
        """Do some updates.

        Returns:
          The state after them and float32 [] metrics: the losses' means over the updates, `success`, `return`
          (undiscounted, without shaping), `length` and `truncated` averaged over the `episodes` that ended, and the
          number of `skipped_steps` of the optimizer whose gradient was not finite.
        """

        def step(state: LearnerState, _: None) -> tuple[LearnerState, Metrics]:
            return self.update(state, scalars, env_params, knowledge)

        begins_stage = state.update.astype(jnp.float32) == scalars.begin
        optimizer = reset_optimizer_if(self.config, state.optimizer, state.params, begins_stage)
        state, metrics = jax.lax.scan(step, state.replace(optimizer=optimizer), None, length=num_updates)

        # Sums over episodes become means per episode, losses means per update.
        totals = {name: value.sum() for name, value in metrics.items()}
        num_episodes = totals.pop("episodes")
        num_skipped = totals.pop("skipped_steps")
        summary = {}
        for name in ("success", "return", "length", "truncated"):
            summary[name] = totals.pop(name) / jnp.maximum(num_episodes, 1.0)
        for name, value in totals.items():
            summary[name] = value / num_updates
        return state, summary | {"episodes": num_episodes, "skipped_steps": num_skipped}

    def update(
        self, state: LearnerState, scalars: PPOScalars, env_params: EnvParams, knowledge: Knowledge
    ) -> tuple[LearnerState, Metrics]:
        """Collect a rollout and learn from it for some epochs."""
        update_key = jax.random.fold_in(state.key, state.update)
        rollout_key = jax.random.fold_in(update_key, _ROLLOUT)
        shuffle_key = jax.random.fold_in(update_key, _SHUFFLE)

        # Fast weights may be large: in a stage without adaptation they are set aside, and put back after the rollout.
        agent = state.agent
        fast_weights = policy_memory(agent).fast
        if not self.stage.adapts_online:
            agent = _with_fast_weights(agent, None)
        agent, rollout = collect_rollout(
            self._stage_agent_loop,
            self._stage_agent_loop.bind(state.params),
            agent,
            rollout_key,
            self.config.rollout,
            self.counterfactual == "coin",
            env_params,
            knowledge,
            experience_prob=0.0 if self.stage.direct_stream_only else scalars.experience,
            redraw_every_step=self.config.experience_drawn == "step",
        )
        if not self.stage.adapts_online:
            agent = _with_fast_weights(agent, fast_weights)

        (policy_params, optimizer), losses = self._learn(state, rollout, shuffle_key, scalars, env_params)

        # Losses are means over the minibatches, statistics of episodes are sums.
        metrics = {name: value.mean() for name, value in losses.items()}
        metrics = metrics | _episode_sums(rollout.transitions, env_params)
        num_skipped = optimizer.total_notfinite - state.optimizer.total_notfinite
        metrics["skipped_steps"] = num_skipped.astype(jnp.float32)
        state = state.replace(params=policy_params, optimizer=optimizer, agent=agent, update=state.update + 1)
        return state, metrics

    def _learn(
        self, state: LearnerState, rollout: Rollout, key: jax.Array, scalars: PPOScalars, env_params: EnvParams
    ) -> tuple[tuple[Params, Any], Metrics]:
        """Take a gradient step for every minibatch of every epoch."""
        config = self.config
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

        # Schedules: both are linear within the stage.
        progress = (state.update.astype(jnp.float32) - scalars.begin) / scalars.num_updates
        learning_rate = scalars.learning_rate * (1.0 - progress)
        entropy_weight = scalars.entropy + progress * (scalars.final_entropy - scalars.entropy)
        scalars = scalars.replace(entropy=entropy_weight)

        # Devices share the slots of a minibatch, and average loss and gradient. The specs are those of policy_params,
        # minibatch (transitions, memory, advantages), env_params and scalars.
        everywhere = PartitionSpec()
        by_time = PartitionSpec(None, EPISODE_AXIS)
        minibatch_specs = by_time, PartitionSpec(EPISODE_AXIS), by_time
        gradient_of_loss = mean_over_devices(
            jax.grad(self._loss, has_aux=True), everywhere, minibatch_specs, everywhere, everywhere
        )

        def minibatch_step(carry: tuple[Params, Any], minibatch: tuple[Any, ...]) -> tuple[tuple[Params, Any], Metrics]:
            policy_params, optimizer = carry
            gradient, losses = gradient_of_loss(policy_params, minibatch, env_params, scalars)
            carry = apply_gradient(
                config, policy_params, optimizer, gradient, learning_rate, self.stage.lr_scale_by_path
            )
            return carry, losses | {"gradient_norm": optax.tree.norm(gradient)}

        def epoch(carry: tuple[Params, Any], epoch_key: jax.Array) -> tuple[tuple[Params, Any], Metrics]:
            order = draw_minibatches(epoch_key, config.num_envs, config.minibatches)
            steps, step_advantages = split_minibatches((transitions, advantages), order, axis=1)
            memory = split_minibatches(rollout.memory, order, axis=0)
            return jax.lax.scan(minibatch_step, carry, (steps, memory, step_advantages))

        epoch_keys = jax.random.split(key, config.epochs)
        return jax.lax.scan(epoch, (state.params, state.optimizer), epoch_keys)

    def _loss(
        self, policy_params: Params, minibatch: tuple[Any, ...], env_params: EnvParams, scalars: PPOScalars
    ) -> tuple[jax.Array, Metrics]:
        """The stage's loss on a minibatch (transitions, memory, advantages)."""
        transitions, memory, advantages = minibatch
        assert self.agent_loop.method is not None
        replay = replay_rollout(self._stage_agent_loop.bind(policy_params), transitions, memory, env_params)
        loss_fn = self.stage.loss or ppo_loss
        return loss_fn(replay, advantages, scalars, self.counterfactual == "distil", self.agent_loop.method)

    def _start_episodes(
        self, policy_params: Params, key: jax.Array, env_params: EnvParams, knowledge: Knowledge
    ) -> Agent:
        """Start the parallel episodes, and draw which of them have experience."""
        num_envs = self.config.num_envs
        experience_prob = 0.0 if self.stage.direct_stream_only else self.config.experience
        memory = self.agent_loop.bind(policy_params).initial_memory((num_envs,))
        dropout_key = jax.random.fold_in(key, _START_DROPOUT)
        memory = sample_experience_dropout(memory, True, dropout_key, experience_prob)
        return self.agent_loop.start(key, num_envs, memory, knowledge, env_params)

    @property
    def _stage_agent_loop(self) -> AgentLoop:
        """The agent loop of the stage, with or without adaptation."""
        return dataclasses.replace(self.agent_loop, inner_steps=None if self.stage.adapts_online else 0)


def _with_fast_weights(agent: Agent, fast_weights: Any) -> Agent:
    """Replace the fast weights in the agents' memories."""
    return agent._replace(memory=policy_memory(agent)._replace(fast=fast_weights))


def _episode_sums(transitions: Transition, env_params: EnvParams) -> Metrics:
    """Sum the statistics of the episodes that ended, float32 [] each."""
    ended = transitions.ended
    statistics = ended, transitions.success, transitions.length, transitions.truncated
    # One array, which devices exchange at once.
    table = jnp.stack([values.astype(jnp.float32) for values in statistics])
    episodes, success, length, truncated = jnp.where(ended, table, 0.0).sum(axis=(1, 2))

    # Every step but a successful Done costs the same, so the return (without shaping) follows from length and success.
    return_sum = env_params.success_reward * success + env_params.step_reward * (length - success)
    return {
        "episodes": episodes,
        "success": success,
        "length": length,
        "truncated": truncated,
        "return": return_sum,
    }
