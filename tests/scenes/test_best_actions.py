"""Expert actions: shortest paths on a drawn map and in walks, and their copy on the device."""

import jax
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, ROOMS, SMALL, coarse_scene, draw, maze_scene

from jaxnav.env.make import build_environment
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import DONE, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT, Task

HEADINGS = ROOMS.headings
HORIZONS = len(ROOMS.horizons)


def test_expert_actions_on_a_drawn_map():
    # A corridor of ten cells along z, the book 3 m from its first cell: within 1.5 m from the sixth cell on.
    bank = compile_bank([draw(["."] * 10, ("Book", 0.0, 0.8, 3.0, *SMALL))], Task(CATEGORIES, rules=ROOMS))
    expert_actions = bank.expert.reshape(10, HEADINGS, HORIZONS, len(CATEGORIES))
    assert expert_actions.dtype == np.uint8
    assert expert_actions[:, 0, 0, BOOK].tolist() == 6 * [MOVE_AHEAD] + 4 * [DONE]

    # From the seventh cell the book is straight ahead: in sight half a right angle to either side (half view 50
    # degrees), and from a right angle or more it turns the shorter way; facing backwards both are, the first counts.
    turn_actions = [DONE, DONE, ROTATE_LEFT, ROTATE_LEFT, ROTATE_LEFT, ROTATE_RIGHT, ROTATE_RIGHT, DONE]
    assert expert_actions[6, :, 0, BOOK].tolist() == turn_actions
    assert (expert_actions[..., CHAIR] == NUM_ACTIONS).all()  # the scene has no chair


@pytest.mark.parametrize("scene", [coarse_scene(3), maze_scene(5)], ids=lambda scene: scene.name)
def test_expert_walks_are_shortest_paths(scene):
    bank = compile_bank([scene], Task())
    expert_actions = bank.expert

    # Walk from every pose to every goal that it can reach.
    start_pose, goal = np.nonzero(bank.best_length)
    pose = start_pose.copy()
    walk_length = np.zeros(len(start_pose), int)
    running = np.ones(len(start_pose), bool)
    while running.any():
        action = expert_actions[pose, goal]
        walk_length += running
        running &= action != DONE
        pose = np.where(running, bank.successor[pose, np.minimum(action, DONE)], pose)
        assert walk_length.max() <= bank.best_length.max()

    # Every walk has the shortest length and ends in success; elsewhere there is no action.
    np.testing.assert_array_equal(walk_length, bank.best_length[start_pose, goal])
    assert (bank.best_length[pose, goal] == 1).all()
    assert ((expert_actions == NUM_ACTIONS) == (bank.best_length == 0)).all()


def test_environment_holds_expert_actions_only_on_request():
    _, expert_params = build_environment(tiny.BANK, {}, 9, with_expert=True)
    assert expert_params.tables.expert is not None
    np.testing.assert_array_equal(expert_params.tables.expert, tiny.BANK.expert)
    _, padded_params = build_environment(tiny.BANK, {}, 9, num_cells=len(tiny.BANK.ahead) + 2, with_expert=True)
    assert padded_params.tables.expert is not None
    assert len(padded_params.tables.expert) == len(padded_params.tables.rows)
    _, plain_params = build_environment(tiny.BANK, {}, 9)
    assert plain_params.tables.expert is None
    assert len(jax.tree.leaves(expert_params)) == len(jax.tree.leaves(plain_params)) + 1
