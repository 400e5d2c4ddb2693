"""An episode that is steered from outside, key by key.

Nothing here knows of a terminal: keys are names, and what there is to see is handed to a function.
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.baselines.shortest_path import oracle_actions
from jaxnav.env.types import EnvParams
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import first_states
from jaxnav.layout import Setting
from jaxnav.policies.acting import Acting, Agent
from jaxnav.policies.methods import Knowledge
from jaxnav.runs.policy import EpisodeMemory, LoadedPolicy
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import relative_position
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT

#: Actions by the names of keys; other keys do nothing.
KEYS = {
    **{"up": MOVE_AHEAD, "left": ROTATE_LEFT, "right": ROTATE_RIGHT, "enter": DONE},
    **{"w": MOVE_AHEAD, "a": ROTATE_LEFT, "d": ROTATE_RIGHT, "r": LOOK_UP, "f": LOOK_DOWN},
}
QUIT = "q"


class Game(NamedTuple):
    """Hold an episode to be played, and whose belief is shown beside it.

    Attributes:
      world: its scenes; the first bank is played in.
      episode: a list of one.
      knowledge: with the layout priors.
      setting: of the layout estimator.
      policy: whose advice is shown; None for none.
      epsilon: threshold of sTDE in that advice.
    """

    world: CompiledWorld
    episode: EpisodeList
    knowledge: Knowledge
    setting: Setting
    policy: LoadedPolicy | None = None
    epsilon: float = 0.5

    @property
    def bank(self) -> Bank:
        """Return the tables of the scenes."""
        return self.world.banks[0]

    @property
    def goal(self) -> str:
        """Return the name of what is sought."""
        return self.bank.task.categories[int(self.episode.goal[0])]


class Look(NamedTuple):
    """Hold what a player gets to know at one step.

    Attributes:
      time, limit: actions taken so far and at most.
      heading: degrees clockwise from +z.
      horizon: degrees downwards, of the camera.
      cells: uint8 [V, V], the view on the floor; see `RowFormat.view_cells`.
      seen: name, metres ahead, metres to the right and confidence from 0 to 1 of each detection, the nearest first.
      weights: float32 [K], w x g of eq. 7.
      gap: layout gap D.
      advice: float32 [A], a policy's probability of each action; None without a policy.
    """

    time: int
    limit: int
    heading: float
    horizon: float
    cells: np.ndarray
    seen: list[tuple[str, float, float, float]]
    weights: np.ndarray
    gap: float
    advice: np.ndarray | None


class Ending(NamedTuple):
    """Hold how a game ended.

    Attributes:
      poses: int [T + 1], of the bank, from the start on.
      best: int [L* + 1], those of a shortest path.
      success: whether it ended with Done where that succeeds.
      done: whether it ended with Done at all.
      quit: whether the player left.
    """

    poses: list[int]
    best: list[int]
    success: bool
    done: bool
    quit: bool

    @property
    def spl(self) -> float:
        """Return success weighted by path length; both count actions."""
        return self.success * (len(self.best) - 1) / max(len(self.poses) - 1, 1)


def choose_episode(bank: Bank, goal: str | None, seed: int) -> EpisodeList:
    """Draw one of an evaluation's episodes.

    Args:
      bank: the scenes.
      goal: name of the category to search for; None for any.
      seed: of the draw, at least 0.

    Raises:
      InputError: no episode has that goal, or a negative seed.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}: give a number of at least 0")
    episodes = episode_list(bank, seed=seed)
    names = np.array(bank.task.categories)[episodes.goal]
    drawn = np.random.default_rng(seed).permutation(len(names))
    fitting = drawn if goal is None else drawn[names[drawn] == goal]
    if not len(fitting):
        raise InputError(f"--goal {goal}: choose one of {', '.join(sorted(set(names)))}")
    return episodes.take(fitting[:1])


