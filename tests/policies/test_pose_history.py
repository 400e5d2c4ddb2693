"""The trail of an episode: exactly the repeated poses are told, by compass, odometry and horizon."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny

from jaxnav.env.make import build_environment
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Percept
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.tpn import PoseTracker, learn_motion
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes


def knowledge(bank=tiny.BANK):
    return tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_motion([bank], np.zeros(0))))


def follow(walk, length=100):
    """Which poses of a walk [(heading, action, moved, horizon)] are repeated."""
    method_knowledge, tracker = knowledge(), PoseTracker(length)
    columns = tuple(jnp.asarray(column) for column in zip(*walk, strict=True))

    def step(note, inputs):
        heading, action, moved, horizon = inputs
        percept = Percept(jnp.zeros(0, jnp.uint8), heading, action, moved, horizon, jnp.int32(0))
        note = tracker.update(note, method_knowledge, percept)
        return note, tracker.read(note, method_knowledge, jnp.int32(0))

    return jax.lax.scan(step, tracker.init(method_knowledge), columns)[1].tolist()


def test_a_walk_repeats_the_poses_that_it_comes_back_to():
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
        *(((heading, ROTATE_RIGHT, False, 0), False) for heading in (2, 3, 4, 5)),
        ((5, MOVE_AHEAD, True, 0), False),  # there again, but with another heading
        *(((heading, ROTATE_RIGHT, False, 0), False) for heading in (6, 7)),
        ((0, ROTATE_RIGHT, False, 0), True),
    ]
    assert follow([step for step, _ in walk]) == [repeated for _, repeated in walk]


def test_what_is_too_long_ago_is_forgotten():
    turns = [(heading % 8, ROTATE_RIGHT, False, 0) for heading in range(17)]
    assert follow(turns) == 8 * [False] + 9 * [True]
    assert follow(turns, 8) == 8 * [False] + 9 * [True]
    assert not any(follow(turns, 7))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["rooms", "apartments", "houses"])
def test_exactly_the_repeated_poses_of_random_walks_are_told(world):
    """With 8 and 12 headings, 2 horizons and 1, and walks longer than what is remembered."""
    task, walks, steps = WORLDS[world].task, 32, 300
    bank = compile_bank([make_generated_scenes(world, "train", 1)[0]], task)
    env, params = build_environment(bank, {}, 10**6)
    episodes = draw_episodes(bank, walks, seed=0)
    acting = AgentLoop(
        env, dataclasses.replace(tiny.SPEC, method=find_method("tpn"), num_categories=len(task.categories))
    )
    method_knowledge = knowledge(bank)

    @jax.jit
    def walk(key):
        # Half of them look down, where one can.
        start = acting.start_from(start_states(episodes), None, method_knowledge, params)

        def step(agent, key):
            draw = jax.random.randint(key, (walks,), 0, NUM_ACTIONS - 1)
            agent, _ = acting.step(agent, jnp.where(draw % 2 == 0, MOVE_AHEAD, draw), method_knowledge, params)
            return agent, (agent.state.pose, acting.policy_inputs(agent, method_knowledge, params).reading)

        _, (poses, repeated) = jax.lax.scan(step, start, jax.random.split(key, steps))
        return jnp.concatenate([start.state.pose[None], poses]), repeated

    poses, repeated = jax.tree.map(np.asarray, walk(jax.random.key(0)))
    for now in range(1, steps + 1):
        before = poses[max(0, now - PoseTracker().length) : now]
        np.testing.assert_array_equal(repeated[now - 1], (before == poses[now]).any(axis=0))
    assert 0.1 < repeated.mean() < 0.9
