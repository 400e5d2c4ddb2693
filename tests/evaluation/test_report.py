"""The evaluation report: rows, differences, package versions, and the file."""

import importlib.metadata
import json
from typing import Any

import jax
import numpy as np
import pytest
from support.episodes import episodes_in
from support.intervals import student_interval

from jaxnav.errors import InputError
from jaxnav.evaluation import report as reports

EPISODES = episodes_in([0, 1, 2, 3], best_length=np.array([1, 4, 5, 9]))
IDENTITY = {"variant": "baseline", "method": "ORG", "world": "ithor", "split": "test"}
INFERENCE = {"epsilon": None, "decoding": "argmax", "form": None}


def make_metrics(**changes):
    """Metrics of two seeds in four episodes, with changes."""
    metrics = {
        "sr": np.array([[1, 1, 0, 1], [1, 0, 0, 1]], bool),
        "spl": np.array([[1.0, 0.5, 0.0, 0.5], [1.0, 0.0, 0.0, 0.2]]),
        "dts": np.array([[0.0, 0.5, 2.0, 0.5], [0.0, 1.5, 2.0, 0.5]]),
        "sae": np.array([[0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.0, 0.5]]),
        "timeout": np.array([[0, 0, 1, 0], [0, 1, 0, 0]], bool),
        "wrong_done": np.array([[0, 0, 0, 0], [0, 0, 1, 0]], bool),
    }
    return metrics | changes


def make_row(**changes: Any):
    arguments: dict[str, Any] = {"metrics": make_metrics(), "episodes": EPISODES, **IDENTITY, **INFERENCE, **changes}
    return reports.build_row(**arguments)


def episodes_with_lengths(*lengths):
    return EPISODES._replace(best_length=np.array(lengths))


def bounds_around(mean, variance, degrees):
    return pytest.approx([*student_interval(mean, variance, degrees)[1:]])


def test_row_has_all_keys_of_the_format():
    metrics = ["sr", "spl", "dts", "sae", "timeout", "wrong_done"]
    row = make_row()
    assert set(row) == {*IDENTITY, *INFERENCE, "seeds", "episodes", *metrics, "interquartile_mean", "buckets"}
    assert set(row["buckets"]) == {"L>=1", "L>=5"}
    assert set(row["buckets"]["L>=5"]) == {"episodes", *metrics}
    assert set(row["sr"]) == {"mean", "std", "ci95", "seeds"}
    assert (row["seeds"], row["episodes"]) == (2, 4)


def test_row_is_in_percent_and_metres():
    row = make_row()
    # Success: 3 of 4 and 2 of 4 -> 75 % and 50 %; mean 62.5 %, std 25 / sqrt(2) = 17.678.
    assert row["sr"]["mean"] == pytest.approx(62.5)
    assert row["sr"]["std"] == pytest.approx(17.678, abs=1e-3)
    # SPL: 2.0 / 4 and 1.2 / 4 -> mean 40 %. DTS: 3 / 4 and 4 / 4 -> 0.875 m. SAE: 1.0 / 4 and 0.5 / 4 -> 18.75 %.
    assert row["spl"]["mean"] == pytest.approx(40)
    assert row["dts"]["mean"] == pytest.approx(0.875)
    assert row["sae"]["mean"] == pytest.approx(18.75)
    assert row["sr"]["seeds"] == [75, 50]

    # Scene means are 100, 50, 0 and 100 % with the sample variance 6875 / 3, and run means have the sample variance
    # 312.5. The residuals are 12.5 in six of eight cells and 37.5 in two cells, so their sum of squares is 3750. The
    # crossed term is as large as the run term, and the two cancel in the variance of the mean.
    scene_variance = 6875 / 3 / 4
    run_variance = 312.5 / 2
    crossed_variance = 3750 / 3 / 8
    degrees = scene_variance**2 / (scene_variance**2 / 3 + run_variance**2 + crossed_variance**2 / 3)
    assert row["sr"]["ci95"] == bounds_around(62.5, scene_variance, degrees)


@pytest.mark.parametrize("variant", ["random", "oracle"])
def test_untrained_rows_have_no_spread_over_seeds(variant):
    # The interval is over scenes, by the mean of the repetitions, whose spread is not that of training runs.
    row = make_row(variant=variant)
    assert row["sr"] == {"mean": pytest.approx(62.5), "std": None, "ci95": bounds_around(62.5, 6875 / 12, 3)}
    assert row["seeds"] == 2


def test_row_interval_counts_scenes_of_a_floor_plan_as_one():
    # Three floor plans: 75 % in two scenes, 0 % and 100 %. Without one of them the means are 50, 83.3 and 50 %. The
    # variance is 2 / 3 of the sum of the squared deviations.
    names = ("FloorPlan_Train1_1", "FloorPlan_Train1_2", "FloorPlan_Train2_1", "FloorPlan_Train3_1")
    row = make_row(variant="random", episodes=EPISODES._replace(scenes=names))
    assert row["sr"]["ci95"] == bounds_around(62.5, 2 / 3 * (12.5**2 + (250 / 3 - 62.5) ** 2 + 12.5**2), 2)


