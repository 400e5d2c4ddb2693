"""The evaluation grid: every variant, epsilon and seed in one compiled call."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.inference import Inference, Inferred, counterfactual_logits, gap_used, remove
from jaxnav.policies.acting import Acting, Agent, Taken, carried, select
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.pair import Decider
from jaxnav.policies.policy import Params
from jaxnav.scenes.task import MOVE_AHEAD


class Outcome(NamedTuple):
    """Hold how episodes went, leaves [C, E].

    Attributes:
      done: bool, ended by Done; False for a time-out.
      success: bool.
      length: int32, actions taken, Done included.
      moves: int32, MoveAheads chosen.
      distance: float32, metres from the last cell to the nearest goal object's centre.
      choices: int32, steps at which what the policy chose counted; all of them unless a control takes its time.
      weight: float32, mean weight of the counterfactual logits over these steps.
    """

    done: jax.Array
    success: jax.Array
    length: jax.Array
    moves: jax.Array
    distance: jax.Array
    choices: jax.Array
    weight: jax.Array

    @classmethod
    def start(cls, shape: tuple[int, ...]) -> "Outcome":
        """Return the outcome of episodes before their first step."""
        return cls(
            done=jnp.zeros(shape, bool),
            success=jnp.zeros(shape, bool),
            length=jnp.zeros(shape, jnp.int32),
            moves=jnp.zeros(shape, jnp.int32),
            distance=jnp.zeros(shape),
            choices=jnp.zeros(shape, jnp.int32),
            weight=jnp.zeros(shape),
        )

    def after(
        self, running: jax.Array, action: jax.Array, taken: Taken, weight: jax.Array, due: jax.Array | None = None
    ) -> "Outcome":
        """Return the outcome after one more step.

        Args:
          running: bool, before the step.
          action: int32, taken.
          taken: what came of the step.
          weight: float32, of what was removed.
          due: bool, whether the choice counted; None where every one does.
        """
        counted = running if due is None else running & due
        return self._replace(
            done=self.done | (running & taken.terminated),
            success=self.success | (running & taken.success),
            length=self.length + running.astype(jnp.int32),
            moves=self.moves + (running & (action == MOVE_AHEAD)).astype(jnp.int32),
            choices=self.choices + counted.astype(jnp.int32),
            weight=self.weight + jnp.where(counted, weight, 0.0),
        )


class _Progress(NamedTuple):
    agent: Agent
    running: jax.Array
    outcome: Outcome
    keys: jax.Array


#: The episodes are carried on in so many parts as still run: all of them, half, and so on.
_SHARES = (2, 4, 16)


class Evaluator:
    """Evaluate grids; those of equal shape share a compilation.

    Attributes:
      compilations: so far.
    """

    def __init__(self, acting: Acting, removes: bool = True) -> None:
        """Prepare.

        Args:
          acting: environment, policy spec and layout setting.
          removes: whether experience may be removed; without, the factual decision alone is compiled, in half the time.
        """
        self.compilations = 0
        self._acting, self._removes = acting, removes
        self._compiled = jax.jit(self._run)

    def __call__(
        self,
        grid: Inference,
        weights: Params,
        parts: Iterable[tuple[EpisodeList, EnvParams]],
        knowledge: Knowledge,
        key: jax.Array,
    ) -> Outcome:
        """Run every cell of a grid over every episode.

        Args:
          grid: leaves [C].
          weights: parameters of all policies, leaves [N, ...].
          parts: episodes, E in all, and the parameters of the environment that they take place in, bank by bank.
          knowledge: what was learned before training.
          key: of sampled actions; parameters p in episode e of a part use it folded with the part, p, e and the time,
            whatever the cell.

        Returns:
          The outcomes [C, E]. One compilation serves all parts of equal shape.
        """
        outcomes = []
        for part, (episodes, params) in enumerate(parts):
            part_key = jax.random.fold_in(key, part)
            outcome = self._compiled(grid, weights, first_states(episodes), params, knowledge, part_key)
            outcomes.append(jax.tree.map(np.asarray, outcome))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *outcomes)

    def _run(
        self, grid: Inference, weights: Params, start: State, params: EnvParams, knowledge: Knowledge, key: jax.Array
    ) -> Outcome:
        self.compilations += 1  # traced once per shape

        def one(cell: Inference) -> Outcome:
            policy = self._acting.decider(jax.tree.map(lambda leaf: leaf[cell.params], weights))
            return _run_episodes(cell, policy, start, self._acting, self._removes, params, knowledge, key)

        return jax.lax.map(one, grid)


def first_states(episodes: EpisodeList) -> State:
    """Return the states that episodes start in, leaves [E]."""
    return State(
        pose=jnp.asarray(episodes.pose),
        scene=jnp.asarray(episodes.scene),
        goal=jnp.asarray(episodes.goal),
        time=jnp.zeros(len(episodes.pose), jnp.int32),
    )


def _run_episodes(
    cell: Inference,
    policy: Decider,
    start: State,
    acting: Acting,
    removes: bool,
    params: EnvParams,
    knowledge: Knowledge,
    key: jax.Array,
) -> Outcome:
    """Run one cell until the last episode has ended.

    Few are long: when no more than half of the episodes still run, only these are carried on, and so on.
    """
    count = start.pose.shape
    cell_key = jax.random.fold_in(key, cell.params)
    keys = jax.vmap(lambda episode: jax.random.fold_in(cell_key, episode))(jnp.arange(count[0]))
    agent = acting.begin(start, policy.initial_memory(count), knowledge, params)

    def step(progress: _Progress) -> _Progress:
        agent, running, outcome, keys = progress
        after, taken, inferred = act(cell, policy, agent, running, keys, acting, params, knowledge, removes)
        outcome = outcome.after(running, carried(taken.agent).action, taken, inferred.weight, acting.due(agent))
        return _Progress(select(running, after, agent), running & ~taken.ended, outcome, keys)

    progress = _Progress(agent, jnp.ones(count, bool), Outcome.start(count), keys)
    episodes, ended = jnp.arange(count[0]), (progress.outcome, start)
    for most in (*(count[0] // share for share in _SHARES if count[0] >= share), 0):
        progress = jax.lax.while_loop(lambda now, most=most: now.running.sum() > most, step, progress)
        reached = progress.outcome, progress.agent.state
        ended = jax.tree.map(lambda whole, part, at=episodes: whole.at[at].set(part), ended, reached)
        left = jnp.argsort(~progress.running)[:most]  # those that run first
        episodes, progress = episodes[left], jax.tree.map(lambda leaf, left=left: leaf[left], progress)
    outcome, last = ended
    return outcome._replace(
        distance=params.tables.goal_distance[acting.env.cell(last.pose), last.goal],
        weight=outcome.weight / jnp.maximum(outcome.choices, 1).astype(jnp.float32),
    )


def act(
    cell: Inference,
    policy: Decider,
    agent: Agent,
    running: jax.Array,
    keys: jax.Array,
    acting: Acting,
    params: EnvParams,
    knowledge: Knowledge,
    removes: bool = True,
) -> tuple[Agent, Taken, Inferred]:
    """Decide, remove experience and act, once in E episodes.

    Args:
      cell: how to infer.
      policy: with the cell's parameters.
      agent: the episodes, [E].
      running: bool [E], those that have not ended.
      keys: [E], of the episodes; folded with the time for a sampled action.
      acting: how to act.
      params: the environment's.
      knowledge: what was learned before training.
      removes: whether experience may be removed.

    Returns:
      The agent after the step, what came of it, and how the action was inferred.
    """
    memory = carried(agent)
    view = acting.view(agent, knowledge, params)
    view = view._replace(weights=jnp.where(cell.layout, view.weights, 1.0))
    pathways = policy.pathways(*view, memory)
    decision = policy.decide(pathways, memory)
    step_keys = jax.vmap(jax.random.fold_in)(keys, agent.state.time)
    logits = counterfactual = decision.logits
    gap, weight = acting.gap(agent), jnp.zeros(running.shape)
    if removes:
        counterfactual = counterfactual_logits(cell, policy, pathways, memory, keys, step_keys)
        gap = gap_used(cell, gap, running, keys, agent.state.time)
        logits, weight = remove(cell, logits, counterfactual, gap)
    logits = jnp.where(cell.uniform, 0.0, logits)
    sampled = jax.vmap(jax.random.categorical)(step_keys, logits)
    choice = jnp.where(cell.greedy, jnp.argmax(logits, axis=-1), sampled).astype(jnp.int32)
    after, taken = acting.step(agent, choice, knowledge, params, policy=policy, decision=decision)
    return after, taken, Inferred(view.weights, gap, weight, decision.logits, counterfactual, logits)
