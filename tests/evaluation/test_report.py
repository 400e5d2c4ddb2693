"""The report: rows, differences, versions, its file."""

import importlib.metadata
import json
from typing import Any

import jax
import numpy as np
import pytest
from support.episodes import episodes_in
from support.intervals import around

from jaxnav.errors import InputError
from jaxnav.evaluation import report as reports

EPISODES = episodes_in([0, 1, 2, 3], best_length=np.array([1, 4, 5, 9]))
IDENTITY = {"variant": "baseline", "method": "ORG", "world": "ithor", "split": "test"}
SETTING = {"epsilon": None, "decoding": "argmax", "form": None}


def make_metrics(**changes):
    """Two seeds, four episodes."""
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
    arguments: dict[str, Any] = {"metrics": make_metrics(), "episodes": EPISODES, **IDENTITY, **SETTING, **changes}
    return reports.build_row(**arguments)


def episodes_with_lengths(*lengths):
    return EPISODES._replace(best_length=np.array(lengths))


def bounds_around(mean, variance, degrees):
    return pytest.approx([*around(mean, variance, degrees)[1:]])


def test_row_has_all_keys_of_the_format():
    metrics = ["sr", "spl", "dts", "sae", "timeout", "wrong_done"]
    row = make_row()
    assert set(row) == {*IDENTITY, *SETTING, "seeds", "episodes", *metrics, "interquartile_mean", "buckets"}
    assert set(row["buckets"]) == {"L>=1", "L>=5"}
    assert set(row["buckets"]["L>=5"]) == {"episodes", *metrics}
    assert set(row["sr"]) == {"mean", "std", "ci95", "seeds"}
    assert (row["seeds"], row["episodes"]) == (2, 4)


def test_row_is_in_percent_and_metres():
    row = make_row()
    # Success: 3 of 4 and 2 of 4 -> 75 % and 50 %; mean 62.5, std 25 / sqrt(2) = 17.678.
    assert row["sr"]["mean"] == pytest.approx(62.5)
    assert row["sr"]["std"] == pytest.approx(17.678, abs=1e-3)
    # SPL: 2.0 / 4 and 1.2 / 4 -> mean 40 %. DTS: 3 / 4 and 4 / 4 -> 0.875 m. SAE: 1.0 / 4 and 0.5 / 4 -> 18.75 %.
    assert row["spl"]["mean"] == pytest.approx(40)
    assert row["dts"]["mean"] == pytest.approx(0.875)
    assert row["sae"]["mean"] == pytest.approx(18.75)
    assert row["sr"]["seeds"] == [75, 50]
    # By scene 100, 50, 0 and 100 %, sample variance 6875 / 3, / 4; by run 312.5 / 2; what is left is 12.5 in six of
    # eight and 37.5 in two, 3750 / 3 / 8, which is as much.
    by_scene, by_run, crossed = 6875 / 12, 312.5 / 2, 3750 / 24
    degrees = by_scene**2 / (by_scene**2 / 3 + by_run**2 + crossed**2 / 3)
    assert row["sr"]["ci95"] == bounds_around(62.5, by_scene, degrees)


@pytest.mark.parametrize("variant", ["random", "oracle"])
def test_untrained_rows_have_no_spread_over_seeds(variant):
    # Over scenes alone, by the mean of the repetitions; they have no spread that says anything of a training.
    row = make_row(variant=variant)
    assert row["sr"] == {"mean": pytest.approx(62.5), "std": None, "ci95": bounds_around(62.5, 6875 / 12, 3)}
    assert row["seeds"] == 2


def test_row_interval_counts_scenes_of_a_floor_plan_as_one():
    # Three floor plans: 75 % of two scenes, 0 and 100 %. Without them 50, 83.3 and 50 %: 2 / 3 of the squares.
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


def test_difference_is_in_points():
    # Mean success 0.625 against 0.875: +25 points; the two seeds gain 0 and 50 points.
    better = np.array([[1, 1, 0, 1], [1, 1, 1, 1]], bool)
    difference = reports.build_difference(
        "sr",
        ("layout", make_metrics()["sr"]),
        ("stde", better),
        epsilon=0.5,
        form="residual",
        decoding="argmax",
        episodes=EPISODES,
        same_runs=True,
    )
    # Ties count half: run 0 has four, run 1 is better in two of four scenes.
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
        # By run 1250 / 2; by scene 0, 50, 50 and 0 points, 2500 / 3 / 4, as much as what is left: 1 degree of freedom.
        "ci95": bounds_around(25, 625, 1),
        "seeds": [0, 50],
    }


def test_shorter_distances_are_improvements():
    shorter = np.array([[0.0, 0.4, 1.0, 0.5], [0.0, 1.0, 1.0, 0.4]])
    difference = reports.build_difference(
        "dts",
        ("layout", make_metrics()["dts"]),
        ("stde", shorter),
        epsilon=0.5,
        form="residual",
        decoding="argmax",
        episodes=EPISODES,
        same_runs=True,
    )
    # Run 0: tie, shorter, shorter, tie; run 1: tie and three times shorter.
    assert difference["probability_of_improvement"]["mean"] == pytest.approx((3 * 0.5 + 5) / 8)


def test_row_has_the_interquartile_mean_of_all_episodes():
    # Success of two runs in four scenes: 0 three times and 100 five times; the middle four are 0, 100, 100 and 100.
    assert make_row()["interquartile_mean"]["sr"]["mean"] == pytest.approx(75.0)


def test_written_report_is_read_back(tmp_path):
    report = reports.build_report(
        [make_row(), make_row(variant="stde", epsilon=0.5, form="residual")], [], ["A note."], 2, run={"method": "org"}
    )
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
