"""The layout shift as an instrument: means and changes worked out by hand, detection shares, verdicts of the page."""

import dataclasses
import re

import numpy as np
import pytest
from rich.console import Console
from support.intervals import bounds, student_interval
from support.scenes import draw

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments import instrument
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import AgentRun, ExperimentConfig
from jaxnav.experiments.instrument import (
    BASELINE_MEASURES,
    CATEGORY_MEASURES,
    DIFFICULTY_MEASURES,
    LAYOUT_BLIND_MEASURES,
    SceneTotals,
    compare_shifts,
    measure_detection,
    measure_instrument,
    measure_scenes,
)
from jaxnav.experiments.pages import render_page
from jaxnav.experiments.table import ResultTable
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import load_policies
from jaxnav.runs.worlds import compile_evaluation_world, draw_episode_lists
from jaxnav.scenes.tables.compile import categories_in_view, compile_bank, compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, Detector, RowFormat
from jaxnav.scenes.task import Rules, Task

# Measures of one shift


def evaluate_as_success(rows, policies, world, num_episodes, seed):
    """Replacement of `evaluate_rows`, in which every episode succeeds."""
    episode_lists = draw_episode_lists(world, num_episodes, seed)
    shape = (len(rows), policies.num_seeds, len(join_episode_lists(episode_lists).goal))
    outcome = EpisodeOutcome.zeros(shape)._replace(
        done=np.ones(shape, bool), success=np.ones(shape, bool), length=np.ones(shape, int)
    )
    return episode_lists, outcome, 1


@pytest.mark.slow
def test_agents_that_always_succeed_have_a_success_of_100_percent(drawn_run, monkeypatch):
    monkeypatch.setattr("jaxnav.experiments.instrument.evaluate_rows", evaluate_as_success)
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, 0.0, Console(quiet=True))
    policies = load_policies(drawn_run.config, ("baseline",))
    totals = measure_scenes(compiled_world, policies, policies, num_episodes=24, seed=0)

    # A scene has about four episodes, so sums and means of the scenes differ.
    for measure in (*BASELINE_MEASURES, "layout_blind_argmax_sr", "layout_blind_sample_sr"):
        means = totals.values[measure].sum(axis=1) / totals.weights[measure].sum()
        np.testing.assert_allclose(means, 100.0)


def test_scenes_whose_goals_are_never_detected_do_not_count(drawn_run, monkeypatch):
    """The success of Done is undefined in scenes where no goal is detected."""
    monkeypatch.setattr("jaxnav.experiments.instrument.evaluate_rows", evaluate_as_success)
    measure_bank = instrument._measure_bank

    def measure_half_success(*arguments):
        """Measures of a bank, with an undefined success of Done in the first scene and 50 % in the rest."""
        measures = measure_bank(*arguments)
        succeeds = np.array(measures.succeeds)
        succeeds[0] = np.nan
        succeeds[1:] = np.where(np.isnan(succeeds[1:]), np.nan, 0.5)
        return measures._replace(succeeds=succeeds)

    # The first scene has no weight in the mean over scenes.
    monkeypatch.setattr(instrument, "_measure_bank", measure_half_success)
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, 0.0, Console(quiet=True))
    policies = load_policies(drawn_run.config, ("baseline",))
    totals = measure_scenes(compiled_world, policies, None, num_episodes=24, seed=0)
    assert totals.weights["done_succeeds"][0] == 0 < totals.weights["goal_detected"][0]
    assert totals.values["done_succeeds"].sum() / totals.weights["done_succeeds"].sum() == 50.0


# Comparison of shifts

TRAINED_MEASURES = BASELINE_MEASURES + LAYOUT_BLIND_MEASURES
MEASURES = (*DIFFICULTY_MEASURES, "frontier_steps", *CATEGORY_MEASURES, *TRAINED_MEASURES)
#: Room types of three scenes. A single bedroom has no variance, so all scenes are one stratum.
ROOMS = ("kitchen", "kitchen", "bedroom")
NAMES = ("a", "b", "c")
FIELDS = {"world": "rooms", "run": "main"}


