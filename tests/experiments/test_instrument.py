"""The layout shift as an instrument: worked means and changes, detection shares, and verdicts of the page."""

import dataclasses
import re

import numpy as np
import pytest
from rich.console import Console
from support.intervals import around, bounds
from support.scenes import draw

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments import instrument
from jaxnav.experiments.config import ExperimentConfig
from jaxnav.experiments.instrument import (
    BASELINE_MEASURES,
    CATEGORY_MEASURES,
    DIFFICULTY_MEASURES,
    LAYOUT_BLIND_MEASURES,
    SceneTotals,
    compare_shifts,
    measure_detection,
    measure_scenes,
)
from jaxnav.experiments.pages import render_page
from jaxnav.experiments.table import ResultTable
from jaxnav.runs.policies import load_policies
from jaxnav.runs.worlds import compile_evaluation_world, draw_episode_lists
from jaxnav.scenes.tables.compile import categories_in_view, compile_bank, compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, Detector, RowFormat
from jaxnav.scenes.task import Rules, Task

# Measures of one shift


def succeed(rows, policies, world, num_episodes, seed):
    """Evaluate rows as if every episode succeeded."""
    episode_lists = draw_episode_lists(world, num_episodes, seed)
    shape = (len(rows), policies.num_seeds, len(join_episode_lists(episode_lists).goal))
    outcome = EpisodeOutcome.zeros(shape)._replace(
        done=np.ones(shape, bool), success=np.ones(shape, bool), length=np.ones(shape, int)
    )
    return episode_lists, outcome, 1


@pytest.mark.slow
def test_agents_that_always_succeed_have_a_success_of_100_percent(drawn_run, monkeypatch):
    monkeypatch.setattr("jaxnav.experiments.instrument.evaluate_rows", succeed)
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, 0.0, Console(quiet=True))
    policies = load_policies(drawn_run.config, ("baseline",))
    totals = measure_scenes(compiled_world, policies, policies, num_episodes=24, seed=0)

    # Some four episodes a scene, so sums and means of the scenes differ.
    for measure in (*BASELINE_MEASURES, "layout_blind_argmax_sr", "layout_blind_sample_sr"):
        means = totals.values[measure].sum(axis=1) / totals.weights[measure].sum()
        np.testing.assert_allclose(means, 100.0)


def test_scenes_whose_goals_are_never_detected_do_not_count(drawn_run, monkeypatch):
    """Where no goal is detected, nobody can tell how often Done would succeed."""
    monkeypatch.setattr("jaxnav.experiments.instrument.evaluate_rows", succeed)
    whole_measure = instrument._measure_bank

    def measure_bank(*arguments):
        measures = whole_measure(*arguments)
        succeeds = np.array(measures.succeeds)
        succeeds[0] = np.nan
        succeeds[1:] = np.where(np.isnan(succeeds[1:]), np.nan, 0.5)
        return measures._replace(succeeds=succeeds)

    monkeypatch.setattr(instrument, "_measure_bank", measure_bank)
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, 0.0, Console(quiet=True))
    totals = measure_scenes(
        compiled_world, load_policies(drawn_run.config, ("baseline",)), None, num_episodes=24, seed=0
    )
    assert totals.weights["done_succeeds"][0] == 0 < totals.weights["goal_detected"][0]
    assert totals.values["done_succeeds"].sum() / totals.weights["done_succeeds"].sum() == 50.0


# Comparison of shifts

TRAINED_MEASURES = BASELINE_MEASURES + LAYOUT_BLIND_MEASURES
MEASURES = (*DIFFICULTY_MEASURES, "frontier_steps", *CATEGORY_MEASURES, *TRAINED_MEASURES)
ROOMS = ("kitchen", "kitchen", "bedroom")  # a single bedroom shows no variance, so all scenes are one stratum
NAMES = ("a", "b", "c")
FIELDS = {"world": "rooms", "run": "main"}


def make_totals(names=NAMES, rooms=ROOMS, categories=None, num_seeds=2, **means) -> SceneTotals:
    """Totals of two episodes in each scene.

    Args:
      names, rooms: [N], of the scenes.
      categories: [N, K], detection of goals by category; 50 % unless given.
      num_seeds: number of training runs of measures with training.
      means: measures as their mean in each scene, [N] or by seed [S, N]; all others are 1.
    """
    values = {}
    for measure in MEASURES:
        seeds = num_seeds if measure in TRAINED_MEASURES else 1
        scene_means = np.atleast_2d(np.array(means.get(measure, np.ones((seeds, len(names)))), float))
        values[measure] = 2.0 * scene_means
    by_category: dict[str, np.ndarray] = {name: np.full((len(names), 2), 50.0) for name in CATEGORY_MEASURES}
    if categories is not None:
        by_category["goal_detected"] = np.array(categories, float)
    return SceneTotals(values, dict.fromkeys(MEASURES, np.full(len(names), 2.0)), by_category, rooms, names)


