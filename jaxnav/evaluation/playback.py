"""Replays: evaluation episodes played step by step, with everything that the policy saw and decided.

`play_episodes` returns one `EpisodeTrace` per episode. Use `jaxnav.evaluation.grid` for metrics of many episodes.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, State
from jaxnav.evaluation.grid import infer_and_act
from jaxnav.evaluation.removal import InferenceConfig, InferenceTrace
from jaxnav.evaluation.replacements import DecisionContext
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.agent_loop import Agent, AgentLoop, policy_memory
from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.network import Params
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.scenes.task import Rules


class EpisodeTrace(NamedTuple):
    """The T decisions of one episode.

    Attributes:
      pose: int32 [T], pose at which each action was chosen.
      action: int32 [T]; only the last can be Done.
      inferred: removal of experience and probabilities behind each action, leaves [T, ...].
      success: True if the episode ended with a successful Done.
    """

    pose: np.ndarray
    action: np.ndarray
    inferred: InferenceTrace
    success: bool

    @property
    def gap(self) -> np.ndarray:
        """Layout gap D, float32 [T]."""
        return np.asarray(self.inferred.gap)


def make_percepts(trace: EpisodeTrace, rows: np.ndarray, rules: Rules, goal: int) -> Percept:
    """Make the inputs of a tracker in an episode.

    Args:
      trace: episode of T steps.
      rows: uint8 [T, N], observation rows of its poses.
      rules: rules of the task.
      goal: index of the category that was sought.

    Returns:
      Leaves [T, ...].
    """
    cell, heading, horizon = rules.split_pose(trace.pose)
    # A percept holds the previous action; the first percept has none.
    has_moved = np.concatenate([[False], np.diff(cell) != 0])
    earlier_actions = jnp.asarray(trace.action[:-1], jnp.int32)
    return Percept(
        row=jnp.asarray(rows),
        heading=jnp.asarray(heading),
        action=jnp.concatenate([jnp.array([NO_ACTION], jnp.int32), earlier_actions]),
        moved=jnp.asarray(has_moved),
        horizon=jnp.asarray(horizon),
        goal=jnp.full(len(heading), goal, jnp.int32),
    )


class _Step(NamedTuple):
    """One step of E episodes, leaves [E, ...]; meaningless for episodes that were not running before the step."""

    pose: jax.Array
    action: jax.Array
    inferred: InferenceTrace
    success: jax.Array
    running: jax.Array


def play_episodes(
    config: InferenceConfig,
    policy_params: Params,
    initial_states: State,
    agent_loop: AgentLoop,
    env_params: EnvParams,
    knowledge: Knowledge,
) -> list[EpisodeTrace]:
    """Play episodes to their ends, step by step.

    Args:
      config: configuration of the inference, leaves []; `policy_index` is not used.
      policy_params: parameters of the policy.
      initial_states: initial states of the episodes, leaves [E].
      agent_loop: environment, policy and layout estimator.
      env_params: parameters of the environment.
      knowledge: layout priors and statistics from before training.
    """
    # A fixed key per episode, so that a replay is the same every time.
    num_episodes = len(initial_states.pose)
    episode_keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), jnp.arange(num_episodes))
    agent = _begin(policy_params, initial_states, agent_loop, env_params, knowledge)
    running = jnp.ones(num_episodes, bool)

    # All episodes are stepped together until the longest has ended. Steps [E, ...] move to the host one by one.
    host_steps = []
    while running.any():
        agent, running, step = _step(
            config, policy_params, agent, running, episode_keys, agent_loop, env_params, knowledge
        )
        host_steps.append(jax.tree.map(np.asarray, step))

    # Stack the steps along a time axis, and cut out the steps of each episode.
    all_steps = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *host_steps)  # [E, T, ...]
    return [_episode_trace(all_steps, episode) for episode in range(num_episodes)]


def _episode_trace(all_steps: _Step, episode: int) -> EpisodeTrace:
    """Cut the steps at which one episode was running out of steps [E, T, ...]."""
    # Success is that of the last running step; the steps after it are meaningless.
    is_running = all_steps.running[episode]
    episode_steps = jax.tree.map(lambda leaf: leaf[episode][is_running], all_steps)
    return EpisodeTrace(
        episode_steps.pose, episode_steps.action, episode_steps.inferred, bool(episode_steps.success[-1])
    )


@functools.partial(jax.jit, static_argnames="agent_loop")
def _begin(
    policy_params: Params, initial_states: State, agent_loop: AgentLoop, env_params: EnvParams, knowledge: Knowledge
) -> Agent:
    initial_memory = agent_loop.bind_decider(policy_params).initial_memory(initial_states.pose.shape)
    return agent_loop.start_from(initial_states, initial_memory, knowledge, env_params)


@functools.partial(jax.jit, static_argnames="agent_loop")
def _step(
    config: InferenceConfig,
    policy_params: Params,
    agent: Agent,
    running: jax.Array,
    episode_keys: jax.Array,
    agent_loop: AgentLoop,
    env_params: EnvParams,
    knowledge: Knowledge,
) -> tuple[Agent, jax.Array, _Step]:
    """Act once in the running episodes.

    Returns:
      The agents after the step, which episodes still run, and the step.
    """
    # Act in all episodes, including those that have ended: shapes stay fixed.
    policy = agent_loop.bind_decider(policy_params)
    context = DecisionContext(policy, config.use_layout, agent_loop, knowledge, env_params)
    next_agent, step_result, inferred = infer_and_act(config, context, agent, running, episode_keys)

    # Record the pose before the action, so that a trace pairs each action with the view it was chosen from.
    recorded_step = _Step(
        pose=agent.state.pose,
        action=policy_memory(step_result.agent).action,
        inferred=inferred,
        success=step_result.success,
        running=running,
    )

    # Agents of ended episodes stay as they were.
    return tree_where(running, next_agent, agent), running & ~step_result.ended, recorded_step