def make_totals(names=NAMES, rooms=ROOMS, categories=None, num_seeds=2, **means) -> SceneTotals:
    """Totals of two episodes in each scene.

    Args:
      names, rooms: [N], names and room types of the scenes.
      categories: [N, K], detection of goals by category; 50 % unless given.
      num_seeds: number of training runs of the measures of trained agents.
      means: measures as their mean in each scene, [N] or by seed [S, N]; measures that are not given are 1.
    """
    # Totals are the means times the two episodes of a scene; untrained measures have a single row.
    values = {}
    for measure in MEASURES:
        num_rows = num_seeds if measure in TRAINED_MEASURES else 1
        default_means = np.ones((num_rows, len(names)))
        scene_means = np.atleast_2d(np.array(means.get(measure, default_means), float))
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


def test_means_and_changes_equal_values_worked_out_by_hand():
    first_totals = make_totals(
        best_length=[10, 20, 30], random_sr=[1, 2, 3], baseline_argmax_sr=[[60, 40, 20], [80, 60, 40]]
    )
    last_totals = make_totals(
        best_length=[12, 20, 31], random_sr=[1, 2, 3.4], baseline_argmax_sr=[[50, 30, 10], [70, 50, 30]]
    )
    table = compare(first_totals, last_totals)

    # L* is 60 / 3 and 63 / 3. The sample variances of three scenes are 100 and (9^2 + 1 + 10^2) / 2 = 91; those of the
    # means are a third.
    assert bounds(table.find(FIELDS, shift=0.0, metric="best_length")) == pytest.approx(
        student_interval(20.0, 100 / 3, 2)
    )
    assert bounds(table.find(FIELDS, shift=1.0, metric="best_length")) == pytest.approx(
        student_interval(21.0, 91 / 3, 2)
    )
    assert table.num_scenes(shift=0.0, metric="best_length") == 3
    assert table.find(FIELDS, shift=1.0, metric="episodes").mean == 6.0

    # Difficulty changes by 1 of 20 and by 0.4 of 6, in percent.
    assert find_change(table, "best_length").mean == pytest.approx(5.0)
    assert find_change(table, "random_sr").mean == pytest.approx(100 * 0.4 / 6)
    assert find_change(table, "frontier_sr").mean == 0.0

    # The SR of the seeds is 40 and 60, with a difference of 20 in all scenes: the variance is 400 / 3 by scene, 200 / 2
    # by run, and 0 by their interaction. Degrees of freedom: (400 / 3 + 100)^2 / ((400 / 3)^2 / 2 + 100^2 / 1) = 2.88.
    success = table.find(FIELDS, shift=0.0, metric="baseline_argmax_sr")
    degrees = (700 / 3) ** 2 / ((400 / 3) ** 2 / 2 + 100**2)
    assert bounds(success) == pytest.approx(student_interval(50.0, 700 / 3, degrees))

    # All scenes and seeds lose 10 points, so the interval has no width.
    assert bounds(find_change(table, "baseline_argmax_sr")) == pytest.approx((10.0, 10.0, 10.0))
    assert bounds(find_change(table, "baseline_sample_sr")) == (0.0, 0.0, 0.0)


def test_only_difficulty_and_success_have_changes():
    changes = compare(make_totals(), make_totals()).where(reference="first shift")
    by_category = {f"{measure} by category" for measure in CATEGORY_MEASURES}
    assert {row.metric for row in changes.rows} == {*DIFFICULTY_MEASURES, *TRAINED_MEASURES, *by_category}