def compare(*totals: SceneTotals) -> ResultTable:
    """Rows of the shifts 0 and 1."""
    return ResultTable(compare_shifts(FIELDS, [0.0, 1.0], totals))


def find_change(table: ResultTable, measure: str) -> Interval:
    return table.find(FIELDS, shift=1.0, reference="first shift", metric=measure)


def test_means_and_changes_are_as_worked():
    first = make_totals(best_length=[10, 20, 30], random_sr=[1, 2, 3], baseline_argmax_sr=[[60, 40, 20], [80, 60, 40]])
    last = make_totals(best_length=[12, 20, 31], random_sr=[1, 2, 3.4], baseline_argmax_sr=[[50, 30, 10], [70, 50, 30]])
    table = compare(first, last)

    # L* is 60 / 3 and 63 / 3: sample variances 100 and (9^2 + 1 + 10^2) / 2 = 91 of three scenes, / 3 of their mean.
    assert bounds(table.find(FIELDS, shift=0.0, metric="best_length")) == pytest.approx(around(20.0, 100 / 3, 2))
    assert bounds(table.find(FIELDS, shift=1.0, metric="best_length")) == pytest.approx(around(21.0, 91 / 3, 2))
    assert table.num_scenes(shift=0.0, metric="best_length") == 3
    assert table.find(FIELDS, shift=1.0, metric="episodes").mean == 6.0

    # Changes of difficulty in percent: 1 of 20, and 0.4 of 6.
    assert find_change(table, "best_length").mean == pytest.approx(5.0)
    assert find_change(table, "random_sr").mean == pytest.approx(100 * 0.4 / 6)
    assert find_change(table, "frontier_sr").mean == 0.0

    # SR 40 and 60 of the seeds, 20 apart in all scenes: 400 / 3 by scene, 200 / 2 by run, nothing by both. Degrees of
    # freedom (400 / 3 + 100)^2 / ((400 / 3)^2 / 2 + 100^2 / 1) = 2.88.
    success = table.find(FIELDS, shift=0.0, metric="baseline_argmax_sr")
    degrees = (700 / 3) ** 2 / ((400 / 3) ** 2 / 2 + 100**2)
    assert bounds(success) == pytest.approx(around(50.0, 700 / 3, degrees))

    # All scenes and seeds lose 10 points, however they differ.
    assert bounds(find_change(table, "baseline_argmax_sr")) == pytest.approx((10.0, 10.0, 10.0))
    assert bounds(find_change(table, "baseline_sample_sr")) == (0.0, 0.0, 0.0)


def test_only_difficulty_and_success_have_changes():
    changes = compare(make_totals(), make_totals()).where(reference="first shift")
    by_category = {f"{measure} by category" for measure in CATEGORY_MEASURES}
    assert {row.metric for row in changes.rows} == {*DIFFICULTY_MEASURES, *TRAINED_MEASURES, *by_category}


def test_losses_are_from_the_first_shift_to_the_last():
    totals = []
    for length in (10, 11, 14):
        totals.append(make_totals(best_length=[length] * 3, baseline_argmax_sr=[[90.0 - length] * 3] * 2))
    table = ResultTable(compare_shifts(FIELDS, [0.0, 0.5, 1.0], totals))
    changes = {"reference": "first shift", **FIELDS}

    # Difficulty changes by 1 and 4 of 10; success falls from 80 to 76.
    assert table.find(changes, shift=0.5, metric="best_length").mean == pytest.approx(10.0)
    assert table.find(changes, shift=1.0, metric="best_length").mean == pytest.approx(40.0)
    assert table.find(changes, shift=1.0, metric="baseline_argmax_sr").mean == pytest.approx(4.0)
    assert not table.has(changes, shift=0.5, metric="baseline_argmax_sr")


def test_scenes_may_be_missing_at_a_shift():
    first = make_totals(best_length=[10, 20, 30])
    last = make_totals(("c", "a"), ("bedroom", "kitchen"), best_length=[30, 10])
    table = compare(first, last)
    for shift, num_scenes in ((0.0, 3), (1.0, 2)):
        assert table.num_scenes(shift=shift, metric="best_length") == num_scenes
        assert table.find(FIELDS, shift=shift, metric="best_length").mean == 20.0


def test_a_scene_is_left_out_of_all_shifts_at_once():
    # L* is 5 % longer in every scene, with any scenes left out; the last shift has them in another order.
    lengths = np.array([10.0, 20.0, 30.0])
    first = make_totals(best_length=lengths)
    last = make_totals(NAMES[::-1], ROOMS[::-1], best_length=1.05 * lengths[::-1])
    assert bounds(find_change(compare(first, last), "best_length")) == pytest.approx((5.0, 5.0, 5.0))

    # In other scenes, the same lengths do not cancel.
    other_scenes = make_totals(("d", "e", "f"), ROOMS, best_length=1.05 * lengths)
    change = find_change(compare(first, other_scenes), "best_length")
    assert change.mean == pytest.approx(5.0)
    assert change.low < -50


