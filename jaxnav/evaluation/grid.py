"""Every variant, epsilon, decoding and seed over the same fixed episodes, in one compiled call."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.causal import remove_experience
from jaxnav.env.types import EnvParams, State
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.inference import Inference, counterfactual_logits
from jaxnav.policies.acting import Acting, Agent, select
from jaxnav.policies.pathways import Memory
from jaxnav.policies.policy import Params, Policy, bind
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import MOVE_AHEAD


class Outcome(NamedTuple):
    """How episodes went; leaves [C, E].

    Attributes:
      success: bool.
      length: int32, actions taken, Done included.
      moves: int32, MoveAheads chosen.
      distance: float32, metres from the last cell to the nearest goal object's centre.
      weight: float32, mean weight of the counterfactual logits over the episode's steps.
    """

    success: jax.Array
    length: jax.Array
    moves: jax.Array
    distance: jax.Array
    weight: jax.Array

    @classmethod
    def start(cls, shape: tuple[int, ...]) -> "Outcome":
        """Nothing done yet."""
        return cls(
            success=jnp.zeros(shape, bool),
            length=jnp.zeros(shape, jnp.int32),
            moves=jnp.zeros(shape, jnp.int32),
            distance=jnp.zeros(shape),
            weight=jnp.zeros(shape),
        )


class _Progress(NamedTuple):
    agent: Agent
    running: jax.Array
    outcome: Outcome
    keys: jax.Array


#: The episodes are carried on in so many parts as still run: all of them, half, and so on.
_SHARES = (2, 4, 16)


def evaluate_grid(
    grid: Inference,
    weights: Params,
    parts: Iterable[tuple[EpisodeList, EnvParams]],
    acting: Acting,
    spec: PolicySpec,
    priors: jax.Array,
    key: jax.Array,
) -> tuple[Outcome, int]:
    """Run every cell of the grid over every episode, without auto-reset.

    Args:
      grid: leaves [C].
      weights: parameters of all policies, leaves [N, ...].
      parts: episodes, E in all, and the parameters of the environment that they take place in, bank by bank.
      acting: environment and layout setting.
      spec: sizes of the policies.
      priors: float32 [rooms, K, K].
      key: of sampled actions; parameters p in episode e of a part use it folded with the part, p, e and the time,
        whatever the cell.

    Returns:
      The outcomes [C, E] and the number of compilations that it took: 1 if all parts are of equal shape.
    """
    evaluator = Evaluator(acting, spec)
    return evaluator(grid, weights, parts, priors, key), evaluator.compilations


class Evaluator:
    """Evaluates grids one after the other; those of equal shape share a compilation. Arguments as `evaluate_grid`.

    Attributes:
      compilations: so far.
    """

    def __init__(self, acting: Acting, spec: PolicySpec) -> None:
        self.compilations = 0
        self._acting, self._spec = acting, spec
        self._compiled = jax.jit(self._run)

    def __call__(
        self,
        grid: Inference,
        weights: Params,
        parts: Iterable[tuple[EpisodeList, EnvParams]],
        priors: jax.Array,
        key: jax.Array,
    ) -> Outcome:
        """The outcomes [C, E]."""
        outcomes = []
        for part, (episodes, params) in enumerate(parts):
            own = jax.random.fold_in(key, part)
            outcome = self._compiled(grid, weights, first_states(episodes), params, priors, own)
            outcomes.append(jax.tree.map(np.asarray, outcome))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *outcomes)

    def _run(
        self, grid: Inference, weights: Params, start: State, params: EnvParams, priors: jax.Array, key: jax.Array
    ) -> Outcome:
        self.compilations += 1  # traced once per shape

        def one(cell: Inference) -> Outcome:
            own = jax.tree.map(lambda leaf: leaf[cell.params], weights)
            return _episodes(cell, own, start, self._acting, self._spec, params, priors, key)

        return jax.lax.map(one, grid)


def first_states(episodes: EpisodeList) -> State:
    """The states that episodes start in, leaves [E]."""
    return State(
        pose=jnp.asarray(episodes.pose),
        scene=jnp.asarray(episodes.scene),
        goal=jnp.asarray(episodes.goal),
        time=jnp.zeros(len(episodes.pose), jnp.int32),
    )


def _episodes(
    cell: Inference,
    weights: Params,
    start: State,
    acting: Acting,
    spec: PolicySpec,
    params: EnvParams,
    priors: jax.Array,
    key: jax.Array,
) -> Outcome:
    """Run one cell over all episodes until the last one has ended.

    Few are long: when no more than half of the episodes still run, only these are carried on, and so on.
    """
    policy = bind(spec, weights)
    count = start.pose.shape
    own = jax.random.fold_in(key, cell.params)
    keys = jax.vmap(lambda episode: jax.random.fold_in(own, episode))(jnp.arange(count[0]))
    agent = acting.begin(start, policy, params, priors)

    def step(progress: _Progress) -> _Progress:
        agent, running, outcome, keys = progress
        following, taken = act(cell, policy, agent, running, keys, acting, params, priors)
        outcome = outcome._replace(
            success=outcome.success | (running & taken.success),
            length=outcome.length + running.astype(jnp.int32),
            moves=outcome.moves + (running & (taken.action == MOVE_AHEAD)).astype(jnp.int32),
            weight=outcome.weight + jnp.where(running, taken.weight, 0.0),
        )
        return _Progress(select(running, following, agent), running & ~taken.ended, outcome, keys)

    progress = _Progress(agent, jnp.ones(count, bool), Outcome.start(count), keys)
    episodes, ended = jnp.arange(count[0]), (progress.outcome, start)
    for most in (*(count[0] // share for share in _SHARES if count[0] >= share), 0):
        progress = jax.lax.while_loop(lambda own, most=most: own.running.sum() > most, step, progress)
        now = progress.outcome, progress.agent.state
        ended = jax.tree.map(lambda whole, own, at=episodes: whole.at[at].set(own), ended, now)
        left = jnp.argsort(~progress.running)[:most]  # those that run first
        episodes, progress = episodes[left], jax.tree.map(lambda leaf, left=left: leaf[left], progress)
    outcome, last = ended
    return outcome._replace(
        distance=params.tables.goal_distance[acting.env.cell(last.pose), last.goal],
        weight=outcome.weight / outcome.length.astype(jnp.float32),
    )


class Taken(NamedTuple):
    """One step of E episodes; leaves [E].

    Attributes:
      action: int32.
      weight: float32, of the counterfactual logits.
      ended: bool, with this action.
      success: bool, ended with Done where the goal is found.
    """

    action: jax.Array
    weight: jax.Array
    ended: jax.Array
    success: jax.Array


def act(
    cell: Inference,
    policy: Policy,
    agent: Agent,
    running: jax.Array,
    keys: jax.Array,
    acting: Acting,
    params: EnvParams,
    priors: jax.Array,
) -> tuple[Agent, Taken]:
    """Take one step in E episodes: decide, take experience out (eq. 2), act, and update the belief once.

    The counterfactual decision shares the experience and the memory with the factual one; its own memory is dropped.

    Args:
      cell: how to infer.
      policy: with the cell's parameters.
      agent: the episodes, [E].
      running: bool [E], those that have not ended.
      keys: [E], of the episodes; folded with the time for a sampled action.
      acting: environment and layout setting.
      params: the environment's.
      priors: float32 [rooms, K, K].
    """
    observation, layout_weights = acting.observe(agent, params)
    pathways = policy.pathways(observation, jnp.where(cell.layout, layout_weights, 1.0))
    factual = policy.decide(pathways, agent.memory)
    own = jax.vmap(jax.random.fold_in)(keys, agent.state.time)
    counterfactual = counterfactual_logits(cell, policy, pathways, agent.memory, keys, own)
    weight = cell.always + jax.nn.relu(acting.gap(agent) - cell.epsilon)
    weight = jnp.where(cell.shuffled, weight[_next_running(running)], weight)
    residual, paper = (
        remove_experience(factual.logits, counterfactual, weight, form) for form in ("residual", "paper")
    )
    logits = jnp.where(cell.uniform, 0.0, jnp.where(cell.residual, residual, paper))

    sampled = jax.vmap(jax.random.categorical)(own, logits)
    action = jnp.where(cell.greedy, jnp.argmax(logits, axis=-1), sampled).astype(jnp.int32)
    found = jax.vmap(acting.env.succeeds, (0, None))(agent.state, params)
    state, _, terminated, truncated = jax.vmap(acting.env.advance, (0, 0, None))(agent.state, action, params)
    layout = acting.believe(agent.layout, state, params, priors)
    following = Agent(state=state, layout=layout, memory=Memory(hidden=factual.hidden, action=action))
    return following, Taken(action, weight, terminated | truncated, terminated & found)


def _next_running(running: jax.Array) -> jax.Array:
    """For each running episode the next one that runs, cyclically: int [E]; of no meaning for others."""
    order = jnp.argsort(~running)  # stable: those that run first
    place = jnp.cumsum(running) - 1
    return order[(place + 1) % jnp.maximum(running.sum(), 1)]
