"""Two layouts of a home: the same agent, goal and start, in the layout of training and in the shifted one."""

from pathlib import Path

import pytest
from support.tiny_run import draw_run, tiny_config

from jaxnav.plain_console import PlainConsole
from jaxnav.report.config import ReportConfig
from jaxnav.report.make import measure_shifts

QUIET = PlainConsole(quiet=True)
NUM_REPLAYS = 5
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def replays_by_shift(tmp_path_factory):
    """Replays at shift 1 and at the shift of training, 0, in this order."""
    run = draw_run(tiny_config(tmp_path_factory.mktemp("layouts")))
    options = ReportConfig(
        Path("run"), shift=(1.0, 0.0), episodes=12, epsilon=(), threshold=0.2, replays=2 * NUM_REPLAYS
    )
    measured = measure_shifts(run, None, options, QUIET)
    return {shift: measurements.replays for shift, measurements in measured.items()}


def test_shifts_stay_in_the_order_of_the_options(replays_by_shift):
    assert [replays.shift for replays in replays_by_shift.values()] == [1.0, 0.0]


def test_only_shifted_replays_show_the_layout_of_training(replays_by_shift):
    assert "Layout" not in replays_by_shift[0.0].comparisons
    shifted = replays_by_shift[1.0]
    trained_player, shifted_player = shifted.comparisons["Layout"]
    assert shifted.players[shifted_player] == "+ w (layout)"
    assert shifted.players[trained_player] == "+ w (layout), shift 0"
    assert (shifted.layouts[trained_player], shifted.layouts[shifted_player]) == (0.0, 1.0)
    assert len(shifted.episodes) == NUM_REPLAYS


def test_both_layouts_have_equal_starts_and_other_objects(replays_by_shift):
    shifted = replays_by_shift[1.0]
    trained_player, shifted_player = shifted.comparisons["Layout"]
    any_moved = False
    for replay in shifted.episodes:
        trained_course = replay.courses[trained_player]
        shifted_course = replay.courses[shifted_player]
        trained_plan = shifted.plans[trained_course.plan]
        shifted_plan = shifted.plans[shifted_course.plan]
        assert shifted_course.plan == replay.plan
        assert trained_plan.name == shifted_plan.name
        assert trained_plan.floors == shifted_plan.floors
        any_moved |= sorted(trained_plan.objects) != sorted(shifted_plan.objects)

        # Both start with the same pose, and the goal exists in both layouts.
        starts = []
        for plan, course in ((trained_plan, trained_course), (shifted_plan, shifted_course)):
            view = plan.views[course.views[0]]
            starts.append((view.x, view.z, view.yaw))
            assert replay.goal in {category for category, *_ in plan.objects}
        assert starts[0] == starts[1]
    assert any_moved


def test_episodes_of_the_other_layout_are_not_counted(replays_by_shift):
    shifted = replays_by_shift[1.0]
    trained_player, shifted_player = shifted.comparisons["Layout"]
    assert shifted.differ[shifted_player][trained_player] is None
    assert shifted.differ[trained_player] == [None] * len(shifted.players)
    assert all(len(counts) == len(shifted.players) for counts in shifted.differ)
    assert shifted.differ[shifted_player][shifted_player] == 0