def test_a_training_run_is_left_out_of_all_shifts_at_once():
    # Every run loses 10 points, and one is 40 points better than the other at both shifts.
    totals = [make_totals(baseline_sample_sr=[[60.0 - loss] * 3, [20.0 - loss] * 3]) for loss in (0.0, 10.0)]
    loss = find_change(compare(*totals), "baseline_sample_sr")
    assert bounds(loss) == pytest.approx((10.0, 10.0, 10.0))


def test_changes_of_categories_do_not_cancel():
    # The first is in all three scenes, the second in two: they change by 3 and by -18, in the mean of scenes by
    # (3 * 3 + 2 * 18) / 5 = 9.
    before = [[50, 80], [60, np.nan], [70, 60]]
    after = [[56, 60], [60, np.nan], [73, 44]]
    table = compare(make_totals(categories=before), make_totals(categories=after))
    assert find_change(table, "goal_detected by category").mean == pytest.approx(9.0)
    assert find_change(table, "done_succeeds by category").mean == 0.0


def test_more_wrong_dones_are_a_loss():
    first = make_totals(layout_blind_argmax_sr=[[80.0] * 3] * 2, layout_blind_argmax_wrong=[[3.0] * 3] * 2)
    last = make_totals(layout_blind_argmax_sr=[[78.0] * 3] * 2, layout_blind_argmax_wrong=[[4.5] * 3] * 2)
    table = compare(first, last)
    assert find_change(table, "layout_blind_argmax_sr").mean == pytest.approx(2.0)
    assert find_change(table, "layout_blind_argmax_wrong").mean == pytest.approx(1.5)


def test_a_difficulty_of_zero_cannot_change_by_percents():
    with pytest.raises(InputError, match=r"frontier_sr.* shift 0.*--episodes"):
        compare(make_totals(frontier_sr=[0, 0, 0]), make_totals())


# Verdicts of the page


def read_verdicts(tmp_path, *totals: SceneTotals) -> dict[str, list[bool]]:
    """Verdicts of the page, in the order of its lines, by its four criteria."""
    config = ExperimentConfig(shifts=(0.0, 1.0))
    text = render_page(tmp_path / "page.md", "instrument", config, {"val": compare(*totals)}, [])
    verdicts: dict[str, list[bool]] = {}
    for line in text.splitlines():
        criterion = re.match(r"\| (Difficulty|Categories|Discriminating|No loss)", line)
        if criterion:
            is_met = line.strip("| ").rsplit("| ", 1)[1]
            assert is_met in ("yes", "**no**")
            verdicts.setdefault(criterion[1], []).append(is_met == "yes")
    return verdicts


def test_difficulty_may_change_by_five_percent(tmp_path):
    # L* by 5 %, Random by 6.7 %; frontier search and distances not at all.
    first = make_totals(best_length=[10, 20, 30], random_sr=[1, 2, 3])
    last = make_totals(best_length=[12, 20, 31], random_sr=[1, 2, 3.4])
    assert read_verdicts(tmp_path, first, last)["Difficulty"] == [True, False, True, True]
    assert read_verdicts(tmp_path, last, first)["Difficulty"] == [True, False, True, True]


def test_categories_may_change_by_five_points(tmp_path):
    # Detection changes by 9 points, success of Done by nothing.
    first = make_totals(categories=[[50, 80], [60, np.nan], [70, 60]])
    last = make_totals(categories=[[56, 60], [60, np.nan], [73, 44]])
    assert read_verdicts(tmp_path, first, last)["Categories"] == [False, True]


@pytest.mark.parametrize(
    ("success", "is_discriminating"),
    [
        ([[7.9] * 3] * 2, False),
        ([[8.1] * 3] * 2, True),
        ([[20.0] * 3, [-1.0] * 3], False),  # the seeds disagree
        ([[0.0, 0.0, 30.0]] * 2, False),  # the scenes disagree
        ([[8.0, 9.0, 10.0]] * 2, True),  # 9 +- 4.3 * sqrt(1 / 3) = 2.5
    ],
)
def test_a_loss_must_be_large_and_sure(tmp_path, success, is_discriminating):
    first = make_totals(baseline_argmax_sr=success)
    last = make_totals(baseline_argmax_sr=np.zeros((2, 3)))
    assert read_verdicts(tmp_path, first, last)["Discriminating"] == [is_discriminating, False]