def play(game: Game, keys: Iterable[str], show: Callable[[Look], None]) -> Ending:
    """Play until Done, the step limit, the key to quit or the last key.

    Args:
      game: the episode.
      keys: names of keys, read one at a time.
      show: gets what is seen at the start and after each action but the last.
    """
    acting, params = Acting(game.world.env, None, game.setting), game.world.params(0)
    agent, memory = _begin(acting, game, params)
    moved = jnp.zeros(1, bool)
    poses, best = [int(agent.state.pose[0])], _shortest(game)
    advice, memories = _advise(game, acting, agent, memory, moved, params)
    show(_look(game, agent, acting, params, advice))
    for key in keys:
        if key == QUIT:
            break
        if key not in KEYS:
            continue
        action = KEYS[key]
        agent, taken = _step(acting, agent, jnp.array([action], jnp.int32), game.knowledge, params)
        poses.append(int(agent.state.pose[0]))
        if taken.ended[0]:
            return Ending(poses, best, bool(taken.success[0]), action == DONE, False)
        memory, moved = jax.tree.map(lambda leaf, action=action: leaf[action], memories), taken.moved
        advice, memories = _advise(game, acting, agent, memory, moved, params)
        show(_look(game, agent, acting, params, advice))
    return Ending(poses, best, False, False, True)


_first, _step = jax.jit(Acting.begin, static_argnums=0), jax.jit(Acting.step, static_argnums=0)


def _begin(acting: Acting, game: Game, params: EnvParams) -> tuple[Agent, EpisodeMemory | None]:
    agent = _first(acting, first_states(game.episode), None, game.knowledge, params)
    return agent, None if game.policy is None else game.policy.begin(params.room[agent.state.scene[0]])


def _advise(
    game: Game, acting: Acting, agent: Agent, memory: EpisodeMemory | None, moved: jax.Array, params: EnvParams
) -> tuple[np.ndarray | None, EpisodeMemory | None]:
    """Return a policy's probabilities, and its memory after each action."""
    if game.policy is None or memory is None:
        return None, None
    rules, pose = acting.env.task.rules, agent.state.pose[0]
    state = jax.tree.map(lambda leaf: leaf[0], agent.state)
    heading, horizon = pose // len(rules.horizons) % rules.headings, pose % len(rules.horizons)
    observation = acting.env.observe(state, params)
    advice, memories = _decide(game.policy, observation, memory, game.epsilon, heading, moved[0], horizon)
    return np.asarray(advice), memories


@jax.jit
def _decide(policy, observation, memory, epsilon, heading, moved, horizon):
    choice = policy.decide(observation, memory, epsilon, heading=heading, moved=moved, horizon=horizon)
    _, memories = jax.vmap(policy.follow, (None, 0, None))(choice, jnp.arange(NUM_ACTIONS), memory.room)
    return jax.nn.softmax(choice.logits), memories


@functools.partial(jax.jit, static_argnums=0)
def _believed(acting: Acting, agent: Agent, knowledge: Knowledge, params: EnvParams) -> tuple[jax.Array, jax.Array]:
    """Return w x g of eq. 7 [1, K], and the gap [1]."""
    return acting.view(agent, knowledge, params).weights, acting.gap(agent)


def _look(game: Game, agent: Agent, acting: Acting, params: EnvParams, advice: np.ndarray | None) -> Look:
    rules, row_format = game.bank.task.rules, acting.env.row_format
    pose, row = int(agent.state.pose[0]), game.bank.rows[int(agent.state.pose[0])]
    detections = row_format.detections(row)
    ahead, right = relative_position(detections)
    seen = sorted(np.flatnonzero(detections[:, 0]), key=lambda k: np.hypot(ahead[k], right[k]))
    names, (weights, gap) = game.bank.task.categories, _believed(acting, agent, game.knowledge, params)
    return Look(
        time=int(agent.state.time[0]),
        limit=int(params.step_limit[agent.state.scene[0]]),
        heading=360.0 / rules.headings * (pose // len(rules.horizons) % rules.headings),
        horizon=rules.horizons[pose % len(rules.horizons)],
        cells=row_format.view_cells(row).reshape(row_format.view, row_format.view),
        seen=[(names[k], float(ahead[k]), float(right[k]), float(detections[k, 0]) / 255) for k in seen],
        weights=np.asarray(weights[0]),
        gap=float(gap[0]),
        advice=advice,
    )


def _shortest(game: Game) -> list[int]:
    """Return the poses of a shortest path."""
    poses = [int(game.episode.pose[0])]
    for action in oracle_actions(game.bank, game.episode)[:, 0]:
        poses.append(int(game.bank.successor[poses[-1], action]))
    return poses
