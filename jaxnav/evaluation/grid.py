"""The evaluation grid: every variant, epsilon and seed over every episode, in one compiled call per bank of scenes.

A grid is an `InferenceConfig` with leaves [C], such as one entry for each table row and training seed. For each bank,
`Evaluator` runs the C entries one after the other (`lax.map`). For each entry it steps all E episodes of the bank as
one batch until every episode has ended (`_run_episodes`). One step is `infer_and_act`: decide, remove experience,
choose, act. The policy's *choice* is the action itself, except for methods with macro-actions, where one choice lasts
several steps. `episode_metrics` turns the outcomes into success rate (SR), success weighted by path length (SPL),
success weighted by action efficiency (SAE) and distance to success (DTS).
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, ObjectNav, State
from jaxnav.evaluation.episodes import EpisodeList, select_first_episodes
from jaxnav.evaluation.removal import (
    InferenceConfig,
    InferenceTrace,
    apply_removal,
    control_logits,
    select_gap,
)
from jaxnav.evaluation.replacements import (
    DecisionContext,
    ReplacedPart,
    apply_selected_part,
    embed_decision_inputs,
    other_running_episode,
    replace_part,
)
from jaxnav.numerics.trees import take_rows, tree_where
from jaxnav.policies.agent_loop import Agent, AgentLoop, StepResult, decide_counterfactually, policy_memory
from jaxnav.policies.handover import Decider
from jaxnav.policies.method import Knowledge
from jaxnav.policies.network import Params
from jaxnav.scenes.task import MOVE_AHEAD

Tree = TypeVar("Tree")

#: Metres that DTS subtracts from the distance to the goal.
GOAL_RADIUS = 1.0
#: Batch sizes, as divisors of E: once at most E / divisor episodes still run, the batch shrinks to that size.
_BATCH_DIVISORS = (3, 12)


class EpisodeOutcome(NamedTuple):
    """Outcome of episodes, leaves [...]; [C, E] for a grid.

    Attributes:
      done: bool, the agent chose Done; False for a time-out.
      success: bool, the agent chose Done where it succeeds.
      length: int32, number of actions, Done included.
      moves: int32, number of MoveAheads.
      distance: float32, metres from the final cell to the centre of the nearest goal object.
      num_decisions: int32, number of decision steps: all steps unless the method has macro-actions.
      total_weight: float32, sum of the weights of the removed logits over the decision steps.
    """

    done: jax.Array
    success: jax.Array
    length: jax.Array
    moves: jax.Array
    distance: jax.Array
    num_decisions: jax.Array
    total_weight: jax.Array

    @property
    def mean_weight(self) -> np.ndarray:
        """Mean weight of the removed logits over the decision steps of ended episodes, float32 [...] of NumPy."""
        return np.asarray(self.total_weight) / np.maximum(self.num_decisions, 1).astype(np.float32)

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> "EpisodeOutcome":
        """Outcome of episodes before their first step."""
        return cls(
            done=jnp.zeros(shape, bool),
            success=jnp.zeros(shape, bool),
            length=jnp.zeros(shape, jnp.int32),
            moves=jnp.zeros(shape, jnp.int32),
            distance=jnp.zeros(shape),
            num_decisions=jnp.zeros(shape, jnp.int32),
            total_weight=jnp.zeros(shape),
        )

    def add_step(
        self,
        running: jax.Array,
        action: jax.Array,
        result: StepResult,
        weight: jax.Array,
        is_decision_step: jax.Array | None = None,
    ) -> "EpisodeOutcome":
        """Add one step of every running episode.

        Args:
          running: bool [...], episodes that had not ended before the step.
          action: int32 [...], executed actions.
          result: result of the step.
          weight: float32 [...], weight of the removed logits.
          is_decision_step: bool [...], False where a macro-action was running and the choice was ignored; None if
            choices are actions.
        """
        # While a macro-action runs, the policy's output is ignored.
        is_decided = running if is_decision_step is None else running & is_decision_step
        return self._replace(
            done=self.done | (running & result.terminated),
            success=self.success | (running & result.success),
            length=self.length + running.astype(jnp.int32),
            moves=self.moves + (running & (action == MOVE_AHEAD)).astype(jnp.int32),
            num_decisions=self.num_decisions + is_decided.astype(jnp.int32),
            total_weight=self.total_weight + jnp.where(is_decided, weight, 0.0),
        )


class EpisodeBatch(NamedTuple):
    """Episodes that are run side by side, leaves [B, ...].

    Attributes:
      agent: the agents, with the states of their environments.
      running: bool [B], episodes that have not ended.
      outcome: outcomes so far.
      episode_keys: PRNG keys [B].
    """

    agent: Agent
    running: jax.Array
    outcome: EpisodeOutcome
    episode_keys: jax.Array


class Evaluator:
    """Evaluation of grids; one compilation serves all grids and banks of equal shapes.

    Attributes:
      compilations: number of compilations so far.
    """

    def __init__(
        self,
        agent_loop: AgentLoop,
        can_remove: bool = True,
        has_controls: bool = True,
        replaced_parts: tuple[ReplacedPart, ...] = (),
    ) -> None:
        """Prepare the compiled function.

        Args:
          agent_loop: environment, policy specification and layout estimator.
          can_remove: whether experience may be removed. False compiles only the factual decision, which halves the
            compilation time; the grid must then remove nothing.
          has_controls: whether grids may have the controls `direct_noise` and `removed_source`. False compiles faster.
          replaced_parts: parts that the entries of a grid may replace (`InferenceConfig.replaced_part`).
        """
        self.compilations = 0
        self._agent_loop = agent_loop
        self._infer_and_act = functools.partial(
            infer_and_act, can_remove=can_remove, has_controls=has_controls, replaced_parts=replaced_parts
        )
        self._compiled_run = jax.jit(self._run_grid)

    def __call__(
        self,
        grid: InferenceConfig,
        policy_params: Params,
        banks: Iterable[tuple[EpisodeList, EnvParams]],
        knowledge: Knowledge,
        key: jax.Array,
    ) -> EpisodeOutcome:
        """Run every entry of a grid over every episode.

        Args:
          grid: leaves [C].
          policy_params: parameters of all policies, leaves [N, ...].
          banks: for every bank of scenes, its episodes and its environment parameters; E episodes in total.
          knowledge: layout priors and statistics from before training.
          key: typed PRNG key []. Bank index, policy index, episode and time are folded in, so that all entries of one
            policy see the same random numbers.

        Returns:
          The outcomes, leaves [C, E].
        """
        outcomes = []
        for bank_index, (episodes, env_params) in enumerate(banks):
            bank_key = jax.random.fold_in(key, bank_index)
            initial_states = start_states(episodes)
            room_rank = jnp.asarray(episodes.room_rank)
            outcome = self._compiled_run(
                grid, policy_params, initial_states, room_rank, env_params, knowledge, bank_key
            )
            outcomes.append(jax.tree.map(np.asarray, outcome))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *outcomes)

    def _run_grid(
        self,
        grid: InferenceConfig,
        policy_params: Params,
        initial_states: State,
        room_rank: jax.Array,
        env_params: EnvParams,
        knowledge: Knowledge,
        key: jax.Array,
    ) -> EpisodeOutcome:
        """Run all entries of a grid over the episodes of one bank; jitted."""
        self.compilations += 1  # Python runs this line only while JAX traces

        def run_entry(config: InferenceConfig) -> EpisodeOutcome:
            entry_params = jax.tree.map(lambda leaf: leaf[config.policy_index], policy_params)
            policy = self._agent_loop.bind_decider(entry_params)
            return _run_episodes(
                config,
                policy,
                initial_states,
                room_rank,
                key,
                agent_loop=self._agent_loop,
                env_params=env_params,
                knowledge=knowledge,
                step_agents=self._infer_and_act,
            )

        return jax.lax.map(run_entry, grid)


def start_states(episodes: EpisodeList) -> State:
    """Initial states of episodes, leaves [E]."""
    return State(
        pose=jnp.asarray(episodes.pose),
        scene=jnp.asarray(episodes.scene),
        goal=jnp.asarray(episodes.goal),
        time=jnp.zeros(len(episodes.pose), jnp.int32),
    )


def _run_episodes(
    config: InferenceConfig,
    policy: Decider,
    initial_states: State,
    room_rank: jax.Array,
    key: jax.Array,
    *,
    agent_loop: AgentLoop,
    env_params: EnvParams,
    knowledge: Knowledge,
    step_agents: Callable[..., tuple[Agent, StepResult, InferenceTrace]],
) -> EpisodeOutcome:
    """Run all episodes of one grid entry until every episode has ended.

    `step_agents` takes one step of each episode: `infer_and_act` with the features that the evaluator compiles.
    """
    num_episodes = len(initial_states.pose)
    policy_key = jax.random.fold_in(key, config.policy_index)
    episode_keys = jax.vmap(lambda episode: jax.random.fold_in(policy_key, episode))(jnp.arange(num_episodes))

    context = DecisionContext(policy, config.use_layout, agent_loop, knowledge, env_params)

    def step(batch: EpisodeBatch) -> EpisodeBatch:
        next_agent, result, trace = step_agents(config, context, batch.agent, batch.running, batch.episode_keys)
        # The memory holds the executed action, which differs from the choice where the method has macro-actions.
        action = policy_memory(result.agent).action
        is_decision_step = agent_loop.is_decision_step(batch.agent)  # of the state before the step
        return advance_batch(batch, next_agent, action, result, trace.removal_weight, is_decision_step)

    # Start all episodes in one batch.
    memory = policy.initial_memory((num_episodes,))
    batch = EpisodeBatch(
        agent=agent_loop.start_from(initial_states, memory, knowledge, env_params),
        running=select_first_episodes(room_rank, config.max_room_episodes),
        outcome=EpisodeOutcome.zeros((num_episodes,)),
        episode_keys=episode_keys,
    )
    outcome, final_state = run_to_end(batch, step, lambda batch: batch.agent.state)
    return finish_outcome(outcome, final_state, agent_loop.env, env_params)


def advance_batch(
    batch: EpisodeBatch,
    next_agent: Agent,
    action: jax.Array,
    result: StepResult,
    weight: jax.Array,
    is_decision_step: jax.Array | None = None,
) -> EpisodeBatch:
    """Return a batch after one step of every running episode.

    Args:
      batch: the batch before the step.
      next_agent: agents after the step [B].
      action, result, weight, is_decision_step: see `EpisodeOutcome.add_step`.
    """
    outcome = batch.outcome.add_step(batch.running, action, result, weight, is_decision_step)
    # Ended episodes keep their state; their memories and beliefs are no longer used.
    state = tree_where(batch.running, next_agent.state, batch.agent.state)
    return batch._replace(
        agent=next_agent._replace(state=state), running=batch.running & ~result.ended, outcome=outcome
    )


def run_to_end(
    batch: EpisodeBatch,
    step: Callable[[EpisodeBatch], EpisodeBatch],
    select: Callable[[EpisodeBatch], Tree],
    divisors: Sequence[int] = _BATCH_DIVISORS,
) -> tuple[EpisodeOutcome, Tree]:
    """Step a batch of E episodes until all of them have ended.

    Args:
      batch: the episodes at their start.
      step: advances every running episode of a batch of any size.
      select: returns further leaves [B, ...] of a batch to keep of every episode.
      divisors: once at most E / divisor episodes still run, the batch shrinks to that size. Each size compiles the step
        anew; () keeps the whole batch, for steps that compile for longer than they run.

    Returns:
      The outcomes, leaves [E], before `finish_outcome`; and the selected leaves at the end of every episode, [E, ...].
    """
    num_episodes = len(batch.running)

    def run_until(batch: EpisodeBatch, max_running: int) -> EpisodeBatch:
        return jax.lax.while_loop(lambda batch: batch.running.sum() > max_running, step, batch)

    batch_ids = jnp.arange(num_episodes)
    episode_table = batch.outcome, select(batch)  # of all episodes; overwritten with the final ones

    # Carry on with ever smaller batches: whenever enough episodes have ended, keep only those that still run. The loop
    # is unrolled, one `while_loop` for each static batch size.
    smaller_sizes = [num_episodes // divisor for divisor in divisors if num_episodes >= divisor]
    for next_size in (*smaller_sizes, 0):
        batch = run_until(batch, max_running=next_size)
        episode_table = _write_rows(episode_table, batch_ids, (batch.outcome, select(batch)))
        kept_rows = jnp.argsort(~batch.running)[:next_size]  # running episodes first; ended ones may fill the rest
        batch_ids = batch_ids[kept_rows]
        batch = take_rows(batch, kept_rows)
    return episode_table


def finish_outcome(
    outcome: EpisodeOutcome, final_state: State, env: ObjectNav, env_params: EnvParams
) -> EpisodeOutcome:
    """Add the distance from the final cell, which DTS needs."""
    final_cell = env.cell_of_pose(final_state.pose)
    return outcome._replace(distance=env_params.tables.goal_distance[final_cell, final_state.goal])


def _write_rows(table: Tree, row_indices: jax.Array, values: Tree) -> Tree:
    """Copy of `table` (leaves [E, ...]) with the rows `row_indices`, int [B], set to `values` (leaves [B, ...])."""
    return jax.tree.map(lambda leaf, value: leaf.at[row_indices].set(value), table, values)


def infer_and_act(
    config: InferenceConfig,
    context: DecisionContext,
    agent: Agent,
    running: jax.Array,
    episode_keys: jax.Array,
    *,
    can_remove: bool = True,
    has_controls: bool = True,
    replaced_parts: tuple[ReplacedPart, ...] = (),
) -> tuple[Agent, StepResult, InferenceTrace]:
    """Decide, remove experience, choose and act: one step of each of E episodes.

    Args:
      config: configuration of the grid entry.
      context: the entry's policy, agent loop, knowledge and environment.
      agent: agents in E episodes, with the states of their environments.
      running: bool [E], episodes that have not ended.
      episode_keys: PRNG keys [E]; the time is folded in for a sampled action.
      can_remove: whether experience may be removed.
      has_controls: whether `config` may name the controls `direct_noise` and `removed_source`.
      replaced_parts: parts that `config.replaced_part` may name.

    Returns:
      The agents after the step [E], the result of the step, leaves [E], and the trace of the inference, leaves
      [E, ...].
    """
    # Embed the inputs of the decision; entries without the layout replace its weights by ones.
    policy, agent_loop = context.policy, context.agent_loop
    factual = embed_decision_inputs(agent, context)
    pathways, memory = factual.pathways, factual.memory

    # Replace a part of the decision, or of the counterfactual decision alone, by that of another episode.
    replaced_pathways, replaced_memory = pathways, memory
    if replaced_parts:
        partner = other_running_episode(running, episode_keys)
        replace = functools.partial(replace_part, partner=partner, factual=factual, context=context)
        replaced_pathways, replaced_memory = apply_selected_part(replaced_parts, config.replaced_part, replace)
        pathways, memory = jax.tree.map(
            functools.partial(jnp.where, config.replaces_factual),
            (replaced_pathways, replaced_memory),
            (pathways, memory),
        )
    decision = policy.decide(pathways, memory)

    # Remove experience (eqs. 1, 2).
    step_keys = jax.vmap(jax.random.fold_in)(episode_keys, agent.state.time)
    gap = agent_loop.layout_gap(agent)
    if can_remove:
        if has_controls:
            removed_logits = control_logits(config, policy, replaced_pathways, replaced_memory, episode_keys, step_keys)
        else:
            removed_logits = decide_counterfactually(policy, replaced_pathways, replaced_memory).logits
        gap = select_gap(config, gap, running, episode_keys, agent.state.time)
        logits, removal_weight = apply_removal(config, decision.logits, removed_logits, gap, policy.has_additive_scores)
    else:
        removed_logits = decision.logits
        logits = decision.logits
        removal_weight = jnp.zeros(running.shape)

    # The random agent: equal logits.
    logits = jnp.where(config.act_randomly, 0.0, logits)

    # Choose the best action or sample one, then act.
    sampled_choice = jax.vmap(jax.random.categorical)(step_keys, logits)
    choice = jnp.where(config.greedy, jnp.argmax(logits, axis=-1), sampled_choice).astype(jnp.int32)
    next_agent, result = agent_loop.step(
        agent, choice, context.knowledge, context.env_params, policy=policy, decision=decision
    )
    trace = InferenceTrace(
        layout_weights=factual.inputs.layout_weights,
        gap=gap,
        removal_weight=removal_weight,
        factual_logits=decision.logits,
        removed_logits=removed_logits,
        action_logits=logits,
    )
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
      float64 [..., E] by name, each in [0, 1] but `dts`:
        `sr`: success;
        `spl`: success * L* / length;
        `sae`: success * MoveAheads / actions before Done;
        `dts`: max(distance to the goal - 1 m, 0), in metres;
        `timeout`: the step limit was reached without Done;
        `wrong_done`: Done was chosen where the goal is not reached.
      Every episode succeeds, times out or ends by a wrong Done.
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