def test_row_has_buckets_by_best_length():
    row = make_row()
    assert row["buckets"]["L>=1"] == {key: row[key] for key in ["episodes", *make_metrics()]}
    # L* = 1, 4, 5, 9: the last two episodes have L* >= 5. Success 0, 1 in both seeds; DTS 2.0, 0.5 in both.
    long_bucket = row["buckets"]["L>=5"]
    assert long_bucket["episodes"] == 2
    assert long_bucket["sr"]["mean"] == pytest.approx(50)
    assert long_bucket["sr"]["std"] == pytest.approx(0)
    assert long_bucket["dts"]["mean"] == pytest.approx(1.25)
    assert long_bucket["sr"]["ci95"] is None  # of two scenes


def test_empty_bucket_has_no_metrics():
    assert make_row(episodes=episodes_with_lengths(1, 2, 3, 4))["buckets"]["L>=5"] == {"episodes": 0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metrics": make_metrics(sr=100.0 * make_metrics()["sr"])}, "sr"),
        ({"metrics": make_metrics(dts=-make_metrics()["dts"])}, "dts"),
        ({"metrics": make_metrics(spl=np.full((2, 4), np.nan))}, "spl.*NaN"),
        ({"metrics": make_metrics(dts=np.full((2, 4), np.inf))}, "dts.*NaN"),
    ],
)
def test_bad_results_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        make_row(**changes)


def build_stde_difference(metric, stde_values):
    """The difference between the layout row and sTDE in a metric."""
    return reports.build_difference(
        metric,
        ("layout", make_metrics()[metric]),
        ("stde", stde_values),
        epsilon=0.5,
        form="residual",
        decoding="argmax",
        episodes=EPISODES,
        same_runs=True,
    )


def test_difference_is_in_points():
    # The mean success of 0.625 rises to 0.875, by 25 points; the two seeds gain 0 and 50 points.
    better_success = np.array([[1, 1, 0, 1], [1, 1, 1, 1]], bool)
    difference = build_stde_difference("sr", better_success)
    # Ties count half: run 0 has four ties, and run 1 is better in two of four scenes.
    assert difference.pop("probability_of_improvement")["mean"] == pytest.approx((4 * 0.5 + 2 * 0.5 + 2) / 8)
    assert difference == {
        "metric": "sr",
        "from": "layout",
        "to": "stde",
        "epsilon": 0.5,
        "form": "residual",
        "decoding": "argmax",
        "mean": pytest.approx(25),
        "std": pytest.approx(1250**0.5),
        # The run term is 1250 / 2. The scene gains of 0, 50, 50 and 0 points give 2500 / 3 / 4, which the crossed term
        # cancels: 1 degree of freedom.
        "ci95": bounds_around(25, 625, 1),
        "seeds": [0, 50],
    }


def test_shorter_distances_are_improvements():
    shorter_distances = np.array([[0.0, 0.4, 1.0, 0.5], [0.0, 1.0, 1.0, 0.4]])
    difference = build_stde_difference("dts", shorter_distances)
    # Run 0: tie, shorter, shorter, tie. Run 1: tie, shorter, shorter, shorter.
    assert difference["probability_of_improvement"]["mean"] == pytest.approx((3 * 0.5 + 5) / 8)


def test_row_has_the_interquartile_mean_of_all_episodes():
    # Success of two runs in four scenes is 0 % three times and 100 % five times; the middle four values are 0, 100, 100
    # and 100 %.
    assert make_row()["interquartile_mean"]["sr"]["mean"] == pytest.approx(75.0)


def test_report_file_replaces_an_old_file_and_equals_the_report(tmp_path):
    rows = [make_row(), make_row(variant="stde", epsilon=0.5, form="residual")]
    report = reports.build_report(rows, [], ["A note."], 2, run={"method": "org"})
    path = tmp_path / "report.json"
    path.write_text("old")
    reports.write_report(path, report)
    assert json.loads(path.read_text(encoding="utf-8")) == report
    assert set(report) == {
        "run",
        "rows",
        "differences",
        "decision_shares",
        "notes",
        "compilations",
        "versions",
        "format",
    }
    assert (report["notes"], report["compilations"], report["format"]) == (["A note."], 2, 1)
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_report_with_nan_is_not_written(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON"):
        reports.write_report(path, reports.build_report([{"sr": float("nan")}], [], [], 1, {}))
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_package_versions_name_the_main_packages():
    versions = reports.package_versions()
    assert set(versions) == {"jaxnav", "jax", "flax", "numpy", "python"}
    assert (versions["jax"], versions["numpy"]) == (jax.__version__, np.__version__)


@pytest.mark.parametrize(("installed", "expected"), [({"jaxnav": "1.2.3"}, "1.2.3"), ({}, "source")])
def test_jaxnav_version_is_the_installed_one_or_source(monkeypatch, installed, expected):
    def version(name):
        if name == "jaxnav" and name not in installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed.get(name, "0")

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert reports.package_versions()["jaxnav"] == expected