def test_losses_are_from_the_first_shift_to_the_last():
    totals_by_shift = []
    for length in (10, 11, 14):
        totals_by_shift.append(make_totals(best_length=[length] * 3, baseline_argmax_sr=[[90.0 - length] * 3] * 2))
    table = ResultTable(compare_shifts(FIELDS, [0.0, 0.5, 1.0], totals_by_shift))
    change_fields = {"reference": "first shift", **FIELDS}

    # Difficulty changes by 1 and 4 of 10; success falls from 80 to 76.
    assert table.find(change_fields, shift=0.5, metric="best_length").mean == pytest.approx(10.0)
    assert table.find(change_fields, shift=1.0, metric="best_length").mean == pytest.approx(40.0)
    assert table.find(change_fields, shift=1.0, metric="baseline_argmax_sr").mean == pytest.approx(4.0)
    assert not table.has(change_fields, shift=0.5, metric="baseline_argmax_sr")


def test_scenes_may_be_missing_at_a_shift():
    first_totals = make_totals(best_length=[10, 20, 30])
    last_totals = make_totals(("c", "a"), ("bedroom", "kitchen"), best_length=[30, 10])
    table = compare(first_totals, last_totals)
    for shift, num_scenes in ((0.0, 3), (1.0, 2)):
        assert table.num_scenes(shift=shift, metric="best_length") == num_scenes
        assert table.find(FIELDS, shift=shift, metric="best_length").mean == 20.0


def test_a_scene_is_left_out_of_all_shifts_at_once():
    # L* is 5 % longer in every scene, whichever scenes are left out; the last shift has another order of scenes.
    lengths = np.array([10.0, 20.0, 30.0])
    first_totals = make_totals(best_length=lengths)
    last_totals = make_totals(NAMES[::-1], ROOMS[::-1], best_length=1.05 * lengths[::-1])
    assert bounds(find_change(compare(first_totals, last_totals), "best_length")) == pytest.approx((5.0, 5.0, 5.0))

    # Equal lengths in other scenes do not cancel.
    other_totals = make_totals(("d", "e", "f"), ROOMS, best_length=1.05 * lengths)
    change = find_change(compare(first_totals, other_totals), "best_length")
    assert change.mean == pytest.approx(5.0)
    assert change.low < -50


def test_a_training_run_is_left_out_of_all_shifts_at_once():
    # Each run loses 10 points, and the first run is 40 points better than the second at both shifts.
    first_totals = make_totals(baseline_sample_sr=[[60.0] * 3, [20.0] * 3])
    last_totals = make_totals(baseline_sample_sr=[[50.0] * 3, [10.0] * 3])
    loss = find_change(compare(first_totals, last_totals), "baseline_sample_sr")
    assert bounds(loss) == pytest.approx((10.0, 10.0, 10.0))


def test_changes_of_categories_do_not_cancel():
    # The first category is in all three scenes and changes by 3; the second is in two and changes by -18. The mean of
    # the absolute changes over scenes is (3 * 3 + 2 * 18) / 5 = 9.
    first_totals = make_totals(categories=[[50, 80], [60, np.nan], [70, 60]])
    last_totals = make_totals(categories=[[56, 60], [60, np.nan], [73, 44]])
    table = compare(first_totals, last_totals)
    assert find_change(table, "goal_detected by category").mean == pytest.approx(9.0)
    assert find_change(table, "done_succeeds by category").mean == 0.0


def test_more_wrong_dones_are_a_loss():
    first_totals = make_totals(layout_blind_argmax_sr=[[80.0] * 3] * 2, layout_blind_argmax_wrong=[[3.0] * 3] * 2)
    last_totals = make_totals(layout_blind_argmax_sr=[[78.0] * 3] * 2, layout_blind_argmax_wrong=[[4.5] * 3] * 2)
    table = compare(first_totals, last_totals)
    assert find_change(table, "layout_blind_argmax_sr").mean == pytest.approx(2.0)
    assert find_change(table, "layout_blind_argmax_wrong").mean == pytest.approx(1.5)


def test_a_difficulty_of_zero_has_no_change_in_percent():
    with pytest.raises(InputError, match=r"frontier_sr.* shift 0.*--episodes"):
        compare(make_totals(frontier_sr=[0, 0, 0]), make_totals())


