"""Expected shortest paths and the success of random actions against closed forms and drawn episodes."""

import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import HOUSES, SMALL, draw

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import DONE, Task


@pytest.mark.parametrize("step_limit", [1, 3, 500])
def test_random_success_where_every_pose_succeeds_follows_closed_form(step_limit):
    bank = compile_bank([draw([".###"], ("Book", 0.25, 0.5, 0.0, *SMALL))], Task(("Book", "Chair"), rules=HOUSES))
    assert expected_length(bank).tolist() == [1.0]
    # Done is one of six actions: 1 - (5 / 6)^t within t of them.
    np.testing.assert_allclose(random_success(bank, np.array([step_limit])), 1 - (5 / 6) ** step_limit, rtol=2e-8)


def test_expected_length_and_random_success_equal_means_of_drawn_episodes():
    expected_lengths = expected_length(tiny.BANK)
    success_rates = random_success(tiny.BANK, np.array(tiny.STEP_LIMITS))

    # Play drawn episodes with random actions; six kinds, Done among them.
    episodes = draw_episodes(tiny.BANK, 6000, seed=2)
    step_limits = np.array(tiny.STEP_LIMITS)[episodes.scene]
    generator = np.random.default_rng(0)
    pose = episodes.pose
    running = np.ones(len(pose), bool)
    success = np.zeros(len(pose), bool)
    for time_step in range(max(tiny.STEP_LIMITS)):
        running = running & (time_step < step_limits)
        action = generator.integers(6, size=len(pose))
        success |= running & (action == DONE) & (tiny.BANK.best_length[pose, episodes.goal] == 1)
        running &= action != DONE
        pose = tiny.BANK.successor[pose, action]

    # The sample means lie within four standard errors of the expectations.
    for scene in range(2):
        in_scene = episodes.scene == scene
        for samples, expectation in ((episodes.best_length, expected_lengths[scene]), (success, success_rates[scene])):
            standard_error = samples[in_scene].std() / np.sqrt(in_scene.sum())
            assert abs(samples[in_scene].mean() - expectation) < 4 * standard_error
