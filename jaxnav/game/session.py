"""Game loop: plays an episode with named keys from any source.

`play_game` does not depend on a terminal: it reads names of keys from an iterable and hands each view to a function.
"""

import functools
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.baselines.shortest_path import oracle_actions
from jaxnav.env.objectnav import EnvParams
from jaxnav.evaluation.grid import start_states
from jaxnav.game.episode import Game, GameResult, GameView
from jaxnav.policies.agent_loop import Agent, AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.runs.policy import EpisodeMemory
from jaxnav.scenes.tables.observation_row import relative_position
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT

#: Actions by the names of keys; other keys do nothing.
KEY_ACTIONS = {
    "up": MOVE_AHEAD,
    "left": ROTATE_LEFT,
    "right": ROTATE_RIGHT,
    "enter": DONE,
    "w": MOVE_AHEAD,
    "a": ROTATE_LEFT,
    "d": ROTATE_RIGHT,
    "r": LOOK_UP,
    "f": LOOK_DOWN,
}
QUIT_KEY = "q"


def play_game(game: Game, keys: Iterable[str], show: Callable[[GameView], None]) -> GameResult:
    """Play until Done, the step limit, the key to quit or the last key.

    Args:
      game: episode to play.
      keys: names of keys, read one at a time.
      show: receives the view at the start and after each action but the last.
    """
    # The agent is a batch of one, steered by the keys; an adviser, if any, observes the same episode.
    agent_loop = AgentLoop(game.world.env, None, game.estimator_config)
    params = game.world.make_env_params(0)
    agent = _begin(agent_loop, start_states(game.episode), None, game.knowledge, params)
    memory = None if game.policy is None else game.policy.begin(params.room[agent.state.scene[0]])
    moved = jnp.zeros(1, bool)

    # The player sees the start before the first key.
    poses = [int(agent.state.pose[0])]
    shortest_poses = _shortest_poses(game)
    advice, next_memories = _advise(game, agent_loop, agent, memory, moved, params)
    show(_make_view(game, agent, agent_loop, params, advice))

    for key in keys:
        if key == QUIT_KEY:
            break
        if key not in KEY_ACTIONS:
            continue

        # Act, and end the game with the episode.
        action = KEY_ACTIONS[key]
        agent, step_result = _step(agent_loop, agent, jnp.array([action], jnp.int32), game.knowledge, params)
        poses.append(int(agent.state.pose[0]))
        if step_result.ended[0]:
            success = bool(step_result.success[0])
            return GameResult(poses, shortest_poses, success, said_done=action == DONE, has_quit=False)

        # The adviser remembers the action of the player, not the one that it would have chosen.
        memory = _memory_after(next_memories, action)
        moved = step_result.moved
        advice, next_memories = _advise(game, agent_loop, agent, memory, moved, params)
        show(_make_view(game, agent, agent_loop, params, advice))
    return GameResult(poses, shortest_poses, success=False, said_done=False, has_quit=True)


_begin = jax.jit(AgentLoop.start_from, static_argnums=0)
_step = jax.jit(AgentLoop.step, static_argnums=0)


def _advise(
    game: Game, agent_loop: AgentLoop, agent: Agent, memory: EpisodeMemory | None, moved: jax.Array, params: EnvParams
) -> tuple[np.ndarray | None, EpisodeMemory | None]:
    """Return the policy's probabilities [A], and its memory after each action, leaves [A, ...].

    Both are None without a policy.
    """
    if game.policy is None or memory is None:
        return None, None

    # The policy decides for one episode, without the axis of the batch.
    env_state = jax.tree.map(lambda leaf: leaf[0], agent.state)
    _, heading, horizon = agent_loop.env.task.rules.split_pose(env_state.pose)
    observation = agent_loop.env.observe(env_state, params)
    advice, next_memories = _decide(game.policy, observation, memory, game.epsilon, heading, moved[0], horizon)
    return np.asarray(advice), next_memories


@jax.jit
def _decide(policy, observation, memory, epsilon, heading, moved, horizon):
    decision = policy.decide(observation, memory, epsilon, heading=heading, moved=moved, horizon=horizon)

    # Only the next key shows which action the memory has to record, so that all are tried.
    apply_each_action = jax.vmap(policy.apply_choice, (None, 0, None))
    _, next_memories = apply_each_action(decision, jnp.arange(NUM_ACTIONS), memory.room)
    return jax.nn.softmax(decision.logits), next_memories


def _memory_after(next_memories: EpisodeMemory | None, action: int) -> EpisodeMemory | None:
    """Return the memory after one action; None stays None."""
    return jax.tree.map(lambda leaf: leaf[action], next_memories)


@functools.partial(jax.jit, static_argnums=0)
def _read_belief(
    agent_loop: AgentLoop, agent: Agent, knowledge: Knowledge, params: EnvParams
) -> tuple[jax.Array, jax.Array]:
    """Return w x g of eq. 7 [1, K], and the layout gap [1]."""
    return agent_loop.policy_inputs(agent, knowledge, params).layout_weights, agent_loop.layout_gap(agent)


def _make_view(
    game: Game, agent: Agent, agent_loop: AgentLoop, params: EnvParams, advice: np.ndarray | None
) -> GameView:
    """Return the information for the player at the present pose."""
    # The tables of the scenes have the observation of each pose.
    rules = game.bank.task.rules
    row_format = agent_loop.env.row_format
    pose = int(agent.state.pose[0])
    observation_row = game.bank.rows[pose]
    _, heading, horizon = rules.split_pose(pose)

    # List the detected categories, the nearest first.
    detections = row_format.detections(observation_row)
    ahead, right = relative_position(detections)
    detected_categories = np.flatnonzero(detections[:, 0])
    nearest_first = sorted(detected_categories, key=lambda category: np.hypot(ahead[category], right[category]))
    detection_list = []
    for category in nearest_first:
        category_name = game.bank.task.categories[category]
        confidence_share = float(detections[category, 0]) / 255
        detection_list.append((category_name, float(ahead[category]), float(right[category]), confidence_share))

    # Add the belief of the agent about the layout.
    goal_weights, layout_gap = _read_belief(agent_loop, agent, game.knowledge, params)
    return GameView(
        time=int(agent.state.time[0]),
        step_limit=int(params.step_limit[agent.state.scene[0]]),
        heading=360.0 / rules.headings * heading,
        horizon=rules.horizons[horizon],
        view_cells=row_format.view_cells(observation_row).reshape(row_format.view, row_format.view),
        detections=detection_list,
        goal_weights=np.asarray(goal_weights[0]),
        gap=float(layout_gap[0]),
        advice=advice,
    )


def _shortest_poses(game: Game) -> list[int]:
    """Return the poses of a shortest path."""
    # The oracle lists actions, [L*, 1]; the tables lead from pose to pose.
    poses = [int(game.episode.pose[0])]
    for action in oracle_actions(game.bank, game.episode)[:, 0]:
        poses.append(int(game.bank.successor[poses[-1], action]))
    return poses
