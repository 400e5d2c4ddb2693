"""The evaluation grid: every variant, epsilon and seed over every episode, in one compiled call.

A grid is an `InferenceConfig` with leaves [C]. `Evaluator` runs its cells one after the other (`lax.map`), and in each
the E episodes of a list side by side until the last one has ended (`_run_episodes`). One step is `infer_and_act`:
decide, remove experience, choose, act. (A choice is an action unless the method has macro-actions.) `episode_metrics`
turns the outcomes into SR, SPL, SAE and DTS.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.removal import InferenceConfig, InferenceTrace, apply_removal, counterfactual_logits, select_gap
from jaxnav.policies.agent_loop import Agent, AgentLoop, StepResult, decide, policy_memory, select
from jaxnav.policies.handover import Decider
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params
from jaxnav.scenes.task import MOVE_AHEAD

Tree = TypeVar("Tree")

#: Metres that DTS subtracts from the distance to the goal.
GOAL_RADIUS = 1.0
#: Few episodes are long: once at most 1 / divisor of the episodes still run, the batch shrinks to that size.
_BATCH_DIVISORS = (2, 4, 16)


class EpisodeOutcome(NamedTuple):
    """Outcome of episodes, leaves [C, E].

    Attributes:
      done: bool, ended by Done; False for a time-out.
      success: bool.
      length: int32, actions taken, Done included.
      moves: int32, MoveAheads chosen.
      distance: float32, metres from the last cell to the nearest goal object's centre.
      choices: int32, number of decision steps: all steps unless the method has macro-actions.
      mean_weight: float32, mean weight of the removed logits over these steps.
    """

    done: jax.Array
    success: jax.Array
    length: jax.Array
    moves: jax.Array
    distance: jax.Array
    choices: jax.Array
    mean_weight: jax.Array

    @classmethod
    def start(cls, shape: tuple[int, ...]) -> "EpisodeOutcome":
        """Return the outcome of episodes before their first step."""
        return cls(
            done=jnp.zeros(shape, bool),
            success=jnp.zeros(shape, bool),
            length=jnp.zeros(shape, jnp.int32),
            moves=jnp.zeros(shape, jnp.int32),
            distance=jnp.zeros(shape),
            choices=jnp.zeros(shape, jnp.int32),
            mean_weight=jnp.zeros(shape),
        )

    def add_step(
        self,
        running: jax.Array,
        action: jax.Array,
        result: StepResult,
        weight: jax.Array,
        is_decision_step: jax.Array | None = None,
    ) -> "EpisodeOutcome":
        """Add one step; until the end `mean_weight` is the sum of the weights.

        Args:
          running: bool, before the step.
          action: int32, taken.
          result: of the step.
          weight: float32, of the removed logits.
          is_decision_step: bool, False where a macro-action was running and the choice was ignored; None where choices
            are actions.
        """
        counted = running if is_decision_step is None else running & is_decision_step
        return self._replace(
            done=self.done | (running & result.terminated),
            success=self.success | (running & result.success),
            length=self.length + running.astype(jnp.int32),
            moves=self.moves + (running & (action == MOVE_AHEAD)).astype(jnp.int32),
            choices=self.choices + counted.astype(jnp.int32),
            mean_weight=self.mean_weight + jnp.where(counted, weight, 0.0),
        )


class _Batch(NamedTuple):
    """Episodes that are run side by side, leaves [B, ...]."""

    agent: Agent
    running: jax.Array
    outcome: EpisodeOutcome
    episode_keys: jax.Array


class Evaluator:
    """Evaluation of grids; those of equal shape share a compilation.

    Attributes:
      compilations: number of compilations so far.
    """

    def __init__(self, agent_loop: AgentLoop, can_remove: bool = True) -> None:
        """Prepare the compiled function.

        Args:
          agent_loop: environment, policy and layout estimator.
          can_remove: whether experience may be removed; without, only the factual decision is compiled, in half the
            time.
        """
        self.compilations = 0
        self._agent_loop = agent_loop
        self._can_remove = can_remove
        self._compiled_run = jax.jit(self._run_grid)

    def __call__(
        self,
        grid: InferenceConfig,
        policy_params: Params,
        parts: Iterable[tuple[EpisodeList, EnvParams]],
        knowledge: Knowledge,
        key: jax.Array,
    ) -> EpisodeOutcome:
        """Run every cell of a grid over every episode.

        Args:
          grid: leaves [C].
          policy_params: parameters of all policies, leaves [N, ...].
          parts: episodes, E in all, with the parameters of the environment where they take place, bank by bank.
          knowledge: learned before training.
          key: of sampled actions and of the controls, folded with part, policy index, episode and time: cells of one
            policy share random numbers.

        Returns:
          The outcomes [C, E]. One compilation serves all parts of equal shape.
        """
        outcomes = []
        for part_index, (episodes, env_params) in enumerate(parts):
            part_key = jax.random.fold_in(key, part_index)
            start = start_states(episodes)
            outcome = self._compiled_run(grid, policy_params, start, env_params, knowledge, part_key)
            outcomes.append(jax.tree.map(np.asarray, outcome))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *outcomes)

    def _run_grid(
        self,
        grid: InferenceConfig,
        policy_params: Params,
        start: State,
        env_params: EnvParams,
        knowledge: Knowledge,
        key: jax.Array,
    ) -> EpisodeOutcome:
        self.compilations += 1  # traced once per shape

        def run_cell(config: InferenceConfig) -> EpisodeOutcome:
            cell_params = jax.tree.map(lambda leaf: leaf[config.policy_index], policy_params)
            policy = self._agent_loop.decider(cell_params)
            return _run_episodes(config, policy, start, self._agent_loop, self._can_remove, env_params, knowledge, key)

        return jax.lax.map(run_cell, grid)


def start_states(episodes: EpisodeList) -> State:
    """Return the states that episodes start in, leaves [E]."""
    return State(
        pose=jnp.asarray(episodes.pose),
        scene=jnp.asarray(episodes.scene),
        goal=jnp.asarray(episodes.goal),
        time=jnp.zeros(len(episodes.pose), jnp.int32),
    )


def _run_episodes(
    config: InferenceConfig,
    policy: Decider,
    start: State,
    agent_loop: AgentLoop,
    can_remove: bool,
    env_params: EnvParams,
    knowledge: Knowledge,
    key: jax.Array,
) -> EpisodeOutcome:
    """Run the episodes of one cell until the last one has ended."""
    num_episodes = len(start.pose)
    policy_key = jax.random.fold_in(key, config.policy_index)
    episode_keys = jax.vmap(lambda episode: jax.random.fold_in(policy_key, episode))(jnp.arange(num_episodes))

    def step(batch: _Batch) -> _Batch:
        next_agent, result, trace = infer_and_act(
            config,
            policy,
            batch.agent,
            batch.running,
            batch.episode_keys,
            agent_loop,
            env_params,
            knowledge,
            can_remove,
        )
        action = policy_memory(result.agent).action
        is_decision_step = agent_loop.is_decision_step(batch.agent)
        outcome = batch.outcome.add_step(batch.running, action, result, trace.weight, is_decision_step)
        return _Batch(
            agent=select(batch.running, next_agent, batch.agent),
            running=batch.running & ~result.ended,
            outcome=outcome,
            episode_keys=batch.episode_keys,
        )

    def run_until(batch: _Batch, max_running: int) -> _Batch:
        return jax.lax.while_loop(lambda batch: batch.running.sum() > max_running, step, batch)

    # Start all episodes in one batch.
    memory = policy.initial_memory((num_episodes,))
    batch = _Batch(
        agent=agent_loop.begin(start, memory, knowledge, env_params),
        running=jnp.ones(num_episodes, bool),
        outcome=EpisodeOutcome.start((num_episodes,)),
        episode_keys=episode_keys,
    )
    batch_ids = jnp.arange(num_episodes)
    results = batch.outcome, start  # outcomes and last states of all episodes

    # Carry on with ever smaller batches: whenever enough episodes have ended, keep only those that still run.
    smaller_sizes = [num_episodes // divisor for divisor in _BATCH_DIVISORS if num_episodes >= divisor]
    for next_size in (*smaller_sizes, 0):
        batch = run_until(batch, max_running=next_size)
        results = _write_rows(results, batch_ids, (batch.outcome, batch.agent.state))
        kept_rows = jnp.argsort(~batch.running)[:next_size]  # running episodes first
        batch_ids = batch_ids[kept_rows]
        batch = _take_rows(batch, kept_rows)

    # Distances are those of the last cells; weights were added up.
    outcome, last_state = results
    num_choices = jnp.maximum(outcome.choices, 1).astype(jnp.float32)
    last_cell = agent_loop.env.cell_of_pose(last_state.pose)
    return outcome._replace(
        distance=env_params.tables.goal_distance[last_cell, last_state.goal],
        mean_weight=outcome.mean_weight / num_choices,
    )


def _write_rows(table: Any, rows: jax.Array, values: Any) -> Any:
    """Write leaves [B, ...] into rows int [B] of leaves [E, ...]."""
    return jax.tree.map(lambda leaf, value: leaf.at[rows].set(value), table, values)


def _take_rows(table: Tree, rows: jax.Array) -> Tree:
    """Take rows int [B] of leaves [E, ...]."""
    return jax.tree.map(lambda leaf: leaf[rows], table)


def infer_and_act(
    config: InferenceConfig,
    policy: Decider,
    agent: Agent,
    running: jax.Array,
    episode_keys: jax.Array,
    agent_loop: AgentLoop,
    env_params: EnvParams,
    knowledge: Knowledge,
    can_remove: bool = True,
) -> tuple[Agent, StepResult, InferenceTrace]:
    """Decide, remove experience, choose and act: one step of each of E episodes.

    Args:
      config: of the grid cell.
      policy: with the cell's parameters.
      agent: the episodes, [E].
      running: bool [E], episodes that have not ended.
      episode_keys: [E]; folded with the time for a sampled action.
      agent_loop: how to act.
      env_params: of the environment.
      knowledge: learned before training.
      can_remove: whether experience may be removed.

    Returns:
      The agent after the step, the result of the step, and how the action was inferred.
    """
    # Decide, with or without the layout's weights.
    view = agent_loop.view(agent, knowledge, env_params)
    view = view._replace(weights=jnp.where(config.use_layout, view.weights, 1.0))
    memory = policy_memory(agent)
    pathways, decision = decide(policy, view, memory)

    # Remove experience (eqs. 1, 2).
    step_keys = jax.vmap(jax.random.fold_in)(episode_keys, agent.state.time)
    logits = decision.logits
    counterfactual = decision.logits
    gap = agent_loop.gap(agent)
    weight = jnp.zeros(running.shape)
    if can_remove:
        counterfactual = counterfactual_logits(config, policy, pathways, memory, episode_keys, step_keys)
        gap = select_gap(config, gap, running, episode_keys, agent.state.time)
        logits, weight = apply_removal(config, logits, counterfactual, gap)
    logits = jnp.where(config.act_randomly, 0.0, logits)

    # Choose the best action or sample one, then act.
    sampled_choice = jax.vmap(jax.random.categorical)(step_keys, logits)
    choice = jnp.where(config.greedy, jnp.argmax(logits, axis=-1), sampled_choice).astype(jnp.int32)
    next_agent, result = agent_loop.step(agent, choice, knowledge, env_params, policy=policy, decision=decision)
    trace = InferenceTrace(view.weights, gap, weight, decision.logits, counterfactual, logits)
    return next_agent, result, trace


def episode_metrics(
    outcome: EpisodeOutcome, best_length: np.ndarray, budgets: Sequence[int] = ()
) -> dict[str, np.ndarray]:
    """Compute the metrics of every episode.

    Args:
      outcome: leaves [..., E].
      best_length: int [E], L*: actions of a shortest episode, Done included.
      budgets: numbers of actions; `sr@N` is success within N.

    Returns:
      float64 [..., E] by name: `sr`, `spl`, `sae`, `timeout` (no Done before the step limit) and `wrong_done` (Done
      where it fails), each in [0, 1], and `dts` in metres. Every episode succeeds, times out or ends by a wrong Done.
    """
    success = np.asarray(outcome.success, np.float64)
    done = np.asarray(outcome.done, np.float64)
    length = np.asarray(outcome.length)
    moves = np.asarray(outcome.moves)
    metrics = {
        "sr": success,
        "spl": success * best_length / length,
        "dts": np.maximum(np.asarray(outcome.distance, np.float64) - GOAL_RADIUS, 0.0),
        "sae": success * moves / np.maximum(length - 1, 1),
        "timeout": 1.0 - done,
        "wrong_done": done - success,
    }
    for budget in budgets:
        metrics[f"sr@{budget}"] = success * (length <= budget)
    return metrics