def test_a_single_training_run_shows_no_loss(tmp_path):
    # Without an interval there is no verdict.
    totals = []
    for success in (60.0, 50.0):
        totals.append(make_totals(num_seeds=1, baseline_argmax_sr=[[success] * 3], baseline_sample_sr=[[success] * 3]))
    loss = find_change(compare(*totals), "baseline_sample_sr")
    assert (loss.mean, loss.has_bounds) == (10.0, False)
    assert read_verdicts(tmp_path, *totals)["Discriminating"] == [False, False]


@pytest.mark.parametrize(("loss", "is_small"), [(1.9, True), (2.1, False), (-5.0, True)])
def test_layout_blind_agents_must_lose_little(tmp_path, loss, is_small):
    first = make_totals(layout_blind_argmax_sr=[[80.0] * 3] * 2, layout_blind_argmax_wrong=[[3.0] * 3] * 2)
    last = make_totals(layout_blind_argmax_sr=[[80.0 - loss] * 3] * 2, layout_blind_argmax_wrong=[[3.0 + loss] * 3] * 2)
    assert read_verdicts(tmp_path, first, last)["No loss"] == [is_small, True, is_small, True]


def test_without_such_agents_there_is_no_verdict_on_them(tmp_path):
    totals = []
    for results in (make_totals(), make_totals()):
        values = {name: value for name, value in results.values.items() if name not in LAYOUT_BLIND_MEASURES}
        totals.append(results._replace(values=values))
    assert set(read_verdicts(tmp_path, *totals)) == {"Difficulty", "Categories", "Discriminating"}


# Detection

TASK = Task(("Book", "Chair"), rules=Rules(horizons=(30.0,)), detector=PERFECT_DETECTOR)
CORRIDOR = [".................."]  # 18 cells, 4.25 m
#: At the end of the corridor a small book, detected from up to 1.5 m, and a chair that is detected from up to 5 m.
ENDS = draw(CORRIDOR, ("Book", 4.25, 0.8, 0.0, 0.1, 0.1, 0.1), ("Chair", 4.25, 0.8, 0.0, 0.6, 0.6, 0.1))


def test_small_objects_are_in_view_beyond_their_detection():
    in_view = categories_in_view(ENDS, TASK)
    detected = RowFormat(2).presence(compile_scene(ENDS, TASK).rows)
    np.testing.assert_array_equal(in_view[:, 0], in_view[:, 1])  # they are in one place
    np.testing.assert_array_equal(detected[:, 1], in_view[:, 1])
    assert not (detected & ~in_view).any()
    assert detected[:, 0].sum() < in_view[:, 0].sum()


def test_detection_shares_and_distances_are_as_worked():
    bank = compile_bank([ENDS], TASK)
    shares = measure_detection(bank, iter([ENDS]))

    # The book is detected in the poses of the last seven cells that have it in view, where Done succeeds, and only
    # there; the chair in all poses that have it in view.
    in_view = categories_in_view(ENDS, TASK)
    is_near = np.repeat(np.abs(4.25 - np.arange(18) / 4) <= 1.5, 8)
    near_share = (in_view[:, 0] & is_near).sum() / in_view[:, 0].sum()
    assert shares.detected[0] == pytest.approx([near_share, 1.0])
    assert shares.succeeds[0] == pytest.approx([1.0, near_share])

    # Cells are 0, 0.25, ..., 4.25 m away.
    assert shares.distance[0] == pytest.approx([17 / 8, 17 / 8])


def test_false_alarms_do_not_count_and_misses_do():
    def detected_shares(detector: Detector) -> np.ndarray:
        task = dataclasses.replace(TASK, detector=detector)
        return measure_detection(compile_bank([ENDS], task), iter([ENDS])).detected[0]

    # With false alarms everywhere, the goal may count where it is in view, but never more than that.
    alarms = detected_shares(dataclasses.replace(PERFECT_DETECTOR, false_alarm=1.0))
    assert (alarms >= detected_shares(PERFECT_DETECTOR)).all()
    assert alarms[1] == 1.0
    assert detected_shares(Detector(miss_near=1.0, miss_far=1.0, false_alarm=0.0)).tolist() == [0.0, 0.0]


def test_scenes_without_goals_are_skipped():
    empty = dataclasses.replace(draw(CORRIDOR), name="empty")
    alone = dataclasses.replace(draw(CORRIDOR, ("Chair", 4.25, 0.8, 0.0, 0.6, 0.6, 0.1)), name="alone")
    scenes = [empty, alone, ENDS]
    bank = compile_bank(scenes, TASK)
    assert bank.skipped == ("empty",)
    shares = measure_detection(bank, iter(scenes))
    assert np.isnan(shares.detected[0, 0])
    expected = measure_detection(compile_bank([ENDS], TASK), iter([ENDS]))
    np.testing.assert_array_equal(shares.detected[1], expected.detected[0])