def test_a_run_without_the_baseline_is_refused_before_it_trains(tmp_path):
    run_config = RunConfig(run_dir=tmp_path / "run", arms=("layout",))
    bench = Bench(ExperimentConfig(), Console(quiet=True))
    with pytest.raises(InputError, match="has no arm `baseline`, which `instrument` measures"):
        list(measure_instrument(bench, AgentRun("rooms", "org", run_config)))
    assert not run_config.run_dir.exists()


# Verdicts of the page


def read_verdicts(tmp_path, *totals: SceneTotals) -> dict[str, list[bool]]:
    """Verdicts of the page by criterion, in the order of its lines."""
    config = ExperimentConfig(shifts=(0.0, 1.0))
    text = render_page(tmp_path / "page.md", "instrument", config, {"val": compare(*totals)}, [])
    verdicts: dict[str, list[bool]] = {}
    for line in text.splitlines():
        criterion = re.match(r"\| (Difficulty|Categories|Discriminating|No loss)", line)
        if criterion:
            answer = line.strip("| ").rsplit("| ", 1)[1]
            assert answer in ("yes", "**no**")
            verdicts.setdefault(criterion[1], []).append(answer == "yes")
    return verdicts


def test_difficulty_may_change_by_five_percent(tmp_path):
    # L* changes by 5 %, Random by 6.7 %; frontier search and distances do not change.
    first_totals = make_totals(best_length=[10, 20, 30], random_sr=[1, 2, 3])
    last_totals = make_totals(best_length=[12, 20, 31], random_sr=[1, 2, 3.4])
    assert read_verdicts(tmp_path, first_totals, last_totals)["Difficulty"] == [True, False, True, True]
    assert read_verdicts(tmp_path, last_totals, first_totals)["Difficulty"] == [True, False, True, True]


def test_categories_may_change_by_five_points(tmp_path):
    # Detection changes by 9 points, the success of Done does not change.
    first_totals = make_totals(categories=[[50, 80], [60, np.nan], [70, 60]])
    last_totals = make_totals(categories=[[56, 60], [60, np.nan], [73, 44]])
    assert read_verdicts(tmp_path, first_totals, last_totals)["Categories"] == [False, True]


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
def test_a_discriminating_loss_is_large_and_significant(tmp_path, success, is_discriminating):
    first_totals = make_totals(baseline_argmax_sr=success)
    last_totals = make_totals(baseline_argmax_sr=np.zeros((2, 3)))
    assert read_verdicts(tmp_path, first_totals, last_totals)["Discriminating"] == [is_discriminating, False]


def test_a_single_training_run_shows_no_loss(tmp_path):
    # A single run has no interval, so the criterion is not met.
    first_totals = make_totals(num_seeds=1, baseline_argmax_sr=[[60.0] * 3], baseline_sample_sr=[[60.0] * 3])
    last_totals = make_totals(num_seeds=1, baseline_argmax_sr=[[50.0] * 3], baseline_sample_sr=[[50.0] * 3])
    loss = find_change(compare(first_totals, last_totals), "baseline_sample_sr")
    assert (loss.mean, loss.has_bounds) == (10.0, False)
    assert read_verdicts(tmp_path, first_totals, last_totals)["Discriminating"] == [False, False]


@pytest.mark.parametrize(("loss", "is_small"), [(1.9, True), (2.1, False), (-5.0, True)])
def test_layout_blind_agents_must_lose_little(tmp_path, loss, is_small):
    first_totals = make_totals(layout_blind_argmax_sr=[[80.0] * 3] * 2, layout_blind_argmax_wrong=[[3.0] * 3] * 2)
    last_totals = make_totals(
        layout_blind_argmax_sr=[[80.0 - loss] * 3] * 2, layout_blind_argmax_wrong=[[3.0 + loss] * 3] * 2
    )
    assert read_verdicts(tmp_path, first_totals, last_totals)["No loss"] == [is_small, True, is_small, True]


