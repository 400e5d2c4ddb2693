"""An episode that is steered from outside, key by key.

Nothing here knows of a terminal: keys are names, and what there is to see is handed to a function.
"""

import functools
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.baselines.shortest_path import oracle_actions
from jaxnav.env.types import EnvParams
from jaxnav.evaluation.grid import first_states
from jaxnav.game.episode import Ending, Game, Look
from jaxnav.policies.acting import Acting, Agent
from jaxnav.policies.methods import Knowledge
from jaxnav.runs.policy import EpisodeMemory
from jaxnav.scenes.tables.observation_row import relative_position
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT

#: Actions by the names of keys; other keys do nothing.
KEYS = {
    **{"up": MOVE_AHEAD, "left": ROTATE_LEFT, "right": ROTATE_RIGHT, "enter": DONE},
    **{"w": MOVE_AHEAD, "a": ROTATE_LEFT, "d": ROTATE_RIGHT, "r": LOOK_UP, "f": LOOK_DOWN},
}
QUIT = "q"


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
    state = jax.tree.map(lambda leaf: leaf[0], agent.state)
    _, heading, horizon = acting.env.task.rules.split(state.pose)
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
    pose = int(agent.state.pose[0])
    row, (_, heading, horizon) = game.bank.rows[pose], rules.split(pose)
    detections = row_format.detections(row)
    ahead, right = relative_position(detections)
    seen = sorted(np.flatnonzero(detections[:, 0]), key=lambda k: np.hypot(ahead[k], right[k]))
    names, (weights, gap) = game.bank.task.categories, _believed(acting, agent, game.knowledge, params)
    return Look(
        time=int(agent.state.time[0]),
        limit=int(params.step_limit[agent.state.scene[0]]),
        heading=360.0 / rules.headings * heading,
        horizon=rules.horizons[horizon],
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
