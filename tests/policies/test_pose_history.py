"""The pose history of TPN: repeated poses are recognised by compass, odometry and horizon."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.walks import draw_walk_actions

from jaxnav.env.make import build_environment
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Percept
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.tpn import PoseTracker, learn_motion
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import LOOK_DOWN, LOOK_UP, MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes


def make_knowledge(bank=tiny.BANK):
    """The tiny world's priors with the motion of a bank's task."""
    return tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_motion([bank], np.zeros(0))))


def repeated_poses(walk, length=100):
    """True for the repeated poses of a walk, a list of (heading, action, moved, horizon)."""
    knowledge = make_knowledge()
    tracker = PoseTracker(length)
    columns = tuple(jnp.asarray(column) for column in zip(*walk, strict=True))

    def step(state, inputs):
        heading, action, moved, horizon = inputs
        percept = Percept(jnp.zeros(0, jnp.uint8), heading, action, moved, horizon, jnp.int32(0))
        state = tracker.update(state, knowledge, percept)
        return state, tracker.read(state, knowledge, jnp.int32(0))

    return jax.lax.scan(step, tracker.init(knowledge), columns)[1].tolist()


def test_poses_to_which_a_walk_returns_are_repeated():
    walk = [
        ((0, NO_ACTION, False, 0), False),
        ((1, ROTATE_RIGHT, False, 0), False),
        ((0, ROTATE_LEFT, False, 0), True),  # back to the first heading
        ((0, MOVE_AHEAD, True, 0), False),
        ((0, LOOK_DOWN, False, 1), False),
        ((0, LOOK_DOWN, False, 1), True),  # no lower
        ((0, LOOK_UP, False, 0), True),
        ((0, MOVE_AHEAD, False, 0), True),  # blocked
        ((1, ROTATE_RIGHT, False, 0), False),
        ((1, MOVE_AHEAD, True, 0), False),  # diagonally
        ((2, ROTATE_RIGHT, False, 0), False),
        ((3, ROTATE_RIGHT, False, 0), False),
        ((4, ROTATE_RIGHT, False, 0), False),
        ((5, ROTATE_RIGHT, False, 0), False),
        ((5, MOVE_AHEAD, True, 0), False),  # the cell of the turn above, but with another heading
        ((6, ROTATE_RIGHT, False, 0), False),
        ((7, ROTATE_RIGHT, False, 0), False),
        ((0, ROTATE_RIGHT, False, 0), True),
    ]
    assert repeated_poses([step for step, _ in walk]) == [is_repeated for _, is_repeated in walk]


def test_poses_beyond_the_length_of_the_history_are_forgotten():
    turns = [(heading % 8, ROTATE_RIGHT, False, 0) for heading in range(17)]
    assert repeated_poses(turns) == 8 * [False] + 9 * [True]
    assert repeated_poses(turns, 8) == 8 * [False] + 9 * [True]
    assert not any(repeated_poses(turns, 7))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["rooms", "apartments", "houses"])
def test_exactly_the_repeated_poses_of_random_walks_are_recognised(world):
    """Tasks have 8 or 12 headings and 1 or 2 horizons; walks are longer than the history."""
    task = WORLDS[world].task
    num_walks = 32
    num_steps = 300
    bank = compile_bank([make_generated_scenes(world, "train", 1)[0]], task)
    env, params = build_environment(bank, {}, 10**6)
    episodes = draw_episodes(bank, num_walks, seed=0)
    spec = dataclasses.replace(tiny.SPEC, method=find_method("tpn"), num_categories=len(task.categories))
    agent_loop = AgentLoop(env, spec)
    knowledge = make_knowledge(bank)

    @jax.jit
    def walk(key):
        # About half of the agents look down at the start, if the task has a second horizon.
        start = agent_loop.start_from(start_states(episodes), None, knowledge, params)

        def step(agent, key):
            agent, _ = agent_loop.step(agent, draw_walk_actions(key, num_walks), knowledge, params)
            return agent, (agent.state.pose, agent_loop.policy_inputs(agent, knowledge, params).reading)

        _, (poses, is_repeated) = jax.lax.scan(step, start, jax.random.split(key, num_steps))
        return jnp.concatenate([start.state.pose[None], poses]), is_repeated

    # A pose is repeated if it is among those that the history holds.
    poses, is_repeated = jax.tree.map(np.asarray, walk(jax.random.key(0)))
    for step_index in range(1, num_steps + 1):
        history = poses[max(0, step_index - PoseTracker().length) : step_index]
        np.testing.assert_array_equal(is_repeated[step_index - 1], (history == poses[step_index]).any(axis=0))
    assert 0.1 < is_repeated.mean() < 0.9
