"""Expected shortest paths and the success of random actions against closed forms and drawn episodes."""

import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import HOUSES, SMALL, draw

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Task


@pytest.mark.parametrize("limit", [1, 3, 500])
def test_where_the_goal_is_everywhere_random_succeeds_with_its_first_done(limit):
    bank = compile_bank([draw([".###"], ("Book", 0.25, 0.5, 0.0, *SMALL))], Task(("Book", "Chair"), rules=HOUSES))
    assert expected_length(bank).tolist() == [1.0]
    # Done is one of six actions: 1 - (5 / 6)^t within t of them.
    np.testing.assert_allclose(random_success(bank, np.array([limit])), 1 - (5 / 6) ** limit, rtol=2e-8)


def test_both_are_means_over_the_episodes_that_are_drawn():
    episodes, successor = draw_episodes(tiny.BANK, 6000, seed=2), tiny.BANK.successor
    lengths, random = expected_length(tiny.BANK), random_success(tiny.BANK, np.array(tiny.LIMITS))
    generator = np.random.default_rng(0)
    pose, running, success = episodes.pose, np.ones(len(episodes.pose), bool), np.zeros(len(episodes.pose), bool)
    for time in range(max(tiny.LIMITS)):
        running = running & (time < np.array(tiny.LIMITS)[episodes.scene])
        action = generator.integers(6, size=len(pose))
        success |= running & (action == 5) & (tiny.BANK.best_length[pose, episodes.goal] == 1)
        running &= action != 5
        pose = successor[pose, action]
    for scene in range(2):
        in_scene = episodes.scene == scene
        for values, expected in ((episodes.best_length, lengths[scene]), (success, random[scene])):
            error = values[in_scene].std() / np.sqrt(in_scene.sum())
            assert abs(values[in_scene].mean() - expected) < 4 * error
