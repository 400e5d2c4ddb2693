"""The expert: first actions of shortest paths, on a drawn map and against walks, and the same on the device."""

import jax
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, ROOMS, SMALL, coarse_scene, draw, maze_scene

from jaxnav.env.make import build_environment
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import DONE, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT, Task

HEADINGS, HORIZONS = ROOMS.headings, len(ROOMS.horizons)


def test_on_a_drawn_map_the_expert_walks_turns_and_is_done():
    # A corridor of ten cells along z, the book 3 m from its first cell: within 1.5 m from the sixth cell on.
    bank = compile_bank([draw(["."] * 10, ("Book", 0.0, 0.8, 3.0, *SMALL))], Task(CATEGORIES, rules=ROOMS))
    expert = bank.expert.reshape(10, HEADINGS, HORIZONS, len(CATEGORIES))
    assert expert.dtype == np.uint8
    assert expert[:, 0, 0, BOOK].tolist() == 6 * [MOVE_AHEAD] + 4 * [DONE]
    # From the seventh cell the book is straight ahead: in sight half a right angle to either side (half view 50
    # degrees), and from a right angle or more it turns the shorter way; facing backwards both are, the first counts.
    turning = [DONE, DONE, ROTATE_LEFT, ROTATE_LEFT, ROTATE_LEFT, ROTATE_RIGHT, ROTATE_RIGHT, DONE]
    assert expert[6, :, 0, BOOK].tolist() == turning
    assert (expert[..., CHAIR] == NUM_ACTIONS).all()  # no chair, no way


@pytest.mark.parametrize("scene", [coarse_scene(3), maze_scene(5)], ids=lambda scene: scene.name)
def test_a_walk_of_the_expert_is_a_shortest_path(scene):
    bank = compile_bank([scene], Task())
    expert, successor = bank.expert, bank.successor
    start, goal = np.nonzero(bank.best_length)
    pose, length = start.copy(), np.zeros(len(start), int)
    running = np.ones(len(start), bool)
    while running.any():
        action = expert[pose, goal]
        length += running
        running &= action != DONE
        pose = np.where(running, successor[pose, np.minimum(action, DONE)], pose)
        assert length.max() <= bank.best_length.max()
    np.testing.assert_array_equal(length, bank.best_length[start, goal])
    assert (bank.best_length[pose, goal] == 1).all()
    assert ((expert == NUM_ACTIONS) == (bank.best_length == 0)).all()


def test_the_device_holds_the_experts_actions_for_those_who_imitate():
    _, params = build_environment(tiny.BANK, {}, 9, with_expert=True)
    assert params.tables.expert is not None
    np.testing.assert_array_equal(params.tables.expert, tiny.BANK.expert)
    _, padded = build_environment(tiny.BANK, {}, 9, num_cells=len(tiny.BANK.ahead) + 2, with_expert=True)
    assert padded.tables.expert is not None
    assert len(padded.tables.expert) == len(padded.tables.rows)
    _, plain = build_environment(tiny.BANK, {}, 9)
    assert plain.tables.expert is None
    assert len(jax.tree.leaves(params)) == len(jax.tree.leaves(plain)) + 1
