"""The simulated detector: rates and places of its errors."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import binomtest, kstest
from support.scenes import APARTMENTS, HOUSES, ROOMS

from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, Detector, RowFormat, detection_range
from jaxnav.scenes.task import Task


def detect(detector, in_view, distance, half_view=ROOMS.half_view_tangents[0], num_poses=40_000):
    """Return detections uint8 [P, 2, 4] of two objects of 0.6 m (range 5 m) straight ahead."""
    shape = (num_poses, 2)
    ahead = np.full(shape, float(distance))
    size = np.full(shape, 0.6)
    return detector.detect("room", half_view, np.full(shape, in_view), ahead, np.zeros(shape), ahead, size)


@pytest.mark.parametrize(("distance", "miss_rate"), [(0.0, 0.1), (2.5, 0.2), (5.0, 0.5)])
def test_detector_miss_rate_grows_with_the_squared_distance(distance, miss_rate):
    # 0.1 + 0.4 (2.5 / 5)^2 = 0.2.
    detections = detect(Detector(miss_near=0.1, miss_far=0.5, false_alarm=0.5), True, distance)
    is_missed = detections[..., 0] == 0
    assert binomtest(int(is_missed.sum()), is_missed.size, miss_rate).pvalue > 1e-3
    assert binomtest(int(is_missed.sum()), is_missed.size, miss_rate + 0.02).pvalue < 1e-3  # the test has the power
    assert not detections[is_missed].any()

    # Confidence 1 - 0.5 d / 5 m, plus or minus 0.1; the place is not noisy.
    confidence = detections[~is_missed][:, 0] / 255
    mean_confidence = 1.0 - 0.1 * distance
    assert confidence.min() >= mean_confidence - 0.1 - 1 / 255
    assert confidence.max() <= min(mean_confidence + 0.1, 1.0) + 1 / 255
    assert (detections[~is_missed][:, 1:3] == [round(51 * distance), 128]).all()


def test_detector_false_alarms_are_uniform_in_the_field_of_view():
    detections = detect(Detector(false_alarm=0.1), False, 1.0)
    alarms = detections[detections[..., 0] > 0]
    assert binomtest(len(alarms), detections[..., 0].size, 0.1).pvalue > 1e-3

    # Confidence is uniform, and the place is within the field of view.
    confidence = alarms[:, 0] / 255
    ahead = alarms[:, 1] / 51
    right = (alarms[:, 2] - 128.0) / 25.4
    assert kstest(confidence, "uniform", (0.3, 0.3)).pvalue > 1e-6  # quantised, hence not 1e-3
    assert (np.abs(right) <= np.tan(np.deg2rad(50)) * ahead + 0.05).all()  # a quantum is 0.02 m and 0.04 m

    # The range of 0.3 m is 0.3 / 0.12 = 2.5 m, the greatest offset to a side 2.5 sin 50 = 1.92 m.
    distance = np.hypot(ahead, right)
    assert (max(distance), max(np.abs(right))) == pytest.approx((2.5, 1.92), abs=0.05)

    # Uniform in a sector: a quarter of the area lies within half the radius, and half of it to the right.
    assert binomtest(int((distance < 1.25).sum()), len(alarms), 0.25).pvalue > 1e-3
    assert binomtest(int((right > 0).sum()), int((right != 0).sum()), 0.5).pvalue > 1e-3

    # The confidence does not depend on the place: 8,000 independent pairs have correlations of 0.011 or so.
    for offset in (np.arctan2(right, ahead), distance):
        assert abs(np.corrcoef(confidence, offset)[0, 1]) < 0.05

    # An object of that apparent size at that distance could be detected (a quantum of either is worth 0.1 m).
    size = alarms[:, 3] / 127.5 * np.maximum(distance, 0.25)
    assert (distance <= detection_range(size) + 0.12).all()
    assert not detections[detections[..., 0] == 0].any()


def test_detector_false_alarms_stay_in_a_narrower_field_of_view():
    detections = detect(Detector(false_alarm=0.1), False, 1.0, APARTMENTS.half_view_tangents[0])
    alarms = detections[detections[..., 0] > 0]
    ahead = alarms[:, 1] / 51
    right = (alarms[:, 2] - 128.0) / 25.4
    bearing = np.rad2deg(np.arctan2(right, ahead))[alarms[:, 1] > 51]
    assert 38 < np.abs(bearing).max() < 39.5 + 2  # a quantum is 0.04 m, over 1 m away
    assert kstest(bearing, "uniform", (-39.5, 79)).pvalue > 1e-3


def test_detector_errors_depend_on_scene_name_and_seed_alone():
    scenes = [generate_room("train", i, 0) for i in range(3)]
    task = Task()
    bank_of_three = compile_bank(scenes, task)
    bank_alone = compile_bank(scenes[1:2], task)
    np.testing.assert_array_equal(bank_of_three.rows, compile_bank(scenes, task).rows)

    # Other scenes in the bank do not change the errors.
    first_row = bank_of_three.first_cell[1] * task.rules.poses_per_cell
    np.testing.assert_array_equal(bank_of_three.rows[first_row : first_row + len(bank_alone.rows)], bank_alone.rows)

    # The seed of the detector and the name of the scene do.
    other_seed = Task(detector=Detector(seed=1))
    other_name = dataclasses.replace(scenes[1], name="other")
    assert (compile_bank(scenes[1:2], other_seed).rows != bank_alone.rows).any()
    assert (compile_bank([other_name], task).rows != bank_alone.rows).any()


@pytest.mark.parametrize("rules", [ROOMS, HOUSES])
def test_detector_errors_leave_best_lengths_unchanged(rules):
    scenes = [generate_room("train", i, 0) for i in range(2)]
    blind_detector = Detector(miss_near=1.0, miss_far=1.0)
    blind_bank = compile_bank(scenes, Task(rules=rules, detector=blind_detector))
    perfect_bank = compile_bank(scenes, Task(rules=rules, detector=PERFECT_DETECTOR))
    row_format = RowFormat(22)
    np.testing.assert_array_equal(blind_bank.best_length, perfect_bank.best_length)
    assert row_format.presence(blind_bank.rows).sum() < 0.1 * row_format.presence(perfect_bank.rows).sum()


# Instance counts


@pytest.mark.parametrize("detector", [Detector(), PERFECT_DETECTOR])
def test_instance_counts_leave_all_other_bytes_unchanged(detector):
    scenes = [generate_room("train", i, 0) for i in range(3)]
    plain_task = Task(detector=detector)
    counting_task = dataclasses.replace(plain_task, instance_counts=True)
    plain_bank = compile_bank(scenes, plain_task)
    counting_bank = compile_bank(scenes, counting_task)
    num_filled = 4 * 22 + 31
    np.testing.assert_array_equal(counting_bank.rows[:, :num_filled], plain_bank.rows[:, :num_filled])
    np.testing.assert_array_equal(counting_bank.best_length, plain_bank.best_length)

    # A category counts exactly where it is detected, and often more than once.
    counts = counting_task.row_format.counts(counting_bank.rows)
    np.testing.assert_array_equal(counts > 0, plain_task.row_format.presence(plain_bank.rows))
    assert counts.max() >= 3


def test_each_further_instance_is_missed_by_its_own_distance():
    """Two further chairs at 0 and 2.5 m of 5 m: missed in 0.1 and 0.1 + 0.4 / 4 = 0.2 of the poses."""
    detector = Detector(miss_near=0.1, miss_far=0.5)
    num_poses = 40_000
    pose = np.repeat(np.arange(num_poses), 2)
    distance = np.tile([0.0, 2.5], num_poses)
    is_detected = np.stack([np.arange(num_poses) % 4 > 0, np.zeros(num_poses, bool)], axis=-1)
    counts = detector.count("room", is_detected, pose, np.zeros_like(pose), distance, np.full(len(pose), 0.6))

    # Nothing counts where the category is not detected; one detection counts at least 1.
    assert not counts[~is_detected].any()
    detected_counts = counts[is_detected]
    for number, probability in ((1, 0.1 * 0.2), (2, 0.1 * 0.8 + 0.9 * 0.2), (3, 0.9 * 0.8)):
        num_equal = int((detected_counts == number).sum())
        assert binomtest(num_equal, len(detected_counts), probability).pvalue > 1e-3
        assert binomtest(num_equal, len(detected_counts), probability + 0.02).pvalue < 1e-3


def test_false_alarms_count_one_instance():
    task = Task(detector=Detector(miss_near=1.0, miss_far=1.0, false_alarm=0.3), instance_counts=True)
    bank = compile_bank([generate_room("train", 0, 0)], task)
    counts = task.row_format.counts(bank.rows)
    assert set(np.unique(counts)) == {0, 1}


def test_more_instances_than_a_byte_holds_count_255():
    pose = np.zeros(300, int)
    counts = PERFECT_DETECTOR.count("room", np.ones((1, 1), bool), pose, pose, np.zeros(300), np.ones(300))
    assert counts.tolist() == [[255]]