def test_without_layout_blind_agents_there_is_no_verdict_on_them(tmp_path):
    totals = make_totals()
    values = {name: value for name, value in totals.values.items() if name not in LAYOUT_BLIND_MEASURES}
    totals = totals._replace(values=values)
    assert set(read_verdicts(tmp_path, totals, totals)) == {"Difficulty", "Categories", "Discriminating"}


# Detection

TASK = Task(("Book", "Chair"), rules=Rules(horizons=(30.0,)), detector=PERFECT_DETECTOR)
CORRIDOR = [".................."]  # 18 cells, 4.25 m
#: A corridor with two objects at its end: a small book, detected from up to 1.5 m, and a chair, from up to 5 m.
CORRIDOR_SCENE = draw(CORRIDOR, ("Book", 4.25, 0.8, 0.0, 0.1, 0.1, 0.1), ("Chair", 4.25, 0.8, 0.0, 0.6, 0.6, 0.1))


def test_small_objects_are_in_view_beyond_their_detection():
    in_view = categories_in_view(CORRIDOR_SCENE, TASK)
    detected = RowFormat(2).presence(compile_scene(CORRIDOR_SCENE, TASK).rows)
    np.testing.assert_array_equal(in_view[:, 0], in_view[:, 1])  # the objects have one position
    np.testing.assert_array_equal(detected[:, 1], in_view[:, 1])
    assert not (detected & ~in_view).any()
    assert detected[:, 0].sum() < in_view[:, 0].sum()


def test_detection_shares_and_distances_equal_values_worked_out_by_hand():
    bank = compile_bank([CORRIDOR_SCENE], TASK)
    shares = measure_detection(bank, iter([CORRIDOR_SCENE]))

    # The book is detected only in the poses of the last seven cells that have it in view, where Done succeeds. The
    # chair is detected in all poses that have it in view.
    in_view = categories_in_view(CORRIDOR_SCENE, TASK)
    is_near = np.repeat(np.abs(4.25 - np.arange(18) / 4) <= 1.5, 8)
    near_share = (in_view[:, 0] & is_near).sum() / in_view[:, 0].sum()
    assert shares.detected[0] == pytest.approx([near_share, 1.0])
    assert shares.succeeds[0] == pytest.approx([1.0, near_share])

    # Cells are 0, 0.25, ..., 4.25 m away.
    assert shares.distance[0] == pytest.approx([17 / 8, 17 / 8])


def test_false_alarms_do_not_count_and_misses_do():
    def detected_shares(detector: Detector) -> np.ndarray:
        task = dataclasses.replace(TASK, detector=detector)
        return measure_detection(compile_bank([CORRIDOR_SCENE], task), iter([CORRIDOR_SCENE])).detected[0]

    # Even with false alarms everywhere, the goal counts only in poses that have it in view.
    alarm_shares = detected_shares(dataclasses.replace(PERFECT_DETECTOR, false_alarm=1.0))
    assert (alarm_shares >= detected_shares(PERFECT_DETECTOR)).all()
    assert alarm_shares[1] == 1.0
    assert detected_shares(Detector(miss_near=1.0, miss_far=1.0, false_alarm=0.0)).tolist() == [0.0, 0.0]


def test_scenes_without_goals_are_skipped():
    empty_scene = dataclasses.replace(draw(CORRIDOR), name="empty")
    chair_scene = dataclasses.replace(draw(CORRIDOR, ("Chair", 4.25, 0.8, 0.0, 0.6, 0.6, 0.1)), name="chair")
    scenes = [empty_scene, chair_scene, CORRIDOR_SCENE]
    bank = compile_bank(scenes, TASK)
    assert bank.skipped == ("empty",)

    # The chair scene has no share of the book, and the last scene has its shares as if it were the only scene.
    shares = measure_detection(bank, iter(scenes))
    assert np.isnan(shares.detected[0, 0])
    expected = measure_detection(compile_bank([CORRIDOR_SCENE], TASK), iter([CORRIDOR_SCENE]))
    np.testing.assert_array_equal(shares.detected[1], expected.detected[0])
