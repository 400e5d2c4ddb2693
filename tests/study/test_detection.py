"""What the detector tells of goals: worked shares, and an independent count."""

import dataclasses

import numpy as np
import pytest
from support.scenes import draw

from jaxnav.scenes.tables.compile import categories_in_view, compile_bank, compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, Detector, RowFormat
from jaxnav.scenes.task import Rules, Task
from jaxnav.study.instrument import measure_detection

TASK = Task(("Book", "Chair"), rules=Rules(horizons=(30.0,)), detector=PERFECT_DETECTOR)
CORRIDOR = [".................."]  # 18 cells, 4.25 m
#: At the end of the corridor a small book, detected from up to 1.5 m, and a chair that is detected from up to 5 m.
ENDS = draw(CORRIDOR, ("Book", 4.25, 0.8, 0.0, 0.1, 0.1, 0.1), ("Chair", 4.25, 0.8, 0.0, 0.6, 0.6, 0.1))


def test_in_view_knows_no_range_of_small_objects():
    view = categories_in_view(ENDS, TASK)
    np.testing.assert_array_equal(view[:, 0], view[:, 1])  # they are in one place
    table = compile_scene(ENDS, TASK)
    detected = RowFormat(2).presence(table.rows)
    np.testing.assert_array_equal(detected[:, 1], view[:, 1])
    assert not (detected & ~view).any()
    assert detected[:, 0].sum() < view[:, 0].sum()


def test_shares_and_distances_are_as_worked():
    bank = compile_bank([ENDS], TASK)
    measured = measure_detection(bank, iter([ENDS]))
    view, detected = categories_in_view(ENDS, TASK), RowFormat(2).presence(bank.rows)
    near = np.repeat(np.abs(4.25 - np.arange(18) / 4) <= 1.5, 8)  # poses of the last seven cells
    # The book is detected where Done succeeds, and only there; the chair in all poses that have it in view.
    assert measured.detected[0] == pytest.approx([(view[:, 0] & near).sum() / view[:, 0].sum(), 1.0])
    assert measured.succeeds[0] == pytest.approx([1.0, (view[:, 1] & near).sum() / view[:, 1].sum()])
    assert detected[:, 0].sum() == (view[:, 0] & near).sum()
    assert measured.distance[0] == pytest.approx([17 / 8, 17 / 8])


def test_false_alarms_do_not_count_and_misses_do():
    def shares(detector: Detector) -> np.ndarray:
        task = dataclasses.replace(TASK, detector=detector)
        return measure_detection(compile_bank([ENDS], task), iter([ENDS])).detected[0]

    perfect = shares(PERFECT_DETECTOR)
    np.testing.assert_array_equal(shares(dataclasses.replace(PERFECT_DETECTOR, false_alarm=1.0)) >= perfect, True)
    assert shares(dataclasses.replace(PERFECT_DETECTOR, false_alarm=1.0))[1] == 1.0
    assert shares(Detector(miss_near=1.0, miss_far=1.0, false_alarm=0.0)).tolist() == [0.0, 0.0]


def test_scenes_without_goals_are_passed_over():
    empty = dataclasses.replace(draw(CORRIDOR), name="empty")
    alone = dataclasses.replace(draw(CORRIDOR, ("Chair", 4.25, 0.8, 0.0, 0.6, 0.6, 0.1)), name="alone")
    scenes = [empty, alone, ENDS]
    bank = compile_bank(scenes, TASK)
    measured = measure_detection(bank, iter(scenes))
    assert bank.skipped == ("empty",)
    assert np.isnan(measured.detected[0, 0])
    np.testing.assert_array_equal(
        measured.detected[1], measure_detection(compile_bank([ENDS], TASK), iter([ENDS])).detected[0]
    )
